"""Where results are kept: one HDF5 file that is whole at every moment, whatever is killed.

While a study runs, its file holds everything but the results, which are virtual: each finished block is a small file of its
own in ``FILE.parts``, written beside its name and renamed, and the study's file shows them as one array (trials not yet run
as fill values). So nothing is ever appended to, a block is there wholly or not at all, and workers on a shared folder may
write their blocks themselves. At the end the blocks are copied, still compressed, into one plain file.
"""

import contextlib
import glob
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import InputError
from ..data.recording import Recording
from ..files.captures import arm_table, recording_of, recording_tables, specification_of
from ..files.hdf5 import Table, Variable, need, read_tables, undamaged, write_tables
from ..files.whole_file import ELSEWHERE, whole_file
from ..kinematics.arm import is_length
from .definition import Block, Setting, Study
from .specification import Specification, unit

_MEND = "free some space there, then run the same command again: what is finished is kept"
MOST_BLOCKS = 1_000_000
NOT_RUN = -1  # of whole numbers; NaN of others, and -128 of active, where -1 is a bound


class _Kind(NamedTuple):
    """One array of results: its type, whether it has an axis for the parameters, its unit, what it is."""

    dtype: str
    by_parameter: bool
    units: str
    long_name: str


VARIABLES = {
    "converged": _Kind("i1", False, "1", "1 where every solve ended at a minimum, 0 where not, -1 not yet run"),
    "reason": _Kind("i1", False, "1", "why the last solve ended, see attribute reasons"),
    "steps": _Kind("i4", False, "1", "evaluations of all solves"),
    "k": _Kind("f8", False, "1", "k = measured / nominal, from the reference lengths"),
    "scale": _Kind(
        "f8", False, "1", "how much too large stage 1 left the arm: its lengths over the true ones, by least squares"
    ),
    "scale_error": _Kind("f8", False, "1", "the same factor less 1, after the scale fix"),
    "de_stage1": _Kind("f8", False, "mm", "DE after stage 1"),
    "deltam_stage1": _Kind("f8", False, "mm", "Deltam after stage 1"),
    "length_error_stage1": _Kind("f8", False, "mm", "largest error of a length parameter after stage 1"),
    "angle_error_stage1": _Kind("f8", False, "rad", "largest error of an angle parameter after stage 1"),
    "de": _Kind("f8", False, "mm", "DE, mean distance of poses from their socket's centroid, after the scale fix"),
    "deltam": _Kind("f8", False, "mm", "Deltam, largest half range of a coordinate in a socket, after the scale fix"),
    "length_error": _Kind("f8", False, "mm", "largest error of a length parameter after the scale fix"),
    "angle_error": _Kind("f8", False, "rad", "largest error of an angle parameter after the scale fix"),
    "truth_inside": _Kind("i1", False, "1", "1 where the true arm lies inside the bounds"),
    "active": _Kind("i1", True, "1", "-1 on the lower bound, +1 on the upper, 0 inside, -128 not yet run"),
    "estimate": _Kind("f8", True, "mm or rad", "identified parameters, at the end"),
    "true": _Kind("f8", True, "mm or rad", "parameters of the true arm"),
}


def fill_of(name: str) -> float:
    """What stands for a trial that has not run."""
    return np.nan if VARIABLES[name].dtype == "f8" else -128 if name == "active" else NOT_RUN


