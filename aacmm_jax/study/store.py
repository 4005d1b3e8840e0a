"""The file of a study, its blocks until it is complete, and its results, whenever a process is killed.

The file holds what was asked from the beginning, and all results at the end. Until then each finished block is a file
of NumPy's arrays in ``FILE.parts``, written under a temporary name and renamed: it is there entirely or not at all, and
workers on a shared folder may write their blocks themselves. Their zip archives carry a checksum of every array.

Blocks are read only from a folder of the user who runs the study, or who owns the file that is read. The owner is
checked before anything in the folder is read or removed: only the owner can replace what has been checked.
"""

import contextlib
import hashlib
import io
import os
import shutil
import stat
import warnings
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core._compat import named_members
from ..core.errors import InputError
from ..core.file_owners import POSIX, is_ours, keeps_owners, others_may_write, user_name
from ..files.captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from ..files.hdf5 import Table, Variable, check_sense, columns, opened, read_tables, undamaged, write_tables
from ..files.inputs import InputFile
from ..files.outputs import ELSEWHERE, as_path, write_atomically
from ..kinematics.arm import parameter_unit
from ..solver.reason import Reason, numbers_of
from .blocks import DIMENSIONS, VARIABLES, Block, blocks_of
from .definition import POOL_PARTS, Study
from .specification import Specification, unit

_ADVICE = "free some disk space, then run the same command again (finished blocks are kept)"
_TRIALS_IN_MEMORY = 50_000
_LARGEST = 1e20  # mm, rad, or a factor
_BY_TRIAL = tuple(name for name, kind in VARIABLES.items() if not kind.by_parameter)


def parts_of(path: Path) -> Path:
    """Folder of the blocks of an unfinished study."""
    return path.with_name(path.name + ".parts")


def write_block(file: Path, results: Mapping[str, np.ndarray]) -> None:
    """Write a finished block: its file appears complete, or not at all."""
    content = io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(results[name]) for name in VARIABLES}
    np.savez(content, block=np.array(file.name), **arrays)
    with write_atomically(file, _ADVICE, leftovers=False) as temporary:
        temporary.chmod(temporary.stat().st_mode & ~0o022)  # whatever the umask: only the owner may change a block
        temporary.write_bytes(content.getbuffer())


