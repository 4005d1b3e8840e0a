"""Results of a study, read from its file: labelled for users (`open_study`), and cell by cell for tables and figures."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .. import storage
from ..errors import InputError
from . import store
from .store import VARIABLES
from .study import BATCHES, Study

if TYPE_CHECKING:
    import xarray

_AT_ONCE = 50_000  # trials whose parameters are in memory


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
    with storage.undamaged(path):
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


class Results(NamedTuple):
    """A study's file for reading."""

    path: Path
    study: Study
    finished: bool

    @classmethod
    def of(cls, path: str | os.PathLike) -> "Results":
        """Raises `InputError` where the file is missing, damaged, no study, or has lost the folder of its blocks."""
        path = Path(path)
        kept = store.read(path)
        store.check_parts(path, kept)
        return cls(path, kept.study, kept.finished)

    def column(self, name: str, cell: int) -> np.ndarray:
        """One array of results of one cell (counted from 0)."""
        import h5py

        with storage.undamaged(self.path), h5py.File(self.path, "r") as file:
            trials: Any = file["trials"]
            return trials[name][cell]

    def columns(self, cell: int) -> dict[str, np.ndarray]:
        """Everything of one cell that is one number a trial; ``group`` is the pool that a trial drew from."""
        import h5py

        with storage.undamaged(self.path), h5py.File(self.path, "r") as file:
            trials: Any = file["trials"]
            found = {name: np.asarray(trials[name][cell]) for name, kind in VARIABLES.items() if not kind.by_parameter}
        return found | {"group": np.arange(self.study.trials) % BATCHES}

    def errors(self, cell: int) -> Iterator[tuple[Float[np.ndarray, "t p"], np.ndarray, np.ndarray]]:
        """Errors of the parameters of converged trials (estimate less truth), their active bounds and their groups, piece by piece."""
        import h5py

        with storage.undamaged(self.path), h5py.File(self.path, "r") as file:
            trials: Any = file["trials"]
            for first in range(0, self.study.trials, _AT_ONCE):
                part = slice(first, min(first + _AT_ONCE, self.study.trials))
                good = trials["converged"][cell, part] == 1
                error = (trials["estimate"][cell, part] - trials["true"][cell, part])[good]
                yield error, trials["active"][cell, part][good], (np.arange(part.start, part.stop) % BATCHES)[good]
