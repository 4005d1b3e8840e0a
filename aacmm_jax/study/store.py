"""The file of a study, and its blocks until it is complete, whenever a process is killed.

The file holds what was asked from the beginning, and all results at the end. Until then each finished block is a file
of NumPy's arrays in ``FILE.parts``, written under a temporary name and renamed: it is there entirely or not at all, and
workers on a shared folder may write their blocks themselves. Their zip archives carry a checksum of every array.

Believed are blocks in a folder of the user who runs the study, or who owns the file that is read. That is checked
before anything in the folder is read or removed: nobody but its owner can replace what has been checked.
"""

import contextlib
import glob
import io
import os
import shutil
import stat
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core._compat import named_members
from ..core.errors import InputError
from ..core.file_owners import POSIX, is_ours, keeps_owners, others_may_write, user_name
from ..files.captures import arm_table, recording_attributes, recording_of, recording_tables, specification_of
from ..files.hdf5 import Table, Variable, check_sense, columns, opened, read_tables, undamaged, write_tables
from ..files.inputs import InputFile
from ..files.outputs import ELSEWHERE, write_atomically
from ..kinematics.arm import parameter_unit
from .blocks import DIMENSIONS, VARIABLES, Block, Layout, fill_of, part_of, parts_of
from .definition import Study
from .specification import Specification, unit

_ADVICE = "free some space there, then run the same command again: what is finished is kept"
_TRIALS_IN_MEMORY = 50_000


def write_part(path: Path, block: Block, results: Mapping[str, np.ndarray], layout: Layout) -> None:
    """Write a finished block: its file appears complete, or not at all."""
    target, content = part_of(path, block, layout), io.BytesIO()
    arrays: dict[str, Any] = {name: np.asarray(results[name]) for name in VARIABLES}
    np.savez(content, block=np.array(target.name), **arrays)
    with write_atomically(target, _ADVICE, leftovers=False) as temporary:
        temporary.chmod(temporary.stat().st_mode & ~0o022)  # whatever the umask: nobody else may change a block
        temporary.write_bytes(content.getbuffer())


def read_part(path: Path, block: Block, layout: Layout) -> dict[str, np.ndarray]:
    """The arrays of a block. Raises `InputError` where its file is somebody else's, damaged or another block's."""
    file = part_of(path, block, layout)
    check_block(file)
    with undamaged(file), np.load(io.BytesIO(InputFile(file).content), allow_pickle=False) as archive:
        results = {name: archive[name] for name in VARIABLES}
        shapes = any(values.shape != layout.shape(name, *block.shape) for name, values in results.items())
        check_sense(file, {"it is another block": str(archive["block"]) != file.name or shapes})
        return results


def is_readable(path: Path, block: Block, layout: Layout) -> bool:
    """Whether a block's file is as it was written."""
    try:
        return bool(read_part(path, block, layout))
    except InputError:
        return False


def finished_blocks(path: Path, layout: Layout) -> list[Block]:
    """Blocks whose files exist. Raises `InputError` where one is a link, or somebody else's."""
    folder = parts_of(path)
    names = {item.name for item in folder.glob("*.npz")} if folder.is_dir() else set()
    finished = [block for block in layout.blocks() if part_of(path, block, layout).name in names]
    for block in finished:
        check_block(part_of(path, block, layout))
    return finished


def create(path: Path, study: Study, layout: Layout) -> None:
    """Make the file of a new study, and the folder of its blocks."""
    folder = parts_of(path)
    try:
        folder.mkdir(mode=0o755, exist_ok=True)  # whatever the umask: nobody else may write blocks
        check_ours(path)
        for item in folder.glob("*.npz"):  # blocks of a study whose file was removed
            if not item.name.startswith(f"{layout.mark}-"):
                item.unlink()
        _write(path, study, layout, finished=False, advice=ELSEWHERE)
    except OSError as error:
        raise InputError(
            f"{folder} cannot be created: {(error.strerror or str(error)).lower()}; choose another output path."
        ) from error
    except BaseException:
        with contextlib.suppress(OSError):  # one with blocks is left as it is
            folder.rmdir()
        raise


def finish(path: Path, study: Study, layout: Layout, keep_parts: bool = False) -> None:
    """Copy all blocks into the study's file and remove their folder; with ``keep_parts``, leave them as they are."""
    _write(path, study, layout, None if keep_parts else partial(_add_results, path, layout), finished=True)
    if not keep_parts:
        clean(path)


