"""The file of a study: one HDF5 file that is complete at every moment, whenever a process is killed.

While a study runs, its file contains everything but the results, which are virtual: each finished block is a small file
in ``FILE.parts``, written under a temporary name and renamed, and the study's file shows all of them as one array
(trials not yet run as fill values). So nothing is ever appended to, a block is there entirely or not at all, and
workers on a shared folder may write their blocks themselves. At the end the blocks are copied, still compressed, into
one plain file.
"""

import contextlib
import glob
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core._compat import named_members
from ..core.errors import InputError
from ..data.recording import Recording
from ..files.atomic_write import ELSEWHERE, write_atomically
from ..files.captures import arm_table, recording_of, recording_tables, specification_of
from ..files.hdf5 import (
    BLOCK,
    FORMAT,
    FORMAT_VERSION,
    SEALED_SINCE,
    Table,
    Variable,
    check_sense,
    columns,
    file_image,
    need,
    numbering,
    opened,
    read_tables,
    undamaged,
    write_tables,
)
from ..kinematics.arm import parameter_unit
from .blocks import NOT_RUN, VARIABLES, Block, Layout, fill_of, part_of, parts_of
from .definition import Study
from .parts_folder import check_block as check_owner
from .parts_folder import check_ours, check_readable
from .specification import Specification, unit

_ADVICE = "free some space there, then run the same command again: what is finished is kept"
Packed = dict[str, bytes]
_TRIALS_IN_MEMORY = 50_000


def pack(results: Mapping[str, np.ndarray], layout: Layout) -> Packed:
    """Results as HDF5 stores them: bytes of equal significance together, then deflated.

    Run lengths only: the noise in the lower bytes cannot be compressed, and searching for matches takes twice the time.
    """
    packed = {}
    for name, values in results.items():
        whole = np.full(
            layout.shape(name, layout.block_cells, layout.block_trials), fill_of(name), VARIABLES[name].dtype
        )
        whole[: values.shape[0], : values.shape[1]] = values
        shuffled = np.ascontiguousarray(whole.reshape(-1).view(np.uint8).reshape(-1, whole.itemsize).T)
        compressor = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
        packed[name] = compressor.compress(shuffled.tobytes()) + compressor.flush()
    return packed


def write_part(path: Path, block: Block, packed: Packed, layout: Layout) -> None:
    """Write a finished block: its file appears complete, or not at all."""
    target = part_of(path, block, layout)

    def fill(file: Any) -> None:
        file.attrs.update(format=FORMAT, kind=BLOCK, format_version=FORMAT_VERSION, block=target.name)
        for name, content in packed.items():
            dataset = _dataset(file, name, layout, layout.shape(name, *block.shape))
            dataset.id.write_direct_chunk((0,) * dataset.ndim, content)

    with write_atomically(target, _ADVICE, leftovers=False) as temporary:
        temporary.chmod(temporary.stat().st_mode & ~0o022)  # whatever the umask: nobody else may change a block
        temporary.write_bytes(file_image(fill))


@contextlib.contextmanager
def _block(path: Path, block: Block, layout: Layout, bare: bool = False) -> Iterator[Mapping[str, Any]]:
    """The arrays of a block, after its SHA-256 was verified; ``bare``: it may be of format version 1, without one."""
    file = part_of(path, block, layout)
    check_owner(file)
    with opened(file, (BLOCK,), bare=bare) as content:
        check_sense(file, {"it is another block": content.attributes.get("block", file.name) != file.name})
        yield {name: content.dataset(content.file.id, name) for name in VARIABLES}


def _dataset(group: Any, name: str, layout: Layout, shape: tuple[int, ...]) -> Any:
    """An array of results, compressed, each block a chunk; resizable, as a chunk may not exceed a fixed size."""
    chunks = layout.shape(name, layout.block_cells, layout.block_trials)
    return group.create_dataset(
        name, shape, VARIABLES[name].dtype, chunks=chunks, maxshape=(None,) * len(shape), shuffle=True,
        compression="gzip", fillvalue=fill_of(name),
    )  # fmt: skip


def create(path: Path, study: Study, layout: Layout, chunk: int) -> None:
    """Make the file of a new study, and the folder of its blocks."""
    folder = parts_of(path)
    try:
        folder.mkdir(mode=0o755, exist_ok=True)  # whatever the umask: nobody else may write blocks
        with _removed_if_empty(folder):
            check_ours(path)
        for item in folder.glob("*.h5"):  # blocks of a study whose file was removed
            if not item.name.startswith(f"{layout.mark}-"):
                item.unlink()
    except OSError as error:
        raise InputError(
            f"{folder} cannot be created: {(error.strerror or str(error)).lower()}; choose another output path."
        ) from error

    with _removed_if_empty(folder):
        _write(path, study, chunk, partial(_add_virtual, path, layout), layout, finished=False, advice=ELSEWHERE)


