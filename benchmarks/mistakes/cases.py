"""Arms and kinds of data: eight captures that are sound, as they would be recorded with care.

A case says which arm holds or shows what, and how well; `layout` says where the tip is in every pose. Its noise is
what such encoders, seats and instruments have, and every u that its manifest states is right.
"""

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

import aacmm_jax as aj

ARMS = Path(aj.__file__).parent / "files" / "shipped_arms"
Point = tuple[float, float, float]

# A measuring arm of seven joints, which none of the shipped arms is: one more turn about the forearm.
SEVEN_JOINTS: dict[str, Any] = {
    "name": "Measuring arm with seven joints",
    "convention": "standard",
    "length_unit": "mm",
    "angle_unit": "deg",
    "probe": [0.0, 0.0, 100.0],
    "joint": [
        {"alpha": -90.0, "a": 0.0, "d": 300.0, "theta": 0.0, "limits": [-180.0, 180.0]},
        {"alpha": 90.0, "a": 50.0, "d": 0.0, "theta": 0.0, "limits": [-120.0, 120.0]},
        {"alpha": -90.0, "a": 0.0, "d": 600.0, "theta": 0.0, "limits": [-180.0, 180.0]},
        {"alpha": 90.0, "a": 50.0, "d": 0.0, "theta": 0.0, "limits": [-130.0, 130.0]},
        {"alpha": -90.0, "a": 0.0, "d": 500.0, "theta": 0.0, "limits": [-180.0, 180.0]},
        {"alpha": 90.0, "a": 40.0, "d": 0.0, "theta": 0.0, "limits": [-120.0, 120.0]},
        {"alpha": 0.0, "a": 0.0, "d": 80.0, "theta": 0.0, "limits": [-180.0, 180.0]},
    ],
    "identification": {
        # The probe lies along the last axis, so a_7, d_7 and the last angles cannot be told from it.
        "held": ["theta_1", "d_1", "alpha_6", "theta_6", "alpha_7", "a_7", "theta_7", "d_7"],
        "length": 10.0,
        "angle": 1.0,
        "override": {"probe_x": 60.0, "probe_y": 60.0, "probe_z": 60.0},
    },
    "noise": {"class": "measuring arm"},
}


class Case(NamedTuple):
    """One arm with one kind of data."""

    arm: str | Mapping[str, Any]  # shipped, or as an arm file has it
    kind: str  # table of the manifest: socket, artefact, touched_sphere, points, transforms or distances
    poses: int  # in each group
    encoder_arcsec: float
    u: float  # standard deviation of a coordinate of the seat, or of what the instrument measures, mm
    deviation: tuple[float, float]  # largest error of the nominal arm, mm and deg
    groups: Mapping[str, Point] = {}  # sockets, holes, centres or pivots, and stations with their places
    placements: tuple[tuple[float, ...], ...] = ()  # frames of an artefact: rotation vector (rad) and origin (mm)
    box: tuple[Point, Point] = ((0, 0, 0), (0, 0, 0))  # where the tip is seen
    lengths: tuple[tuple[str, str], ...] = ()
    u_certified: float = 0.0  # of lengths, coordinates and diameters, mm
    diameter: float = 0.0  # of spheres
    unit: str = "deg"  # of the readings
    probe: Point | None = None
    target: str = ""  # whose place on the last link is unknown
    u_angle: float = 0.0  # of measured orientations, rad
    # Parameters that no data tell from the place of an unknown target: the true arm has them as the nominal one.
    gauge: tuple[str, ...] = ()

    @property
    def instrument(self) -> bool:
        """Whether an instrument measures where the tip is, instead of something that holds the tip."""
        return self.kind in ("points", "transforms", "distances")


STYLUS = 6.0  # diameter of the ball that touches spheres, mm
SQUARE = {"a": (0, 0, 0), "b": (200, 0, 0), "c": (200, 150, 0), "d": (0, 150, 0)}
BOARD = {"a": (0, 0, 0), "b": (100, 0, 0), "c": (100, 80, 0), "d": (0, 80, 0), "e": (50, 40, 0)}
PLACED = ((0, 0, 0.3, 350, -250, 250), (0.2, 0.4, 0.9, 400, 100, 350), (-0.5, 0.1, -0.4, 250, 250, 500))
ON_TABLE = ((0, 0, 0.2, 150, -60, 20), (0, 0, 1.9, 180, 20, 60), (0.4, 0, -0.7, 120, -150, 90))

