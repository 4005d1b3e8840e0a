"""Tables in HDF5 after the conventions of netCDF-4, written whole or not at all, and read only when they are intact.

What tables hold is declared by `records`; whether the bytes of a file can be trusted is looked into by `hdf5_content`.
"""

import contextlib
import datetime
import io
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from ..core.errors import InputError
from ..core.jax_setup import check_backend, is_from_jax
from .inputs import STREAMED, largest_file, open_input, storable_name
from .outputs import ELSEWHERE, storable, write_atomically
from .reader_process import damaged, read_through, start, vouch_for

FORMAT = "aacmm_jax"
FORMAT_VERSION = 6  # fields are declared since 6, and earlier files are refused
_IN_MEMORY = 64 * 2**20  # bytes up to which a file is read at once, not in parts


class Variable(NamedTuple):
    """An array of a table: the names of its dimensions, its values, its unit and what it is.

    Text and truth values have no unit.
    """

    dimensions: tuple[str, ...]
    values: np.ndarray | Sequence
    units: str
    long_name: str


class Table(NamedTuple):
    """One HDF5 group: variables by name, and attributes.

    A variable named like its only dimension is the coordinate of it; dimensions without one are numbered from 1.
    """

    variables: dict[str, Variable]
    attributes: Mapping[str, Any] = MappingProxyType({})


def columns(dimension: str, **by_name: tuple[np.ndarray | Sequence, str, str]) -> dict[str, Variable]:
    """Variables over one dimension: values, unit and long name of each."""
    return {name: Variable((dimension,), *column) for name, column in by_name.items()}


def write_tables(
    path: str | os.PathLike,
    kind: str,
    tables: Mapping[str, Table],
    attributes: Mapping[str, Any],
    *,
    summary: Mapping[str, Any] | None = None,
    extend: Callable[[Any], None] | None = None,
    advice: str = ELSEWHERE,
) -> None:
    """Write an HDF5 file of tables that netCDF-4 readers (xarray) understand. ``kind`` says what the file is.

    ``summary`` is what `read_summary` returns. ``extend`` is given the open file at the end, to add to it more than
    memory holds; interrupts must be blocked meanwhile. ``advice`` says what to do where the file cannot be written.
    """
    import h5py

    from .hdf5_content import seal

    def fill(file: Any) -> None:
        _write_attributes(file, provenance(kind) | dict(attributes))
        for name, table in tables.items():
            _write_group(file.create_group(name, track_order=True), table)
        if summary is not None:
            file.create_dataset("summary", data=json.dumps(summary), dtype=h5py.string_dtype())
        if extend is not None:
            extend(file)

    def is_of_kind(earlier: Path) -> bool:
        with contextlib.suppress(InputError), opened(earlier, (kind,)):
            return True
        return False

    with write_atomically(path, advice, same_kind=is_of_kind) as temporary:
        if extend is None:
            # Python writes the bytes, since the HDF5 library crashes the process on a full disk.
            with h5py.File("image", "w", driver="core", backing_store=False, track_order=True) as file:
                fill(file)
                file.flush()
                temporary.write_bytes(file.id.get_file_image())
        else:
            with _PatientFile(temporary, "w+b") as stream:
                with h5py.File(stream, "w", track_order=True) as file:
                    fill(file)
                if stream.failure is not None:
                    raise stream.failure
        with open(temporary, "rb+") as whole:
            vouch_for(seal(whole))


class _PatientFile(io.FileIO):
    """A file for the HDF5 library, which crashes the process where a write fails (a full disk): it is told of success,
    and the first failure is kept."""

    failure: OSError | None = None

    def write(self, content: Any) -> int:
        left = memoryview(content).cast("B")
        try:
            while len(left) and self.failure is None:
                left = left[super().write(left) :]
        except OSError as failure:
            self.failure = failure
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as failure:
            self.failure = self.failure or failure
            return size or 0


def provenance(kind: str) -> dict[str, Any]:
    """Root attributes of every file: what it is, and what made it."""
    import platform
    from importlib import metadata

    program = Path(sys.argv[0]).name if sys.argv and sys.argv[0] else "python"
    command = shlex.join(["aacmm" if program == "__main__.py" else program, *sys.argv[1:]])  # python -m aacmm_jax
    libraries = (f"{name} {metadata.version(name)}" for name in ("jax", "equinox", "optimistix", "numpy"))
    return {
        "format": FORMAT,
        "kind": kind,
        "format_version": FORMAT_VERSION,
        "package_version": metadata.version("aacmm_jax"),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": ", ".join([f"Python {platform.python_version()}", *libraries]),
        "command": storable_name(command),  # arguments that are not UTF-8 arrive as surrogates
    }