class Layout(NamedTuple):
    """How results are cut up: blocks of some cells (all of them whole) or of some trials of one cell."""

    cells: int
    trials: int
    parameters: int
    block_cells: int
    block_trials: int
    mark: str  # in the names of the blocks: they belong to this study, cut up so, computed by this version

    @classmethod
    def of(cls, study: Study, chunk: int) -> "Layout":
        """Blocks of about ``chunk`` trials. Small cells share a block where one program serves them all."""
        cells, trials = len(study.cells), study.trials
        if len(study.cells) * -(-trials // chunk) > MOST_BLOCKS:
            raise InputError(
                f"chunks of {chunk} cut {cells} cells of {trials:,} trials into more than {MOST_BLOCKS:,} blocks; give larger ones."
            )
        mark = f"{study.digest[:12]}-{chunk}-{metadata.version('aacmm_jax')}"
        together = 1
        if trials < chunk:
            together = max(n for n in range(1, min(max(chunk // trials, 1), cells) + 1) if _uniform(study.settings, n))
        # Blocks of nearly one size: a short last one would run the same compiled program for less.
        return cls(cells, trials, len(study.space.names), together, -(-trials // -(-trials // chunk)), mark)

    def shape(self, name: str, cells: int | None = None, trials: int | None = None) -> tuple[int, ...]:
        """Shape of an array of results, of the whole study or of a part."""
        shape = (self.cells if cells is None else cells, self.trials if trials is None else trials)
        return (*shape, self.parameters) if VARIABLES[name].by_parameter else shape

    def blocks(self) -> Iterator[Block]:
        """All blocks, in their order."""
        for cell in range(0, self.cells, self.block_cells):
            for trial in range(0, self.trials, self.block_trials):
                last = min(trial + self.block_trials, self.trials)
                yield Block(cell, min(cell + self.block_cells, self.cells), trial, last)


def _uniform(settings: list[Setting], together: int) -> bool:
    """Whether runs of so many cells are each of one setting."""
    return all(len(set(settings[i : i + together])) == 1 for i in range(0, len(settings), together))


def parts_of(path: Path) -> Path:
    """Folder of the blocks of a study that runs."""
    return path.with_name(path.name + ".parts")


def part_of(path: Path, block: Block, layout: Layout) -> Path:
    """File of one block."""
    return parts_of(path) / f"{layout.mark}-cell{block.first_cell:05d}-trial{block.first_trial:010d}.h5"


Packed = dict[str, bytes]
_AT_ONCE = 50_000  # trials in memory


def pack(results: Mapping[str, np.ndarray], layout: Layout) -> Packed:
    """Results as HDF5 stores them: bytes of like significance together, then deflated (run lengths only: the noise in the lower bytes
    cannot be compressed, and looking for more takes twice the time)."""
    packed = {}
    for name, values in results.items():
        whole = np.full(layout.shape(name, layout.block_cells, layout.block_trials), fill_of(name), VARIABLES[name].dtype)
        whole[: values.shape[0], : values.shape[1]] = values
        shuffled = np.ascontiguousarray(whole.reshape(-1).view(np.uint8).reshape(-1, whole.itemsize).T)
        press = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, zlib.DEF_MEM_LEVEL, zlib.Z_RLE)
        packed[name] = press.compress(shuffled.tobytes()) + press.flush()
    return packed


def write_part(path: Path, block: Block, packed: Packed, layout: Layout) -> None:
    """Keep a finished block: its file appears whole, or not at all."""
    import h5py

    with whole_file(part_of(path, block, layout), _MEND) as temporary:
        with h5py.File(temporary.name, "w", driver="core", backing_store=False) as file:
            for name, content in packed.items():
                size = (block.last_cell - block.first_cell, block.last_trial - block.first_trial)
                dataset = _dataset(file, name, layout, layout.shape(name, *size))
                dataset.id.write_direct_chunk((0,) * dataset.ndim, content)
            file.flush()
            image = file.id.get_file_image()
        temporary.write_bytes(image)


def _dataset(group: Any, name: str, layout: Layout, shape: tuple[int, ...]) -> Any:
    """An array of results, compressed, each block a chunk; resizable, since a chunk may not exceed a fixed size."""
    chunks = layout.shape(name, layout.block_cells, layout.block_trials)
    return group.create_dataset(
        name, shape, VARIABLES[name].dtype, chunks=chunks, maxshape=(None,) * len(shape), shuffle=True, compression="gzip",
        fillvalue=fill_of(name),
    )  # fmt: skip


def create(path: Path, study: Study, layout: Layout, chunk: int) -> None:
    """The file of a study that begins, and the folder of its blocks."""
    folder = parts_of(path)
    try:
        folder.mkdir(exist_ok=True)
        for item in folder.glob("*.h5"):  # of a study whose file is gone
            if not item.name.startswith(f"{layout.mark}-"):
                item.unlink()
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made: {(error.strerror or str(error)).lower()}; choose another output path."
        ) from error

    try:
        _write(path, study, chunk, partial(_add_virtual, path, layout), finished=False, mend=ELSEWHERE)
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # only where it is empty
        raise


def _add_virtual(path: Path, layout: Layout, group: Any, name: str) -> Any:
    """An array of results that is put together from the blocks whenever it is read."""
    import h5py

    virtual = h5py.VirtualLayout(layout.shape(name), VARIABLES[name].dtype)
    for block in layout.blocks():
        cells, trials = slice(block.first_cell, block.last_cell), slice(block.first_trial, block.last_trial)
        size = layout.shape(name, cells.stop - cells.start, trials.stop - trials.start)
        # HDF5 reads % as the beginning of a pattern.
        source = f"{parts_of(path).name}/{part_of(path, block, layout).name}".replace("%", "%%")
        virtual[cells, trials] = h5py.VirtualSource(source, name, size)
    return group.create_virtual_dataset(name, virtual, fillvalue=fill_of(name))


def finish(path: Path, study: Study, layout: Layout, chunk: int, keep_parts: bool = False) -> None:
    """All blocks copied into one plain file, and their folder removed; or, ``keep_parts``, left as they are."""
    import h5py

    if keep_parts:
        _write(path, study, chunk, partial(_add_virtual, path, layout), finished=True)
        return

    def add_results(group: Any, name: str) -> Any:
        return _dataset(group, name, layout, layout.shape(name))

    def fill(group: Any) -> None:
        for block in layout.blocks():
            with h5py.File(part_of(path, block, layout), "r") as part:
                for name in VARIABLES:
                    source: Any = part[name]
                    target = group[name]
                    mask, content = source.id.read_direct_chunk((0,) * source.ndim)
                    target.id.write_direct_chunk((block.first_cell, block.first_trial, 0)[: source.ndim], content, mask)

    with undamaged(parts_of(path)):
        _write(path, study, chunk, add_results, fill, finished=True)
    clean(path)


def clean(path: Path) -> None:
    """Remove the blocks of a finished study, which its file now holds."""
    shutil.rmtree(parts_of(path), ignore_errors=True)


def tidy(path: Path) -> None:
    """Remove what a killed process left unfinished: files that never got their name."""
    for folder, name in ((path.parent, path.name), (parts_of(path), "*")):
        for left in folder.glob(f".{glob.escape(name) if name != '*' else name}.????????.part"):
            left.unlink(missing_ok=True)


def _write(
    path: Path,
    study: Study,
    chunk: int,
    add_results: Callable,
    fill: Callable | None = None,
    *,
    finished: bool,
    mend: str = _MEND,
) -> None:
    """Write the study's file: with ``fill`` a plain one, else a virtual one."""
    attributes = {
        "name": study.specification.name,
        "seed": study.specification.seed,
        "digest": study.digest,
        "chunk": chunk,
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
        members = [(name, getattr(Reason, name)) for name in Reason._name_to_item if name]  # pyright: ignore
        group["reason"].attrs["reasons"] = ", ".join(f"{int(numbers_of(item))}: {name}" for name, item in members)

    write_tables(path, "study", _tables(study), attributes, extend, mend, streamed=fill is not None)


def _tables(study: Study) -> dict[str, Table]:
    names = list(study.space.names)
    number = lambda name, size, text: Variable((name,), np.arange(1, size + 1), "1", text)  # noqa: E731
    units = ["mm" if is_length(name) else "rad" for name in names]
    nominal = np.asarray(study.space.vector())
    tables = {
        "specification": Table(
            {
                "line": Variable(("line",), np.arange(1, 2), "1", "line"),
                "text": Variable(
                    ("line",), [study.specification.model_dump_json(exclude_unset=True)], "", "specification as JSON"
                ),
            }
        ),
        "cells": Table({"cell": number("cell", len(study.cells), "cell of the grid")} | factor_columns(study)),
        "parameters": Table(
            {
                "parameter": Variable(("parameter",), names, "", "free parameter"),
                "unit": Variable(("parameter",), units, "", "unit of the parameter"),
                "nominal": Variable(("parameter",), nominal, "mm or rad", "value in the nominal arm"),
            }
        ),
        "trials": Table(
            {
                "cell": number("cell", len(study.cells), "cell of the grid, see group cells"),
                "trial": number("trial", study.trials, "trial in the cell"),
                "parameter": Variable(("parameter",), names, "", "free parameter"),
            }
        ),
    }
    if study.recording is not None:
        return tables | recording_tables(study.recording._replace(nominal=study.nominal))
    return tables | {"nominal_arm": arm_table(study.nominal)}


def factor_columns(study: Study) -> dict[str, Variable]:
    """One column for each factor, its level in every cell."""
    sizes = [len(levels) for levels in study.factors.values()]
    index = np.indices(sizes).reshape(len(sizes), -1) if sizes else np.zeros((0, 1), dtype=int)
    columns = {}
    for (name, levels), chosen in zip(study.factors.items(), index, strict=True):
        text = isinstance(levels[0], str)
        values = [levels[i] for i in chosen]
        columns[name.replace(".", "_")] = Variable(("cell",), values, "" if text else unit(name), name)
    return columns


class Kept(NamedTuple):
    """What a study's file says of itself."""

    study: Study
    chunk: int
    finished: bool
    parts: str | None  # the folder of the blocks, where the results lie in it
    package_version: str


def read(path: Path) -> Kept:
    """The study that a file holds, without its results. Raises `InputError` where it is missing, damaged or no study."""
    stored = read_tables(path, ("study",), without=("trials",))
    with undamaged(path):
        need(path, stored.tables, "specification", "nominal_arm", "parameters", "cells")
        specification = Specification.model_validate_json(str(stored.tables["specification"]["text"][0]))
        nominal = specification_of(path, stored, "nominal_arm")
        recording: Recording | None = recording_of(path, stored) if "capture" in stored.tables else None
        attributes = stored.attributes
        study = Study(specification, nominal, recording)
        if study.digest != attributes["digest"]:
            raise InputError(f"{path} is damaged or was edited: its specification does not match its results; make it again.")
        return Kept(
            study, attributes["chunk"], bool(attributes["finished"]), attributes.get("parts"), attributes["package_version"]
        )


def check_parts(path: Path, kept: Kept) -> None:
    """Raise `InputError` where results lie in a folder of blocks that is not there."""
    if kept.parts is None:
        return
    if kept.parts != parts_of(path).name:
        raise InputError(
            f"{path} was renamed, but its results lie in {kept.parts}; give it its name {kept.parts.removesuffix('.parts')} again."
        )
    if not parts_of(path).is_dir():
        raise InputError(f"{path} has its results in the folder {kept.parts}, which is not beside it; put it there.")
    layout = Layout.of(kept.study, kept.chunk)
    missing = sum(1 for _ in layout.blocks()) - len(finished_blocks(path, layout))
    if kept.finished and missing:
        raise InputError(
            f"{missing} blocks are missing in {kept.parts}; put them there, or run the study again with --resume to make them."
        )


def rows_of(path: Path, kept: Kept, names: Sequence[str], cell: int) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Results of one cell, piece by piece: which trials, and their arrays. One file is open at a time, however many blocks there are."""
    import h5py

    layout = Layout.of(kept.study, kept.chunk)
    if kept.parts is None:
        with h5py.File(path, "r") as file:
            trials: Any = file["trials"]
            for first in range(0, layout.trials, _AT_ONCE):
                part = slice(first, min(first + _AT_ONCE, layout.trials))
                yield part, {name: trials[name][cell, part] for name in names}
        return
    there = {item.name for item in parts_of(path).glob("*.h5")}
    for block in layout.blocks():
        if block.first_cell <= cell < block.last_cell and part_of(path, block, layout).name in there:
            with h5py.File(part_of(path, block, layout), "r") as file:
                arrays: Any = file
                found = {name: arrays[name][cell - block.first_cell] for name in names}
            yield slice(block.first_trial, block.last_trial), found


def sound(path: Path, block: Block, layout: Layout) -> bool:
    """Whether the file of a block can be read to the last bit (deflated arrays carry a checksum)."""
    import h5py

    try:
        with h5py.File(part_of(path, block, layout), "r") as file:
            arrays: Any = file
            for name in VARIABLES:
                zlib.decompress(arrays[name].id.read_direct_chunk((0,) * arrays[name].ndim)[1])
    except Exception:  # a wrong byte surfaces as almost anything
        return False
    return True


def finished_blocks(path: Path, layout: Layout) -> list[Block]:
    """Blocks whose files are there."""
    names = {item.name for item in parts_of(path).glob("*.h5")} if parts_of(path).is_dir() else set()
    return [block for block in layout.blocks() if part_of(path, block, layout).name in names]