@contextlib.contextmanager
def _removed_if_empty(folder: Path) -> Iterator[None]:
    """Whatever goes wrong, an empty folder is not left behind."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()
        raise


def _add_virtual(path: Path, layout: Layout, group: Any, name: str) -> Any:
    """An array of results that HDF5 assembles from the blocks whenever it is read."""
    import h5py

    virtual = h5py.VirtualLayout(layout.shape(name), VARIABLES[name].dtype)
    for block in layout.blocks():
        # HDF5 reads % as the beginning of a pattern.
        source = f"{parts_of(path).name}/{part_of(path, block, layout).name}".replace("%", "%%")
        virtual[block.slices] = h5py.VirtualSource(source, name, layout.shape(name, *block.shape))
    return group.create_virtual_dataset(name, virtual, fillvalue=fill_of(name))


def finish(path: Path, study: Study, layout: Layout, chunk: int, keep_parts: bool = False) -> None:
    """Copy all blocks into one plain file and remove their folder; with ``keep_parts``, leave them as they are."""
    if keep_parts:
        _write(path, study, chunk, partial(_add_virtual, path, layout), layout, finished=True)
        return

    def add_results(group: Any, name: str) -> Any:
        return _dataset(group, name, layout, layout.shape(name))

    def fill(group: Any) -> None:
        for block in layout.blocks():
            with _block(path, block, layout) as part:
                for name, source in part.items():
                    target = group[name]
                    mask, content = source.id.read_direct_chunk((0,) * source.ndim)
                    target.id.write_direct_chunk((block.first_cell, block.first_trial, 0)[: source.ndim], content, mask)

    with undamaged(parts_of(path)):
        _write(path, study, chunk, add_results, layout, fill, finished=True)
    clean(path)


def clean(path: Path) -> None:
    """Remove the blocks of a finished study, which are now in its file."""
    shutil.rmtree(parts_of(path), ignore_errors=True)


def tidy(path: Path) -> None:
    """Remove the temporary files of killed processes."""
    for folder, name in ((path.parent, path.name), (parts_of(path), "*")):
        for left in folder.glob(f".{glob.escape(name) if name != '*' else name}.????????.part"):
            left.unlink(missing_ok=True)


def _write(
    path: Path,
    study: Study,
    chunk: int,
    add_results: Callable,
    layout: Layout,
    fill: Callable | None = None,
    *,
    finished: bool,
    advice: str = _ADVICE,
) -> None:
    """Write the study's file: with ``fill`` a plain one, else a virtual one. ``advice``: what to do where it fails."""
    attributes = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "digest": study.digest,
        "chunk": chunk,
        "computed_with": layout.computed_with,
        "finished": int(finished),
        "parts": parts_of(path).name if fill is None else None,
    }

    def extend(file: Any) -> None:
        from ..solver.reason import Reason, numbers_of

        group = file["trials"]
        for name, kind in VARIABLES.items():
            dataset = add_results(group, name)
            dataset.attrs["units"], dataset.attrs["long_name"] = kind.units, kind.long_name
            for axis, dimension in enumerate(("cell", "trial", "parameter")[: dataset.ndim]):
                dataset.dims[axis].attach_scale(group[dimension])
        if fill is not None:
            fill(group)
        numbered = (f"{int(numbers_of(reason))}: {name}" for name, reason in named_members(Reason))
        group["reason"].attrs["reasons"] = ", ".join(numbered)

    write_tables(path, "study", _tables(study), attributes, extend, advice, streamed=fill is not None)


def _tables(study: Study) -> dict[str, Table]:
    names = list(study.space.names)
    units = [parameter_unit(study.space.base, name) for name in names]
    nominal = np.asarray(study.space.vector())
    text = study.specification.model_dump_json(exclude_unset=True)
    parameter = columns("parameter", parameter=(names, "", "free parameter"))
    tables = {
        "specification": Table(
            numbering("line", 1, "line") | columns("line", text=([text], "", "specification as JSON"))
        ),
        "cells": Table(numbering("cell", len(study.cells), "cell of the grid") | factor_columns(study)),
        "parameters": Table(
            parameter
            | columns(
                "parameter",
                unit=(units, "", "unit of the parameter"),
                nominal=(nominal, "mm or rad", "value in the nominal arm"),
            )
        ),
        "trials": Table(
            numbering("cell", len(study.cells), "cell of the grid, see group cells")
            | numbering("trial", study.trials, "trial in the cell")
            | parameter
        ),
    }
    if study.recording is not None:
        return tables | recording_tables(study.recording._replace(nominal=study.nominal))
    return tables | {"nominal_arm": arm_table(study.nominal)}