def _write_attributes(item: Any, attributes: Mapping[str, Any]) -> None:
    """Attributes that are None are left out; HDF5 has no empty lists, which are "" instead."""
    for name, value in attributes.items():
        entries = value if isinstance(value, tuple | list) else [value]
        # `str`: h5py cannot store NumPy's own texts.
        entries = [storable(str(entry)) if isinstance(entry, str) else entry for entry in entries]
        if value is not None:
            item.attrs[name] = entries[0] if not isinstance(value, tuple | list) else entries or ""


def _write_group(group: Any, table: Table) -> None:
    import h5py

    _write_attributes(group, table.attributes)
    coordinates: dict[str, Variable] = {}
    for variable in table.variables.values():
        for dimension, size in zip(variable.dimensions, np.shape(variable.values), strict=True):
            if dimension in table.variables:
                continue
            first = dimension.removesuffix("_2")
            says = first if first == dimension else f"{first}, second axis"
            if first == "axis":
                coordinate = Variable((dimension,), ["x", "y", "z"], "", says)
            elif first in table.variables:
                coordinate = table.variables[first]._replace(dimensions=(dimension,), long_name=says)
            else:
                coordinate = Variable((dimension,), np.arange(1, size + 1), "1", f"{says} number")
            coordinates[dimension] = coordinate
    variables = coordinates | table.variables
    for name, variable in variables.items():
        values = np.asarray(variable.values)
        truth = values.dtype.kind == "b"
        text = values.dtype.kind in "OU" or not (truth or variable.units)
        options: dict[str, Any] = {"data": values.astype(np.int8) if truth else values}
        if text:
            texts = np.array([storable(str(value)) for value in values], dtype=object)
            options = {"data": texts, "dtype": h5py.string_dtype()}
        elif values.ndim and values.size > 1000:
            options |= {"compression": "gzip", "shuffle": True}
        dataset = group.create_dataset(name, **options)
        dataset.attrs["long_name"] = variable.long_name
        if truth:
            dataset.attrs["dtype"] = "bool"  # how xarray marks truth values, which netCDF-4 lacks
        elif not text:
            dataset.attrs["units"] = variable.units
        if variable.dimensions == (name,):
            dataset.make_scale(name)
    for name, variable in variables.items():
        for axis, dimension in enumerate(variable.dimensions):
            if dimension != name:
                group[name].dims[axis].attach_scale(group[dimension])


class Entries(dict[str, Any]):
    """What a file holds, by name. What is missing is an `InputError` that names it."""

    def __init__(self, path: str | os.PathLike, what: str, items: Mapping[str, Any]):
        super().__init__(items)
        self.path, self._what = path, what

    def __missing__(self, name: str) -> Any:
        raise InputError(
            f"{self.path} has no {self._what} '{name}', so the file is damaged or was edited; create it again."
        )


class StoredTable(Entries):
    """Arrays of a table by name, and its attributes."""

    def __init__(self, path: str | os.PathLike, arrays: Mapping[str, np.ndarray], attributes: Mapping[str, Any]):
        super().__init__(path, "entry", arrays)
        self.attributes = Entries(path, "attribute", attributes)


class Stored(NamedTuple):
    """The attributes of a file, and a `StoredTable` by name."""

    attributes: Entries
    tables: Entries


def read_tables(path: str | os.PathLike, kinds: Sequence[str], without: Sequence[str] = ()) -> Stored:
    """Read all tables of a file but those in ``without``.

    Raises `InputError` where the file is missing, damaged, of another program or kind, or of another version.
    """
    from .hdf5_content import attributes_of, values_of

    with opened(path, kinds) as file:
        groups = {name: group for name, group in file.items() if hasattr(group, "keys") and name not in without}
        size = sum(data.size * data.dtype.itemsize for group in groups.values() for data in group.values())
        if size > largest_file():
            raise InputError(
                f"{path} contains arrays of {size / 2**20:,.0f} MiB, more than the limit for reading; give another "
                "file."
            )
        tables = {
            name: StoredTable(path, {key: values_of(data) for key, data in group.items()}, attributes_of(group))
            for name, group in groups.items()
        }
        attributes = Entries(path, "attribute", attributes_of(file))
    return Stored(attributes, Entries(path, "table", tables))


