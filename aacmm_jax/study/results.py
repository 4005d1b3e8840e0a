"""Results of a study, read from its file: labelled for users (`open_study`), and cell by cell for tables and figures."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..files.hdf5 import undamaged
from . import store
from .definition import BATCHES, Study
from .store import VARIABLES

if TYPE_CHECKING:
    import xarray


def open_study(path: str | os.PathLike) -> "xarray.Dataset":
    """Results of a study as an xarray dataset, read when used: ``(cell, trial)`` and ``(cell, trial, parameter)``.

    Cells carry the levels of the study's factors: of one factor as the dimension itself, of several as a MultiIndex. So
    ``data.sel(bounds_length_mm=5)`` picks cells, and ``data.unstack("cell")`` makes every factor a dimension. Names, units
    and long names are those of the file. A study that is running may be opened: trials not yet run are NaN, whole numbers -1 (``active`` -128).
    Raises `InputError` where the file is missing, damaged or no study, or xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise InputError("open_study needs xarray; install it with: pip install 'aacmm_jax[data]'.") from error
    opened = Results.of(path)
    study = opened.study
    if opened.kept.parts is not None:
        _allow_files(len(store.finished_blocks(opened.path, store.Layout.of(study, opened.kept.chunk))), opened.path)
    with undamaged(path):
        data = xarray.open_dataset(opened.path, group="trials", engine="h5netcdf")
        columns = store.factor_columns(study)
        labels = {
            name: ("cell", np.asarray(v.values), {"units": v.units, "long_name": v.long_name}) for name, v in columns.items()
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
    """HDF5 opens the files of all blocks at once, and shows those that it may not open as not run: so see to it that it may."""
    try:
        import resource
    except ImportError:  # not a system with such limits
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = count + 200
    if soft != resource.RLIM_INFINITY and soft < needed:
        if hard != resource.RLIM_INFINITY and hard < needed:
            raise InputError(
                f"{path} lies in {count} blocks, more files than this process may open ({hard}); let the study end, or raise the limit."
            )
        resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))


class Results(NamedTuple):
    """A study's file for reading."""

    path: Path
    kept: store.Kept

    @property
    def study(self) -> Study:
        """What was asked."""
        return self.kept.study

    @property
    def finished(self) -> bool:
        """Whether every trial is there."""
        return self.kept.finished

    @classmethod
    def of(cls, path: str | os.PathLike) -> "Results":
        """Raises `InputError` where the file is missing, damaged, no study, or has lost the folder of its blocks."""
        path = Path(path).resolve()
        kept = store.read(path)
        store.check_parts(path, kept)
        return cls(path, kept)

    def column(self, name: str, cell: int) -> np.ndarray:
        """One array of results of one cell (counted from 0)."""
        return self._columns([name], cell)[name]

    def columns(self, cell: int) -> dict[str, np.ndarray]:
        """Everything of one cell that is one number a trial; ``group`` is the pool that a trial drew from."""
        found = self._columns([name for name, kind in VARIABLES.items() if not kind.by_parameter], cell)
        return found | {"group": np.arange(self.study.trials) % BATCHES}

    def _columns(self, names: list[str], cell: int) -> dict[str, np.ndarray]:
        found = {name: np.full(self.study.trials, store.fill_of(name), VARIABLES[name].dtype) for name in names}
        with undamaged(self.path):
            for part, rows in store.rows_of(self.path, self.kept, names, cell):
                for name in names:
                    found[name][part] = rows[name]
        return found

    def errors(self, cell: int) -> Iterator[tuple[Float[np.ndarray, "t p"], np.ndarray, np.ndarray]]:
        """Errors of the parameters of converged trials (estimate less truth), their active bounds and their groups, piece by piece."""
        with undamaged(self.path):
            for part, rows in store.rows_of(self.path, self.kept, ["converged", "estimate", "true", "active"], cell):
                good = rows["converged"] == 1
                yield (
                    (rows["estimate"] - rows["true"])[good],
                    rows["active"][good],
                    (np.arange(part.start, part.stop) % BATCHES)[good],
                )