def factor_columns(study: Study) -> dict[str, Variable]:
    """One column for each factor: its level in every cell."""
    sizes = [len(levels) for levels in study.factors.values()]
    index = np.indices(sizes).reshape(len(sizes), -1) if sizes else np.zeros((0, 1), dtype=int)
    found = {}
    for (name, levels), chosen in zip(study.factors.items(), index, strict=True):
        text = isinstance(levels[0], str)
        values = [levels[i] for i in chosen]
        found[name.replace(".", "_")] = Variable(("cell",), values, "" if text else unit(name), name)
    return found


class StoredStudy(NamedTuple):
    """What a study's file contains, without the results."""

    study: Study
    chunk: int
    finished: bool
    parts: str | None  # folder of the blocks, where the results are in it
    package_version: str
    version: int  # of the file's format
    computed_with: str  # see `computed_with`; empty in files of earlier versions

    @property
    def layout(self) -> Layout:
        """How it is cut into blocks."""
        return Layout.of(self.study, self.chunk, (self.package_version, self.computed_with))


def read(path: Path) -> StoredStudy:
    """Read a study without its results. Raises `InputError` for a file that is missing, damaged or no study."""
    stored = read_tables(path, ("study",), without=("trials",))
    with undamaged(path):
        need(path, stored.tables, "specification", "nominal_arm", "parameters", "cells")
        specification = Specification.model_validate_json(str(stored.tables["specification"]["text"][0]))
        nominal = specification_of(path, stored, "nominal_arm")
        recording: Recording | None = recording_of(path, stored) if "capture" in stored.tables else None
        attributes = stored.attributes
        study = Study(specification, nominal, recording)
        if study.digest != attributes["digest"]:
            raise InputError(
                f"{path} is damaged or was edited: its specification does not match its results; make it again."
            )
        finished, parts = bool(attributes["finished"]), attributes.get("parts")
        made_by = attributes["package_version"], attributes["format_version"], attributes.get("computed_with", "")
        return StoredStudy(study, attributes["chunk"], finished, parts, *made_by)


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
    layout = stored.layout
    with opened(path, ("study",), verify=False) as content:
        arrays = {name: content.dataset(content.group("trials"), name) for name in VARIABLES}
        shapes = any(array.shape != layout.shape(name) for name, array in arrays.items())
        check_sense(path, {"its results have other shapes than its study": shapes})
        unrun = stored.parts is None and not (stored.finished and (arrays["converged"][()] != NOT_RUN).all())
        check_sense(path, {"it has trials that did not run": unrun})


def rows_of(
    path: Path, stored: StoredStudy, names: Sequence[str], cell: int
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Results of one cell, some trials at a time: which trials, and their arrays. One file is open at a time."""
    layout = stored.layout
    if stored.parts is None:
        with opened(path, ("study",), verify=False) as content:
            trials = {name: content.dataset(content.group("trials"), name) for name in names}
            for first in range(0, layout.trials, _TRIALS_IN_MEMORY):
                part = slice(first, min(first + _TRIALS_IN_MEMORY, layout.trials))
                yield part, {name: trials[name][cell, part] for name in names}
        return
    for block in _present(path, layout):
        if block.first_cell <= cell < block.last_cell:
            with _block(path, block, layout, stored.version < SEALED_SINCE) as arrays:
                found = {name: arrays[name][cell - block.first_cell] for name in names}
            yield block.slices[1], found


def check_block(path: Path, stored: StoredStudy, block: Block, layout: Layout) -> None:
    """Raise `InputError` where a block's file is damaged."""
    with _block(path, block, layout, stored.version < SEALED_SINCE):
        pass


def is_readable(path: Path, block: Block, layout: Layout) -> bool:
    """Whether a block's file is as it was written."""
    try:
        with _block(path, block, layout) as arrays:
            return all(arrays[name].shape == layout.shape(name, *block.shape) for name in VARIABLES)
    except InputError:
        return False


def finished_blocks(path: Path, layout: Layout) -> list[Block]:
    """Blocks whose files exist. Raises `InputError` where one is a link, or somebody else's."""
    finished = _present(path, layout)
    for block in finished:
        check_owner(part_of(path, block, layout))
    return finished


def _present(path: Path, layout: Layout) -> list[Block]:
    names = {item.name for item in parts_of(path).glob("*.h5")} if parts_of(path).is_dir() else set()
    return [block for block in layout.blocks() if part_of(path, block, layout).name in names]