def read_summary(path: str | os.PathLike, kinds: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The root attributes of a file, and the summary in it; None where none is stored, or by another version.

    Reading it takes none of the libraries that computing it takes. Raises `InputError` as `read_tables` does.
    """
    from importlib import metadata

    from .hdf5_content import attributes_of, values_of

    with opened(path, kinds) as file:
        attributes = attributes_of(file)
        current = attributes["package_version"] == metadata.version("aacmm_jax") and "summary" in file
        return attributes, json.loads(str(values_of(file["summary"]))) if current else None


@contextlib.contextmanager
def opened(path: str | os.PathLike, kinds: Sequence[str], *, verify: bool = True) -> Iterator[Any]:
    """A file of aacmm (`h5py.File`), of a kind that is asked for.

    A file without the right SHA-256 at its end is never given to the HDF5 library. ``verify=False``: this process has
    verified it before. Raises `InputError` where it is damaged.
    """
    with open_input(path, STREAMED if "study" in kinds else 1) as stream, undamaged(path):
        size, largest = stream.seek(0, os.SEEK_END), largest_file()
        stream.seek(0)
        if stream.read(8) != b"\x89HDF\r\n\x1a\n":
            raise InputError(f"{path} is not an HDF5 file or is damaged; give a file written by aacmm.")
        stream.seek(0)
        source = stream.read() if size <= _IN_MEMORY else stream
        if verify and "h5py" not in sys.modules:
            start()  # which takes as long as the import here
        from .hdf5_content import attributes_of, file_of, seal_of

        wanted = _with_article(" or ".join(kinds))
        if verify:
            seal = seal_of(io.BytesIO(source) if isinstance(source, bytes) else source)
            if seal is None:
                raise InputError(
                    f"{path} does not end with the SHA-256 that aacmm writes, so it is incomplete or damaged, was "
                    f"changed by another program, or was not written by aacmm; give {wanted} file that aacmm wrote, or "
                    "create it again."
                )
            if not seal:
                raise InputError(
                    f"{path} is damaged or was edited: its content does not match its SHA-256; create it again."
                )
            read_through(path, source, size, largest, seal)
        with file_of(source) as file:
            _check_kind(Entries(path, "attribute", attributes_of(file)), kinds, wanted)
            yield file


@contextlib.contextmanager
def undamaged(path: str | os.PathLike) -> Iterator[None]:
    """While the content of a file is interpreted: what cannot be read there was not written so.

    What fails for another reason (no memory, a JAX that cannot start or is told to stop) is no fault of the file.
    """
    try:
        yield
    except (InputError, ImportError):
        raise
    except MemoryError as error:
        raise InputError(
            f"{path} cannot be read: the process has run out of memory; free some memory and try again."
        ) from error
    except Exception as error:  # a single wrong byte surfaces as almost any exception of HDF5, h5py and NumPy
        check_backend()
        if is_from_jax(error) or isinstance(error, AssertionError | FloatingPointError):
            raise
        raise damaged(path) from error


def _check_kind(attributes: Entries, kinds: Sequence[str], wanted: str) -> None:
    path, version = attributes.path, attributes.get("format_version")
    texts = [attributes[name] for name in ("format", "created", "command", "package_version", "kind")]
    check_sense(
        path,
        {
            "an attribute that must be text has another type": not all(isinstance(text, str) for text in texts),
            "the format is unknown": attributes["format"] != FORMAT,
            f"its format version is {version!r}": not isinstance(version, int) or version < 1,
            "the time of writing is not a date": not is_moment(attributes["created"]),
        },
    )
    if version != FORMAT_VERSION:
        later = isinstance(version, int) and version > FORMAT_VERSION
        what = "newer" if later else "older"
        todo = "update aacmm_jax" if later else "create it again with this version from the manifest or the capture"
        raise InputError(
            f"{path} has format version {version}, {what} than the version that this package reads ({FORMAT_VERSION}); "
            f"{todo}."
        )
    if attributes["kind"] not in kinds:
        raise InputError(f"{path} contains {_with_article(attributes['kind'])}; give {wanted} file.")


def _with_article(name: str) -> str:
    return f"{'an' if name[:1] in 'aeiou' else 'a'} {name}"


def is_moment(text: str) -> bool:
    """Whether a text is a date, or a date and a time, after ISO 8601."""
    try:
        return bool(datetime.datetime.fromisoformat(text))
    except ValueError:
        return False


def check_sense(path: str | os.PathLike, problems: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file make no sense: with the first of ``problems`` that is true."""
    for problem, present in problems.items():
        if present:
            raise InputError(f"{path} is damaged or was edited: {problem}; create it again.")