def _add_results(path: Path, layout: Layout, file: Any) -> None:
    """Copy the results of all blocks into the open file of a study."""
    from ..solver.reason import Reason, numbers_of

    group = file["trials"]
    for name, kind in VARIABLES.items():
        dataset = group.create_dataset(name, layout.shape(name), kind.dtype)
        dataset.attrs["units"], dataset.attrs["long_name"] = kind.units, kind.long_name
        for axis, dimension in enumerate(DIMENSIONS[: dataset.ndim]):
            dataset.dims[axis].attach_scale(group[dimension])
    numbered = (f"{int(numbers_of(reason))}: {name}" for name, reason in named_members(Reason))
    group["reason"].attrs["reasons"] = ", ".join(numbered)
    for block in layout.blocks():
        for name, values in read_part(path, block, layout).items():
            group[name][block.slices] = values


def clean(path: Path) -> None:
    """Remove the blocks of a finished study, which are now in its file."""
    shutil.rmtree(parts_of(path), ignore_errors=True)


def tidy(path: Path) -> None:
    """Remove the temporary files of killed processes."""
    for folder, name in ((path.parent, glob.escape(path.name)), (parts_of(path), "*")):
        for left in folder.glob(f".{name}.????????.part"):
            left.unlink(missing_ok=True)


def _write(
    path: Path,
    study: Study,
    layout: Layout,
    extend: Callable[[Any], None] | None = None,
    *,
    finished: bool,
    advice: str = _ADVICE,
) -> None:
    """Write the study's file; ``extend`` adds the results. ``advice``: what to do where it fails."""
    attributes = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "digest": study.digest,
        "chunk": layout.chunk,
        "computed_with": layout.computed_with,
        "finished": int(finished),
        "parts": parts_of(path).name if extend is None else None,
    }
    names = list(study.space.names)
    parameter = columns("parameter", parameter=(names, "", "free parameter"))
    units = [parameter_unit(study.space.base, name) for name in names]
    nominal = (np.asarray(study.space.vector()), "mm or rad", "value in the nominal arm")
    cell = columns("cell", cell=(np.arange(1, len(study.cells) + 1), "1", "cell of the grid"))
    trial = columns("trial", trial=(np.arange(1, study.trials + 1), "1", "trial in the cell"))
    text = study.specification.model_dump_json(exclude_unset=True)
    tables = {
        "specification": Table(columns("line", text=([text], "", "specification as JSON"))),
        "cells": Table(cell | factor_columns(study)),
        "parameters": Table(
            parameter | columns("parameter", unit=(units, "", "unit of the parameter"), nominal=nominal)
        ),
    }
    if extend is not None:
        tables["trials"] = Table(cell | trial | parameter)
    if study.recording is None:
        tables["nominal_arm"] = arm_table(study.nominal)
    else:
        tables |= recording_tables(study.recording._replace(nominal=study.nominal))
        attributes = dict(recording_attributes(study.recording)) | attributes
    write_tables(path, "study", tables, attributes, extend=extend, advice=advice)


def factor_columns(study: Study) -> dict[str, Variable]:
    """One column for each factor: its level in every cell."""
    sizes = [len(levels) for levels in study.factors.values()]
    index = np.indices(sizes).reshape(len(sizes), -1) if sizes else np.zeros((0, 1), dtype=int)
    by_name = {}
    for (name, levels), chosen in zip(study.factors.items(), index, strict=True):
        values = [levels[i] for i in chosen]
        by_name[name.replace(".", "_")] = (values, "" if isinstance(levels[0], str) else unit(name), name)
    return columns("cell", **by_name)


class StoredStudy(NamedTuple):
    """What a study's file contains, without the results."""

    study: Study
    layout: Layout  # how it is cut into blocks
    finished: bool
    parts: str | None  # folder of the blocks, where the results are in it


def read(path: Path) -> StoredStudy:
    """Read a study without its results. Raises `InputError` for a file that is missing, damaged or no study."""
    stored = read_tables(path, ("study",), without=("trials",))
    with undamaged(path):
        specification = Specification.model_validate_json(str(stored.tables["specification"]["text"][0]))
        nominal, attributes = specification_of(path, stored, "nominal_arm"), stored.attributes
        study = Study(specification, nominal, recording_of(path, stored) if "capture" in stored.tables else None)
        different = study.digest != attributes["digest"]
        check_sense(path, {"its specification does not match its results": different})
        layout = Layout.of(study, attributes["chunk"], attributes["computed_with"])
        return StoredStudy(study, layout, bool(attributes["finished"]), attributes.get("parts"))


