"""Tables in HDF5 by the conventions of netCDF-4; nothing here depends on what they hold."""

import contextlib
import datetime
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
from .whole_file import ELSEWHERE, check_readable, storable, storable_name, whole_file

FORMAT = "aacmm_jax"


FORMAT_VERSION = 1


class Variable(NamedTuple):
    """One column or block of a table: the names of its dimensions, its values, its unit and what it is."""

    dimensions: tuple[str, ...]
    values: np.ndarray | Sequence
    units: str
    long_name: str


class Table(NamedTuple):
    """One HDF5 group: variables by name (one named like its only dimension is its coordinate), and attributes."""

    variables: dict[str, Variable]
    attributes: Mapping[str, Any] = MappingProxyType({})


def columns(dimension: str, **by_name: tuple[np.ndarray | Sequence, str, str]) -> dict[str, Variable]:
    """Variables over one dimension: values, unit and long name of each."""
    return {name: Variable((dimension,), *column) for name, column in by_name.items()}


def numbering(dimension: str, size: int, long_name: str | None = None) -> dict[str, Variable]:
    """The coordinate of a dimension that is numbered from 1."""
    return columns(dimension, **{dimension: (np.arange(1, size + 1), "1", long_name or f"{dimension} number")})


def axes(long_name: str = "axis") -> dict[str, Variable]:
    """The coordinate of the dimension of x, y and z."""
    return columns("axis", axis=(["x", "y", "z"], "", long_name))


def write_tables(
    path: str | os.PathLike,
    kind: str,
    tables: Mapping[str, Table],
    attributes: Mapping[str, Any],
    extend: Callable[[Any], None] | None = None,
    advice: str = ELSEWHERE,
    streamed: bool = False,
    summary: Mapping[str, Any] | None = None,
) -> None:
    """Write an HDF5 file of tables that netCDF-4 readers (xarray) understand. ``kind`` says what the file is.

    ``summary`` is what `read_summary` returns. ``extend`` is given the open file at the end, to add to it.
    ``streamed``: more than memory holds.
    """
    import h5py

    def fill(file: Any) -> None:
        _write_attributes(file, provenance(kind) | dict(attributes))
        for name, table in tables.items():
            _write_group(file.create_group(name, track_order=True), table)
        if summary is not None:
            file.create_dataset("summary", data=json.dumps(summary), dtype=h5py.string_dtype())
        if extend is not None:
            extend(file)

    with whole_file(path, advice) as temporary:
        if streamed:
            with _FailureKeepingFile(temporary) as stream:
                with h5py.File(stream, "w", track_order=True) as file:
                    fill(file)
                stream.check()
            return
        # HDF5 builds the file in memory and Python writes it: on a full disk the HDF5 library crashes the process.
        with h5py.File(temporary.name, "w", driver="core", backing_store=False, track_order=True) as file:
            fill(file)
            file.flush()
            image = file.id.get_file_image()
        temporary.write_bytes(image)


class _FailureKeepingFile:
    """A file that HDF5 writes to. Where a write fails (a full disk), the HDF5 library would crash the process: so the
    failure is kept, HDF5 is told of success, and `check` raises the failure. Interrupts must be blocked meanwhile."""

    def __init__(self, path: Path):
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115 - closed on exit
        self._failure: OSError | None = None
        self.seek, self.tell, self.read, self.readinto = (
            getattr(self._file, name) for name in ("seek", "tell", "read", "readinto")
        )

    def __enter__(self) -> "_FailureKeepingFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def check(self) -> None:
        """Raise what went wrong, if anything did."""
        if self._failure is not None:
            raise self._failure

    def _kept(self, work: Callable, given: Any) -> Any:
        if self._failure is None:
            try:
                return work(given)
            except OSError as failure:
                self._failure = failure
        return None

    def write(self, content: Any) -> int:
        """As a raw file's, but all is taken."""
        left = memoryview(content).cast("B")
        while len(left) and (taken := self._kept(self._file.write, left)):
            left = left[taken:]
        return len(content)

    def truncate(self, size: int | None = None) -> int:
        """As a raw file's."""
        self._kept(self._file.truncate, size)
        return size or 0

    def flush(self) -> None:
        """Nothing waits."""


def _versions() -> str:
    import platform
    from importlib import metadata

    others = (f"{name} {metadata.version(name)}" for name in ("jax", "equinox", "optimistix", "numpy"))
    return ", ".join([f"Python {platform.python_version()}", *others])


def provenance(kind: str) -> dict[str, Any]:
    """Root attributes of every file: what it is, and what made it."""
    from importlib import metadata

    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]) if sys.argv and sys.argv[0] else "python"
    return {
        "format": FORMAT,
        "kind": kind,
        "format_version": FORMAT_VERSION,
        "package_version": metadata.version("aacmm_jax"),
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": _versions(),
        "command": storable_name(command),  # arguments that are not UTF-8 arrive as surrogates
    }


def _write_attributes(item: Any, attributes: Mapping[str, Any]) -> None:
    for key, value in attributes.items():
        if value is not None:
            item.attrs[key] = _attribute(value)


