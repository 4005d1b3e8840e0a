"""Results of a study, read from its file: labelled for users (`open_study`), and cell by cell for tables and plots."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.extras import require
from ..files.hdf5 import check_sense, undamaged
from ..files.outputs import as_path
from . import store
from .blocks import VARIABLES, fill_of
from .definition import POOL_PARTS, Study

if TYPE_CHECKING:
    import xarray

_LARGEST = 1e20  # mm, rad, or a factor


def open_study(path: str | os.PathLike) -> "xarray.Dataset":
    """Open the results of a study as an xarray dataset, read lazily; also while the study runs.

    Args:
        path: File of the study (HDF5).

    Returns:
        Variables ``(cell, trial)`` and ``(cell, trial, parameter)`` with the names, units and long names of the file;
        mm and rad. Cells carry the levels of the study's factors: of one factor as the dimension itself, of several as
        a MultiIndex, so that ``data.sel(bounds_length_mm=5)`` picks cells and ``data.unstack("cell")`` makes every
        factor a dimension. Trials not yet run are NaN, whole numbers -1 (``active`` -128).

    Raises:
        InputError: Where the file is missing, damaged or no study, or xarray is not installed.

    Example:
        >>> data = aj.study.open_study("study.h5")
        >>> print(data.de_stage1.mean("trial").values.round(4), "mm")
        [0.009  0.0098 0.0091 0.0091] mm
    """
    require("data", "open_study")
    import xarray

    opened = Results.of(path)
    study = opened.study
    if opened.stored.parts is not None:
        blocks = store.finished_blocks(opened.path, layout := opened.stored.layout)
        _allow_files(len(blocks), opened.path)
        for block in blocks:  # HDF5 will read them without looking at their digests
            store.check_block(opened.path, opened.stored, block, layout)
    with undamaged(path):
        data = xarray.open_dataset(opened.path, group="trials", engine="h5netcdf")
        columns = store.factor_columns(study)
        labels = {
            name: ("cell", np.asarray(v.values), {"units": v.units, "long_name": v.long_name})
            for name, v in columns.items()
        }
        nominal = ("parameter", np.asarray(study.space.vector()), {"long_name": "value in the nominal arm"})
        data = data.assign_coords(labels | {"nominal": nominal})
        if len(labels) == 1:
            data = data.swap_dims(cell=next(iter(labels)))
        elif labels:
            data = data.drop_vars("cell").set_index(cell=list(labels))
    data.attrs = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "finished": opened.finished,
        "specification": study.specification.model_dump_json(exclude_unset=True),
    }
    return data


def _allow_files(count: int, path: Path) -> None:
    """Allow so many open files: HDF5 opens all blocks at once, and shows those that it cannot open as not run."""
    try:
        import resource
    except ImportError:  # not a system with such limits
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + 200
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    except (ValueError, OSError) as error:  # over the hard limit, or over that of the system (macOS)
        raise InputError(
            f"{path} consists of {count} blocks, more files than this process may open; let the study end, or raise "
            "the limit (ulimit -n)."
        ) from error


def _check_sense(path: Path, rows: Mapping[str, np.ndarray]) -> None:
    """Raise `InputError` for results that no trial has; one that failed may have NaN or an infinite number.

    A converged trial may have NaN for what the study does not compute, such as k without reference lengths, but not
    for its parameters.
    """
    converged = rows["converged"] == 1
    floats = {name: values for name, values in rows.items() if values.dtype.kind == "f"}
    parameters = [floats[name][converged] for name in ("estimate", "true") if name in floats]
    check_sense(
        path,
        {
            "a result is larger than any can be": any(
                np.any(np.isfinite(x) & (np.abs(x) > _LARGEST)) for x in floats.values()
            ),
            "a trial that converged has an infinite result": any(
                np.any(np.isinf(x[converged])) for x in floats.values()
            ),
            "a trial that converged has a parameter without a number": any(np.any(np.isnan(x)) for x in parameters),
        },
    )


class Results(NamedTuple):
    """Results of a study, read cell by cell from its file; ``Results.of(path)`` opens it, also while the study runs.

    Example:
        >>> print(results.finished, results.study.factors)
        True {'bounds.length_mm': [5.0, 10.0], 'bounds.length_shift_mm': [0.0, 3.0]}
    """

    path: Path
    stored: store.StoredStudy

    @property
    def study(self) -> Study:
        """The study that was run."""
        return self.stored.study

    @property
    def finished(self) -> bool:
        """Whether every trial has run."""
        return self.stored.finished

    @classmethod
    def of(cls, path: str | os.PathLike) -> "Results":
        """Open a study.

        Args:
            path: File of the study (HDF5).

        Returns:
            Its results, for `cell_summary`, `study_summary` and the figures of `aacmm_jax.plot`.

        Raises:
            InputError: Where the file is missing, damaged or no study, or its folder of blocks is missing.
        """
        path = Path(os.path.realpath(as_path(path)))
        stored = store.read(path)
        store.check_parts(path, stored)
        store.check_results(path, stored)
        return cls(path, stored)

    def column(self, name: str, cell: int) -> np.ndarray:
        """One array of results of one cell (counted from 0)."""
        return self._columns([name], cell)[name]

    def columns(self, cell: int) -> dict[str, np.ndarray]:
        """Arrays of one cell with one number a trial; ``group`` is the part of the pool that a trial drew from."""
        found = self._columns([name for name, kind in VARIABLES.items() if not kind.by_parameter], cell)
        return found | {"group": np.arange(self.study.trials) % POOL_PARTS}

    def _columns(self, names: list[str], cell: int) -> dict[str, np.ndarray]:
        layout = self.stored.layout
        found = {name: np.full(layout.shape(name)[1:], fill_of(name), VARIABLES[name].dtype) for name in names}
        with undamaged(self.path):
            for part, rows in store.rows_of(self.path, self.stored, [*{*names, "converged"}], cell):
                _check_sense(self.path, rows)
                for name in names:
                    found[name][part] = rows[name]
        return found

    def errors(self, cell: int) -> Iterator[tuple[Float[np.ndarray, "t p"], np.ndarray, np.ndarray]]:
        """Of converged trials, some at a time: parameter errors (estimate minus truth), active bounds, groups."""
        with undamaged(self.path):
            for part, rows in store.rows_of(self.path, self.stored, ["converged", "estimate", "true", "active"], cell):
                _check_sense(self.path, rows)
                good = rows["converged"] == 1
                group = np.arange(part.start, part.stop) % POOL_PARTS
                yield (rows["estimate"] - rows["true"])[good], rows["active"][good], group[good]