def check_parts(path: Path, stored: StoredStudy) -> None:
    """Raise `InputError` where the results are in a folder of blocks that is missing or incomplete."""
    folder = parts_of(path)
    if stored.parts is None:
        return
    if stored.parts != folder.name:
        raise InputError(
            f"{path} was renamed, but its results are in {stored.parts}; rename it back to "
            f"{stored.parts.removesuffix('.parts')}."
        )
    if not folder.is_dir():
        raise InputError(
            f"{path} has its results in the folder {stored.parts}, which is missing; put it next to the file."
        )
    check_readable(path)
    layout = stored.layout
    missing = sum(1 for _ in layout.blocks()) - len(finished_blocks(path, layout))
    if stored.finished and missing:
        raise InputError(
            f"{missing} blocks are missing in {stored.parts}; put them there, or run the study again with --resume to "
            "make them."
        )


def check_results(path: Path, stored: StoredStudy) -> None:
    """Raise `InputError` where the results have other shapes, or a finished study has trials that did not run."""
    if stored.parts is not None:
        return
    layout = stored.layout
    with opened(path, ("study",), verify=False) as file:
        arrays = {name: file["trials"][name] for name in VARIABLES}
        shapes = any(array.shape != layout.shape(name) for name, array in arrays.items())
        check_sense(path, {"its results have other shapes than its study": shapes})
        ran = stored.finished and (arrays["converged"][()] != fill_of("converged")).all()
        check_sense(path, {"it has trials that did not run": not ran})


def rows_of(
    path: Path, stored: StoredStudy, names: Sequence[str], cell: int
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Results of one cell, some trials at a time: which trials, and their arrays."""
    layout = stored.layout
    if stored.parts is None:
        with opened(path, ("study",), verify=False) as file:
            trials = {name: file["trials"][name] for name in names}
            for first in range(0, layout.trials, _TRIALS_IN_MEMORY):
                part = slice(first, min(first + _TRIALS_IN_MEMORY, layout.trials))
                yield part, {name: trials[name][cell, part] for name in names}
        return
    for block in finished_blocks(path, layout):
        if block.first_cell <= cell < block.last_cell:
            results = read_part(path, block, layout)
            yield block.slices[1], {name: results[name][cell - block.first_cell] for name in names}


def check_ours(path: Path) -> None:
    """Raise `InputError` where a study that is to be run or continued is somebody else's, or its folder of blocks."""
    for item in (path, parts_of(path)):
        status = _status(item)
        if status is not None and not is_ours(status):
            _refuse(
                item,
                f"{item} belongs to {user_name(status.st_uid)}, so its results are not continued; choose another "
                "output path.",
            )
    _check_folder(parts_of(path))


def check_readable(path: Path) -> None:
    """Raise `InputError` where the blocks of a study that is read are neither ours nor those of who owns its file."""
    folder = parts_of(path)
    status = _status(folder)
    if status is None or not POSIX:
        return
    owner = os.stat(path).st_uid
    if status.st_uid != owner and not is_ours(status):
        raise InputError(
            f"{folder} belongs to {user_name(status.st_uid)}, but {path.name} to {user_name(owner)}, so its blocks are "
            "not read; have one user own both."
        )
    _check_folder(folder)


def check_block(file: Path) -> None:
    """Raise `InputError` where a block is a link, or not the property of who owns its folder."""
    status = _status(file)
    if status is None or not POSIX:
        return
    what = "is a link" if stat.S_ISLNK(status.st_mode) else ""
    if not what and status.st_uid != os.stat(file.parent).st_uid:
        what = f"belongs to {user_name(status.st_uid)}, who does not own its folder"
    if what:
        raise InputError(f"{file} {what}, so it is not read; remove it, and run the study again with --resume.")


def _check_folder(folder: Path) -> None:
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
            f"others may write to {folder} (mode {stat.S_IMODE(status.st_mode):04o}), so the blocks in it are not "
            f"read; if they are yours, run chmod go-w '{folder}', otherwise remove it.",
        )


def _refuse(path: Path, sentence: str) -> None:
    """Raise `InputError`, unless the file system says nothing of owners: then a warning says that none are checked."""
    if keeps_owners(path.parent):
        raise InputError(sentence)
    warnings.warn(
        f"the file system of {path.parent} does not keep who owns a file, so nothing shows whether somebody else wrote "
        "the blocks of this study.",
        UserWarning,
        stacklevel=3,
    )


def _status(path: Path) -> os.stat_result | None:
    try:
        return os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