CASES: dict[str, Case] = {
    "arm6-sockets": Case(
        *("cheng2018-simulation", "socket", 20, 2.0, 0.005, (0.5, 0.05)),
        groups={"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)},
        lengths=(("A", "B"), ("C", "D"), ("A", "C"), ("B", "D")),
        u_certified=0.002,
    ),
    "arm7-spheres": Case(
        *(SEVEN_JOINTS, "touched_sphere", 30, 2.0, 0.005, (0.5, 0.05)),
        groups={"s1": (500, 200, 300), "s2": (700, -200, 400), "s3": (300, -500, 100), "s4": (-300, 500, 500)},
        diameter=100.0,
        u_certified=0.001,
    ),
    "panda-plate": Case(
        *("panda", "artefact", 8, 8.0, 0.015, (0.5, 0.1)),
        groups=SQUARE,
        placements=PLACED,
        u_certified=0.005,
        unit="rad",
    ),
    "ur10-tracker": Case(
        *("ur10", "points", 80, 8.0, 0.03, (1.0, 0.1)),
        groups={"tracker": (-2000, 1500, 300)},
        box=((300, -600, 100), (900, 600, 800)),
        target="reflector",
        unit="rad",
        gauge=("d_6", "probe_x", "probe_y"),
    ),
    "ur5-transforms": Case(
        *("ur5e", "transforms", 60, 4.0, 0.03, (0.5, 0.1)),
        groups={"camera": (2500, -800, 500)},
        box=((150, -450, 50), (600, 450, 600)),
        unit="rad",
        u_angle=2e-4,
        gauge=("d_6", "probe_x", "probe_y"),
    ),
    "hobby-board": Case(
        *("so100", "artefact", 8, 300.0, 0.2, (1.0, 0.5)),
        groups=BOARD,
        placements=ON_TABLE,
        u_certified=0.1,
        unit="counts",
        probe=(0.0, 0.0, 60.0),
    ),
    "iiwa-stations": Case(
        *("iiwa14", "points", 50, 8.0, 0.02, (0.5, 0.1)),
        groups={"north": (-1500, 2000, 400), "south": (-1500, -2500, 700)},
        box=((300, -500, 200), (700, 500, 800)),
    ),
    "irb-bar": Case(
        *("irb120", "distances", 35, 2.0, 0.005, (0.5, 0.1)),
        groups={"left": (300, 500, 50), "right": (300, -500, 100), "front": (750, 0, 200)},
        box=((200, -300, 200), (450, 300, 600)),
    ),
}  # fmt: skip


@cache
def arm_table(name: str) -> dict[str, Any]:
    """The nominal arm of a case as a file has it."""
    case = CASES[name]
    given = dict(case.arm) if not isinstance(case.arm, str) else tomllib.loads((ARMS / f"{case.arm}.toml").read_text())
    return given | ({} if case.probe is None else {"probe": list(case.probe)})


def layout(case: Case, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Group of each pose ``(N,)``, and where its tip is to be ``(N, 3)``, in the base frame, mm."""
    labels, tips = [], []
    for number, frame in enumerate(case.placements or ((0.0,) * 6,), start=1):
        for name, place in case.groups.items():
            label = f"p{number}/{name}" if case.placements else name
            labels += [label] * case.poses
            tips.append(_tips(case, np.array(frame), np.array(place, dtype=float), random))
    return np.array(labels), np.concatenate(tips)


def _tips(case: Case, frame: np.ndarray, place: np.ndarray, random: np.random.Generator) -> np.ndarray:
    if case.instrument:
        return random.uniform(*np.array(case.box), (case.poses, 3))
    if case.kind == "touched_sphere":
        directions = random.normal(size=(case.poses, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return place + (case.diameter + STYLUS) / 2 * directions
    return np.tile(Rotation.from_rotvec(frame[:3]).apply(place) + frame[3:], (case.poses, 1))
