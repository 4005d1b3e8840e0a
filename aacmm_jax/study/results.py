"""Results of a study, read from its file: labelled for users (`open_study`), and cell by cell for tables and plots."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.extras import require
from ..files.hdf5 import check_sense, undamaged
from ..files.outputs import as_path
from . import store
from .blocks import DIMENSIONS, VARIABLES, fill_of
from .definition import POOL_PARTS, Study

if TYPE_CHECKING:
    import xarray

_LARGEST = 1e20  # mm, rad, or a factor


def open_study(path: str | os.PathLike) -> "xarray.Dataset":
    """Open the results of a study as an xarray dataset: lazily, or whole where they are in blocks, as while it runs.

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

    results = Results.of(path)
    study, stored = results.study, results.stored
    with undamaged(path):
        if stored.parts is None:
            data = xarray.open_dataset(results.path, group="trials", engine="h5netcdf")
        else:
            arrays = _assembled(results)
            data = xarray.Dataset({name: (DIMENSIONS[: x.ndim], x, _words(name)) for name, x in arrays.items()})
            data = data.assign_coords(parameter=list(study.space.names))
        labels = {
            name: ("cell", np.asarray(column.values), {"units": column.units, "long_name": column.long_name})
            for name, column in store.factor_columns(study).items()
        }
        nominal = ("parameter", np.asarray(study.space.vector()), {"long_name": "value in the nominal arm"})
        data = data.assign_coords(labels | {"nominal": nominal})
        if len(labels) == 1:
            data = data.swap_dims(cell=next(iter(labels)))
        elif labels:
            data = data.drop_vars("cell", errors="ignore").set_index(cell=list(labels))
    data.attrs = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "finished": results.finished,
        "specification": study.specification.model_dump_json(exclude_unset=True),
    }
    return data


def _words(name: str) -> dict[str, str]:
    return {"units": VARIABLES[name].units, "long_name": VARIABLES[name].long_name}


def _assembled(results: "Results") -> dict[str, np.ndarray]:
    """The results of all blocks that are kept in their folder."""
    layout = results.stored.layout
    arrays = {name: np.full(layout.shape(name), fill_of(name), kind.dtype) for name, kind in VARIABLES.items()}
    for block in store.finished_blocks(results.path, layout):
        for name, values in store.read_part(results.path, block, layout).items():
            arrays[name][block.slices] = values
    return arrays


def _check_sense(path: Path, rows: Mapping[str, np.ndarray]) -> None:
    """Raise `InputError` for results that no trial has; one that failed may have NaN or an infinite number.

    A converged trial may have NaN for what the study does not compute, such as k without reference lengths, but not
    for its parameters.
    """
    converged = rows["converged"] == 1
    floats = {name: values for name, values in rows.items() if values.dtype.kind == "f"}
    parameters = [floats[name][converged] for name in ("estimate", "true") if name in floats]
    large = any(np.any(np.isfinite(x) & (np.abs(x) > _LARGEST)) for x in floats.values())
    infinite = any(np.any(np.isinf(x[converged])) for x in floats.values())
    check_sense(
        path,
        {
            "a result is larger than any can be": large,
            "a trial that converged has an infinite result": infinite,
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
        columns = self._columns([name for name, kind in VARIABLES.items() if not kind.by_parameter], cell)
        return columns | {"group": np.arange(self.study.trials) % POOL_PARTS}

    def _columns(self, names: list[str], cell: int) -> dict[str, np.ndarray]:
        layout = self.stored.layout
        arrays = {name: np.full(layout.shape(name)[1:], fill_of(name), VARIABLES[name].dtype) for name in names}
        for part, rows in self._rows([*{*names, "converged"}], cell):
            for name in names:
                arrays[name][part] = rows[name]
        return arrays

    def errors(self, cell: int) -> Iterator[tuple[Float[np.ndarray, "t p"], np.ndarray, np.ndarray]]:
        """Of converged trials, some at a time: parameter errors (estimate minus truth), active bounds, groups."""
        for part, rows in self._rows(["converged", "estimate", "true", "active"], cell):
            good = rows["converged"] == 1
            group = np.arange(part.start, part.stop) % POOL_PARTS
            yield (rows["estimate"] - rows["true"])[good], rows["active"][good], group[good]

    def _rows(self, names: list[str], cell: int) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
        with undamaged(self.path):
            for part, rows in store.rows_of(self.path, self.stored, names, cell):
                _check_sense(self.path, rows)
                yield part, rows
