"""What a cell of a study is: fixtures and setting, which determine its compiled program, its values, and its trials."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .specification import Point, Region


class Fixture(NamedTuple):
    """What fixes the tip: a socket (one end), or a reference length (two ends)."""

    name: str
    poses: int  # at each end
    points: tuple[Point, ...] | None  # positions of the ends, mm; None: drawn at random in the region
    region: Region | None = None
    length: float | None = None  # of a reference length at random, mm

    @property
    def ends(self) -> int:
        """Number of points at which the tip is fixed."""
        return len(self.points) if self.points is not None else 1 if self.length is None else 2


class Setting(NamedTuple):
    """What determines the compiled program of a cell, and its pose pool."""

    fixtures: tuple[Fixture, ...]
    limits: tuple[tuple[float, float], ...]  # rad, or mm of prismatic joints
    hold: str | None
    method: str
    random_start: bool
    recorded: bool  # the poses are those of the recording
    model: str | None = None  # of the joints; None: that of the nominal arm
    prior: str | None = None  # as a text; None: the default

    @property
    def sizes(self) -> tuple[int, ...]:
        """Poses in each socket."""
        return tuple(fixture.poses for fixture in self.fixtures for _ in range(fixture.ends))


class CellValues(NamedTuple):
    """What differs from cell to cell within one compiled program; the first axis is the cell. mm and rad."""

    width: Float[np.ndarray, "c p"]  # of the deviation
    normal: Bool[np.ndarray, "c p"]
    lower: Float[np.ndarray, "c p"]
    upper: Float[np.ndarray, "c p"]
    encoder: Float[np.ndarray, " c"]
    resolution: Float[np.ndarray, " c"]
    seating: Float[np.ndarray, " c"]
    eccentricity: Float[np.ndarray, " c"]
    linear_encoder: Float[np.ndarray, " c"]  # of prismatic joints
    linear_resolution: Float[np.ndarray, " c"]
    u: Float[np.ndarray, " c"]  # of reference lengths; NaN: as recorded


class DrawnTrials(NamedTuple):
    """Trials, as `identify_many` takes them; mm and rad. q is NaN where the true arm did not reach its points.

    Example:
        >>> drawn, captures = aj.study.draw_trials(study, 0, [0, 1, 2])
        >>> print(drawn.q.shape, drawn.true.shape)
        (3, 30, 6) (3, 21)
    """

    q: Float[Any, "t N n"]
    true: Float[Any, "t p"]
    lower: Float[Any, "t p"]
    upper: Float[Any, "t p"]
    start: Float[Any, "t p"]
    value: Float[Any, "t l"]  # certified values of the reference lengths
    u: Float[Any, "t l"]
