"""What is stored of every trial, and how trials are cut into blocks."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..core.errors import InputError
from .computed_with import computed_with
from .definition import Study
from .settings import Setting

MOST_BLOCKS = 10_000  # files in one folder
DIMENSIONS = ("cell", "trial", "parameter")
NOT_RUN = -1  # of whole numbers; NaN of others, and -128 of active, where -1 is a bound


class _Variable(NamedTuple):
    """One array of results."""

    dtype: str
    by_parameter: bool  # whether it has an axis for the parameters
    units: str
    long_name: str


METRICS = {
    "k": "k, measured / nominal",
    "scale": "scale after stage 1, found / true",
    "scale_error": "scale after the fix, found / true - 1",
    "de_stage1": "DE before the scale fix",
    "deltam_stage1": "Deltam before the scale fix",
    "length_error_stage1": "largest length error before the scale fix",
    "angle_error_stage1": "largest angle error before the scale fix",
    "de": "DE after the scale fix",
    "deltam": "Deltam after the scale fix",
    "length_error": "largest length error after the scale fix",
    "angle_error": "largest angle error after the scale fix",
}


def unit_of(metric: str) -> str:
    """The unit of a metric in files."""
    return "1" if metric in ("k", "scale", "scale_error") else "rad" if metric.startswith("angle") else "mm"


VARIABLES = {
    "converged": _Variable("i1", False, "1", "1 where every solve ended at a minimum, 0 where not, -1 not yet run"),
    "reason": _Variable("i1", False, "1", "why the last solve ended, see attribute reasons"),
    "steps": _Variable("i4", False, "1", "evaluations of all solves"),
    **{name: _Variable("f8", False, unit_of(name), title) for name, title in METRICS.items()},
    "truth_inside": _Variable("i1", False, "1", "1 where the true arm lies inside the bounds"),
    "active": _Variable("i1", True, "1", "-1 on the lower bound, +1 on the upper, 0 inside, -128 not yet run"),
    "estimate": _Variable("f8", True, "mm or rad", "identified parameters, at the end"),
    "true": _Variable("f8", True, "mm or rad", "parameters of the true arm"),
}


def fill_of(name: str) -> float:
    """The value that marks a trial that has not run."""
    return np.nan if VARIABLES[name].dtype == "f8" else -128 if name == "active" else NOT_RUN


class Block(NamedTuple):
    """Trials of some cells, all of one setting."""

    first_cell: int
    last_cell: int  # not included
    first_trial: int
    last_trial: int  # not included

    @property
    def shape(self) -> tuple[int, int]:
        """Cells, and trials in each."""
        return self.last_cell - self.first_cell, self.last_trial - self.first_trial

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its part of the arrays of all cells and trials."""
        return slice(self.first_cell, self.last_cell), slice(self.first_trial, self.last_trial)

    @property
    def size(self) -> int:
        """Number of trials."""
        return self.shape[0] * self.shape[1]


class Layout(NamedTuple):
    """How trials are cut into blocks: all trials of some cells, or some trials of one cell."""

    cells: int
    trials: int
    parameters: int
    block_cells: int
    block_trials: int
    mark: str  # in the names of the files: of this study, of this size, and of what it is computed with
    chunk: int  # trials in a block that were asked for
    computed_with: str

    @classmethod
    def of(cls, study: Study, chunk: int, settings: str | None = None) -> "Layout":
        """Blocks of about ``chunk`` trials; small cells share a block where they have the same compiled program.

        ``settings`` is what the numbers are `computed_with`; by default as they are here.
        """
        cells, trials = len(study.cells), study.trials
        if cells * -(-trials // chunk) > MOST_BLOCKS:
            raise InputError(
                f"chunks of {chunk} cut {cells} cells of {trials:,} trials into more than {MOST_BLOCKS:,} blocks; "
                "give a larger chunk."
            )
        settings = settings or computed_with()
        mark = f"{study.digest[:12]}-{chunk}-{hashlib.sha256(settings.encode()).hexdigest()[:8]}"
        together = 1
        if trials < chunk:
            together = max(n for n in range(1, min(chunk // trials, cells) + 1) if _uniform(study.settings, n))
        # Blocks of nearly equal size: a short last one would run the same compiled program for fewer trials.
        block_trials = -(-trials // -(-trials // chunk))
        return cls(cells, trials, len(study.space.names), together, block_trials, mark, chunk, settings)

    def shape(self, name: str, cells: int | None = None, trials: int | None = None) -> tuple[int, ...]:
        """Shape of an array of results, of the whole study or of part of it."""
        shape = (self.cells if cells is None else cells, self.trials if trials is None else trials)
        return (*shape, self.parameters) if VARIABLES[name].by_parameter else shape

    def blocks(self) -> Iterator[Block]:
        """All blocks, in order."""
        for cell in range(0, self.cells, self.block_cells):
            for trial in range(0, self.trials, self.block_trials):
                last = min(trial + self.block_trials, self.trials)
                yield Block(cell, min(cell + self.block_cells, self.cells), trial, last)


def _uniform(settings: list[Setting], together: int) -> bool:
    """Whether every group of so many consecutive cells has one setting."""
    return all(len(set(settings[i : i + together])) == 1 for i in range(0, len(settings), together))


def parts_of(path: Path) -> Path:
    """Folder of the blocks of an unfinished study."""
    return path.with_name(path.name + ".parts")


def part_of(path: Path, block: Block, layout: Layout) -> Path:
    """File of one block."""
    return parts_of(path) / f"{layout.mark}-cell{block.first_cell:05d}-trial{block.first_trial:010d}.npz"