@dataclass(frozen=True)
class Results:
    """Results of a study, read cell by cell from its file; ``Results.of(path)`` opens it, also while the study runs.

    Example:
        >>> print(results.finished, results.study.factors)
        True {'bounds.length_mm': [5.0, 10.0], 'bounds.length_shift_mm': [0.0, 3.0]}
    """

    path: Path
    study: Study
    chunk: int  # trials in a block
    computed_with: str
    finished: bool = False  # whether every trial has run: results are in the file then, before in blocks

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
        results = read(Path(os.path.realpath(as_path(path))))
        if not results.finished:
            results.finished_blocks()  # refuses those of somebody else
        else:
            with opened(results.path, ("study",), verify=False) as file:
                arrays = {name: file["trials"][name] for name in VARIABLES}
                shapes = any(array.shape != results.empty(name).shape for name, array in arrays.items())
                check_sense(results.path, {"the shapes of its results do not match its study": shapes})
                ran = (arrays["converged"][()] != VARIABLES["converged"].fill).all()
                check_sense(results.path, {"it contains trials that were not run": not ran})
        return results

    @cached_property
    def blocks(self) -> list[Block]:
        """All blocks, in order."""
        return blocks_of(self.study, self.chunk)

    @cached_property
    def mark(self) -> str:
        """How the names of its blocks begin: of this study, of this size, and of what it is computed with."""
        settings = hashlib.sha256(self.computed_with.encode()).hexdigest()
        return f"{self.study.digest[:12]}-{self.chunk}-{settings[:8]}"

    def file_of(self, block: Block) -> Path:
        """File of a block."""
        return parts_of(self.path) / f"{self.mark}-cell{block.first_cell:05d}-trial{block.first_trial:010d}.npz"

    def empty(self, name: str, *shape: int) -> np.ndarray:
        """An array of results of trials that have not run: of all cells and trials, or of so many."""
        kind = VARIABLES[name]
        shape = shape or (len(self.study.cells), self.study.trials)
        axes = (*shape, len(self.study.space.names)) if kind.by_parameter else shape
        return np.full(axes, kind.fill, kind.dtype)

    def finished_blocks(self) -> list[Block]:
        """Blocks whose files exist. Raises `InputError` where one is a link, or somebody else's."""
        folder = parts_of(self.path)
        names = {item.name for item in folder.glob("*.npz")} if folder.is_dir() else set()
        finished = [block for block in self.blocks if self.file_of(block).name in names]
        for block in finished:
            _check_block(self.file_of(block))
        return finished

    def of_block(self, block: Block) -> dict[str, np.ndarray]:
        """The arrays of a block. Raises `InputError` where its file is somebody else's, damaged or another block's."""
        file = self.file_of(block)
        _check_block(file)
        with undamaged(file), np.load(io.BytesIO(InputFile(file).content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in VARIABLES}
            shapes = any(array.shape != self.empty(name, *block.shape).shape for name, array in arrays.items())
            check_sense(file, {"it contains another block": str(archive["block"]) != file.name or shapes})
            return arrays

    def is_readable(self, block: Block) -> bool:
        """Whether the file of a block is as it was written."""
        try:
            return bool(self.of_block(block))
        except InputError:
            return False

    def column(self, name: str, cell: int) -> np.ndarray:
        """One array of results of one cell (counted from 0)."""
        return self.columns(cell, (name,))[name]

    def columns(self, cell: int, names: Sequence[str] = _BY_TRIAL) -> dict[str, np.ndarray]:
        """Arrays of one cell, by default those with one number a trial; ``group`` is the part of the pool that a trial
        drew from."""
        columns = {name: self.empty(name, self.study.trials) for name in names}
        for trials, rows in self._checked_rows({*names, "converged"}, cell):
            for name in names:
                columns[name][trials] = rows[name]
        return columns | {"group": np.arange(self.study.trials) % POOL_PARTS}

    def errors(self, cell: int) -> Iterator[tuple[Float[np.ndarray, "t p"], np.ndarray, np.ndarray]]:
        """Of converged trials, some at a time: parameter errors (estimate minus truth), active bounds, groups."""
        for trials, rows in self._checked_rows({"converged", "estimate", "true", "active"}, cell):
            good = rows["converged"] == 1
            group = np.arange(trials.start, trials.stop) % POOL_PARTS
            yield (rows["estimate"] - rows["true"])[good], rows["active"][good], group[good]

    def _checked_rows(self, names: Set[str], cell: int) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
        """Results of one cell, some trials at a time. Raises `InputError` for results that no trial has.

        A trial that failed may have NaN or an infinite number; a converged one NaN for what the study does not compute,
        such as k without reference lengths, but not for its parameters.
        """
        with undamaged(self.path):
            for trials, rows in self.rows(names, cell):
                floats = {name: values for name, values in rows.items() if values.dtype.kind == "f"}
                converged = {name: values[rows["converged"] == 1] for name, values in floats.items()}
                parameters = [converged[name] for name in ("estimate", "true") if name in converged]
                large = any(np.any(np.isfinite(x) & (np.abs(x) > _LARGEST)) for x in floats.values())
                infinite = any(np.any(np.isinf(x)) for x in converged.values())
                missing = any(np.any(np.isnan(x)) for x in parameters)
                problems = {
                    "a result is impossibly large": large,
                    "a trial that converged has an infinite result": infinite,
                    "a trial that converged has a parameter whose value is not a number": missing,
                }
                check_sense(self.path, problems)
                yield trials, rows

    def rows(self, names: Set[str], cell: int) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
        """Results of one cell as they are in the file or in the blocks: which trials, and their arrays."""
        if not self.finished:
            for block in self.finished_blocks():
                if block.first_cell <= cell < block.last_cell:
                    arrays = self.of_block(block)
                    yield block.slices[1], {name: arrays[name][cell - block.first_cell] for name in names}
            return
        with opened(self.path, ("study",), verify=False) as file:
            arrays = {name: file["trials"][name] for name in names}
            for first in range(0, self.study.trials, _TRIALS_IN_MEMORY):
                trials = slice(first, min(first + _TRIALS_IN_MEMORY, self.study.trials))
                yield trials, {name: arrays[name][cell, trials] for name in names}

    def create(self) -> None:
        """Make the file of a new study, and the folder of its blocks."""
        folder, _ = parts_of(self.path), self.blocks  # of which too many are refused
        try:
            folder.mkdir(mode=0o755, exist_ok=True)  # whatever the umask: only the owner may write blocks
            check_owners(self.path)
            for item in folder.glob("*.npz"):  # blocks of a study whose file was removed
                if not item.name.startswith(f"{self.mark}-"):
                    item.unlink()
            self._write(ELSEWHERE)
        except OSError as error:
            raise InputError(
                f"{folder} cannot be created: {(error.strerror or str(error)).lower()}; choose another output path."
            ) from error
        except BaseException:
            with contextlib.suppress(OSError):  # one with blocks is left as it is
                folder.rmdir()
            raise

    def finish(self) -> None:
        """Copy all blocks into the study's file, and remove their folder."""
        replace(self, finished=True)._write()
        shutil.rmtree(parts_of(self.path), ignore_errors=True)

    def _write(self, advice: str = _ADVICE) -> None:
        """Write the study's file, with all results once it is finished. ``advice``: what to do where it fails."""
        study = self.study
        attributes = {
            "name": study.specification.name,
            "seed": study.specification.seed,
            "digest": study.digest,
            "chunk": self.chunk,
            "computed_with": self.computed_with,
            "finished": int(self.finished),
            "parts": None if self.finished else parts_of(self.path).name,
        }
        names = list(study.space.names)
        parameter = columns("parameter", parameter=(names, "", "free parameter"))
        units = [parameter_unit(study.space.base, name) for name in names]
        nominal = (np.asarray(study.space.vector()), "mm or rad", "value in the nominal arm")
        cell = columns("cell", cell=(np.arange(1, len(study.cells) + 1), "1", "cell of the grid"))
        text = study.specification.model_dump_json(exclude_unset=True)
        tables = {
            "specification": Table(columns("line", text=([text], "", "specification as JSON"))),
            "cells": Table(cell | factor_columns(study)),
            "parameters": Table(
                parameter | columns("parameter", unit=(units, "", "unit of the parameter"), nominal=nominal)
            ),
        }
        if self.finished:
            trial = columns("trial", trial=(np.arange(1, study.trials + 1), "1", "trial in the cell"))
            tables["trials"] = Table(cell | trial | parameter)
        if study.recording is None:
            tables["nominal_arm"] = arm_table(study.nominal)
        else:
            tables |= recording_tables(study.recording._replace(nominal=study.nominal))
            attributes = dict(recording_attributes(study.recording)) | attributes
        extend = self._add_results if self.finished else None
        write_tables(self.path, "study", tables, attributes, extend=extend, advice=advice)

    def _add_results(self, file: Any) -> None:
        """Copy the results of all blocks into the open file of a study."""
        group = file["trials"]
        for name, kind in VARIABLES.items():
            dataset = group.create_dataset(name, self.empty(name).shape, kind.dtype)
            dataset.attrs["units"], dataset.attrs["long_name"] = kind.units, kind.long_name
            for axis, dimension in enumerate(DIMENSIONS[: dataset.ndim]):
                dataset.dims[axis].attach_scale(group[dimension])
        numbered = (f"{int(numbers_of(reason))}: {name}" for name, reason in named_members(Reason))
        group["reason"].attrs["reasons"] = ", ".join(numbered)
        for block in self.blocks:
            for name, values in self.of_block(block).items():
                group[name][block.slices] = values


def factor_columns(study: Study) -> dict[str, Variable]:
    """One column for each factor: its level in every cell."""
    sizes = [len(levels) for levels in study.factors.values()]
    index = np.indices(sizes).reshape(len(sizes), -1) if sizes else np.zeros((0, 1), dtype=int)
    by_name = {}
    for (name, levels), chosen in zip(study.factors.items(), index, strict=True):
        values = [levels[i] for i in chosen]
        by_name[name.replace(".", "_")] = (values, "" if isinstance(levels[0], str) else unit(name), name)
    return columns("cell", **by_name)


def read(path: Path) -> Results:
    """Read a study, but not its results. Raises `InputError` for a file that is missing, damaged or no study, and where
    the folder of its blocks is missing or somebody else's."""
    stored = read_tables(path, ("study",), without=("trials",))
    with undamaged(path):
        specification = Specification.model_validate_json(str(stored.tables["specification"]["text"][0]))
        nominal, attributes = specification_of(path, stored, "nominal_arm"), stored.attributes
        study = Study(specification, nominal, recording_of(path, stored) if "capture" in stored.tables else None)
        different = study.digest != attributes["digest"]
        check_sense(path, {"its specification does not match its results": different})
        parts = attributes.get("parts")
        results = Results(path, study, attributes["chunk"], attributes["computed_with"], finished=parts is None)
    if parts is None:
        return results
    if parts != parts_of(path).name:
        raise InputError(
            f"{path} was renamed, but its results are in {parts}; rename the file back to "
            f"{parts.removesuffix('.parts')}."
        )
    if not parts_of(path).is_dir():
        raise InputError(
            f"the results of {path} are in the folder {parts}, which is missing; put this folder next to the file."
        )
    check_owners(path, reading=True)
    return results


def check_owners(path: Path, *, reading: bool = False) -> None:
    """Raise `InputError` where a study that is to be run or continued is somebody else's, or its folder of blocks, or
    others may write there. Where it is only read, the folder may be of whoever owns the file."""
    folder = parts_of(path)
    for item in (folder,) if reading else (path, folder):
        status = _status(item)
        if status is None or is_ours(status):
            continue
        user = user_name(status.st_uid)
        if not reading:
            _refuse(item, f"{item} belongs to {user}, so the study is not continued; choose another output path.")
        elif status.st_uid != (owner := os.stat(path).st_uid):
            raise InputError(
                f"{folder} belongs to {user}, but {path.name} belongs to {user_name(owner)}, so the blocks are not "
                "read; make one user the owner of both."
            )
    status = _status(folder)
    if status is None:
        return
    if stat.S_ISLNK(status.st_mode):
        raise InputError(
            f"{folder} is a link, so the blocks in it are not read; put the folder itself there, or remove the link."
        )
    if others_may_write(status):
        _refuse(
            folder,
            f"other users may write to {folder} (mode {stat.S_IMODE(status.st_mode):04o}), so the blocks in it are "
            f"not read; if the blocks are yours, run chmod go-w '{folder}', otherwise remove the folder.",
        )


def _check_block(file: Path) -> None:
    """Raise `InputError` where a block is a link, or not the property of who owns its folder."""
    status = _status(file)
    if status is None or not POSIX:
        return
    what = "is a link" if stat.S_ISLNK(status.st_mode) else ""
    if not what and status.st_uid != os.stat(file.parent).st_uid:
        what = f"belongs to {user_name(status.st_uid)}, who is not the owner of its folder"
    if what:
        raise InputError(
            f"{file} {what}, so the block is not read; remove the file, and run the study again with --resume."
        )


def _refuse(path: Path, sentence: str) -> None:
    """Raise `InputError`, unless the file system keeps no owners: then a warning says that none are checked."""
    if keeps_owners(path.parent):
        raise InputError(sentence)
    warnings.warn(
        f"the file system of {path.parent} does not record who owns a file, so it cannot be checked whether somebody "
        "else wrote the blocks of this study.",
        UserWarning,
        stacklevel=3,
    )


def _status(path: Path) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