def _attribute(value: Any) -> Any:
    if isinstance(value, list):
        return [_attribute(item) for item in value]
    return storable(str(value)) if isinstance(value, str) else value  # `str`: h5py cannot store NumPy's own


def _write_group(group: Any, table: Table) -> None:
    import h5py

    _write_attributes(group, table.attributes)
    for name, variable in table.variables.items():
        values = np.asarray(variable.values)
        text = not variable.units
        data = np.array([storable(str(value)) for value in values], dtype=object) if text else values
        options = {"compression": "gzip", "shuffle": True} if values.ndim and values.size > 1000 and not text else {}
        dataset = group.create_dataset(name, data=data, dtype=h5py.string_dtype() if text else None, **options)
        dataset.attrs["long_name"] = variable.long_name
        if not text:
            dataset.attrs["units"] = variable.units
        if variable.dimensions == (name,):
            dataset.make_scale(name)
    for name, variable in table.variables.items():
        for axis, dimension in enumerate(variable.dimensions):
            if dimension != name:
                group[name].dims[axis].attach_scale(group[dimension])


class Stored(NamedTuple):
    """What `read_tables` found: root attributes, and per group its arrays and attributes."""

    attributes: dict[str, Any]
    tables: dict[str, dict[str, np.ndarray]]
    table_attributes: dict[str, dict[str, Any]]


def read_tables(path: str | os.PathLike, kinds: Sequence[str], without: Sequence[str] = ()) -> Stored:
    """Read all tables of a file but those in ``without``.

    Raises `InputError` where the file is missing, damaged, of another program or kind, or of a newer version.
    """
    import h5py

    with _opened(path, kinds) as (file, attributes):
        groups = {name: group for name, group in file.items() if isinstance(group, h5py.Group) and name not in without}
        tables = {name: {key: _values(item) for key, item in group.items()} for name, group in groups.items()}
        table_attributes = {
            name: {key: _plain(value) for key, value in group.attrs.items()} for name, group in groups.items()
        }
    return Stored(attributes, tables, table_attributes)


def read_summary(path: str | os.PathLike, kinds: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The root attributes of a file, and the summary in it; None where none is stored, or by another version.

    Reading it takes none of the libraries that computing it takes. Raises `InputError` as `read_tables` does.
    """
    from importlib import metadata

    with _opened(path, kinds) as (file, attributes):
        current = attributes["package_version"] == metadata.version("aacmm_jax")
        text = file["summary"].asstr()[()] if current and "summary" in file else None
        return attributes, None if text is None else json.loads(text)


@contextlib.contextmanager
def _opened(path: str | os.PathLike, kinds: Sequence[str]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """The open file and its root attributes, where it is one of aacmm of a kind that is asked for."""
    import h5py

    path = Path(path)
    check_readable(path)
    if not h5py.is_hdf5(path):
        raise InputError(f"{path} is not an HDF5 file, or it is damaged; name a file written by aacmm.")
    with undamaged(path), h5py.File(path, "r") as file:
        attributes = {key: _plain(value) for key, value in file.attrs.items()}
        _check_kind(path, attributes, kinds)
        yield file, attributes


@contextlib.contextmanager
def undamaged(path: str | os.PathLike) -> Iterator[None]:
    """While the content of a file is interpreted: what fails there fails because the file was not written so."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # a single wrong byte surfaces as almost any exception of HDF5, h5py and NumPy
        raise InputError(f"{path} is damaged, cut short or was edited; make it again.") from error


def _check_kind(path: Path, attributes: Mapping[str, Any], kinds: Sequence[str]) -> None:
    wanted = " or ".join(kinds)
    if attributes.get("format") != FORMAT:
        raise InputError(f"{path} is HDF5, but was not written by aacmm; name a {wanted} file.")
    for name in ("created", "command", "package_version", "kind"):
        if not isinstance(attributes.get(name), str):
            raise InputError(f"{path} lacks the attribute '{name}'; it is damaged or was edited; make it again.")
    version = attributes["format_version"]
    if version > FORMAT_VERSION:
        raise InputError(
            f"{path} has format version {version}, newer than this package reads ({FORMAT_VERSION}); update aacmm_jax."
        )
    if attributes["kind"] not in kinds:
        article = "an" if attributes["kind"][:1] in "aeiou" else "a"
        raise InputError(f"{path} holds {article} {attributes['kind']}; name a {wanted} file.")


def need(path: str | os.PathLike, names: Mapping[str, Any], *needed: str, of: str = "table") -> None:
    """Raise `InputError` where a file lacks a table, or a table an entry."""
    for name in needed:
        if name not in names:
            raise InputError(f"{path} lacks the {of} '{name}'; it is damaged or was edited; make it again.")


def names_in(attribute: str | Sequence[str] | None) -> tuple[str, ...]:
    """The names that an attribute lists; files of version 0.1 have them in one string, with commas between."""
    if isinstance(attribute, str):
        return tuple(name for name in attribute.split(",") if name)
    return tuple(attribute or ())


def _values(dataset: Any) -> np.ndarray:
    return dataset.asstr()[()] if dataset.dtype.kind == "O" else dataset[()]


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    return value.item() if isinstance(value, np.generic) else value
