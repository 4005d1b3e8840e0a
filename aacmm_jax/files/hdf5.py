"""Tables in HDF5 by the conventions of netCDF-4; nothing here depends on what they hold."""

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
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..core.backend import check_backend, is_from_jax
from ..core.errors import InputError
from .atomic_write import ELSEWHERE, storable, write_atomically
from .inputs import STREAMED, largest_file, open_input, storable_name
from .reader_process import damaged, read_through, start, vouch_for

if TYPE_CHECKING:
    from .hdf5_content import Content

FORMAT = "aacmm_jax"
# Prismatic joints and joint corrections since 3; no SHA-256 of the logical content since 4; residuals and positions of
# sockets in calibrations since 5.
FORMAT_VERSION = 5
SEALED_SINCE = 2  # the first format version whose files end with a SHA-256 of their bytes
_DIGEST = "content_sha256"  # an attribute of files of versions 2 and 3
BLOCK = "block"  # kind of the files of a study's blocks, which carry no provenance of their own
_IN_MEMORY = 64 * 2**20  # bytes up to which a file is read at once, not in parts


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

    from .hdf5_content import seal

    def fill(file: Any) -> None:
        _write_attributes(file, provenance(kind) | dict(attributes))
        for name, table in tables.items():
            _write_group(file.create_group(name, track_order=True), table)
        if summary is not None:
            file.create_dataset("summary", data=json.dumps(summary), dtype=h5py.string_dtype())
        if extend is not None:
            extend(file)

    with write_atomically(path, advice, same_kind=lambda earlier: _is_of_kind(earlier, kind)) as temporary:
        if not streamed:
            temporary.write_bytes(file_image(fill))
            return
        with _FailureKeepingFile(temporary) as stream:
            with h5py.File(stream, "w", track_order=True) as file:
                fill(file)
            stream.check()
        with open(temporary, "rb+") as whole:
            vouch_for(seal(whole))


def file_image(fill: Callable[[Any], None]) -> bytes:
    """The bytes of an HDF5 file that ``fill`` fills, sealed.

    HDF5 builds it in memory and Python writes it: on a full disk the HDF5 library crashes the process.
    """
    import h5py

    from .hdf5_content import seal

    with h5py.File("image", "w", driver="core", backing_store=False, track_order=True) as file:
        fill(file)
        file.flush()
        image = io.BytesIO(file.id.get_file_image())
    vouch_for(seal(image))
    return image.getvalue()


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

    program = Path(sys.argv[0]).name if sys.argv and sys.argv[0] else "python"
    command = shlex.join(["aacmm" if program == "__main__.py" else program, *sys.argv[1:]])  # python -m aacmm_jax
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
    from .hdf5_content import attributes_of

    with opened(path, kinds) as content:
        groups = {name: group for name, group in content.groups() if name not in without}
        tables = {
            name: {key: content.values(group, key) for key in content.names(group)} for name, group in groups.items()
        }
        table_attributes = {name: attributes_of(content.file[name]) for name in groups}
    return Stored(content.attributes, tables, table_attributes)


def read_summary(path: str | os.PathLike, kinds: Sequence[str]) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """The root attributes of a file, and the summary in it; None where none is stored, or by another version.

    Reading it takes none of the libraries that computing it takes. Raises `InputError` as `read_tables` does.
    """
    from importlib import metadata

    with opened(path, kinds) as content:
        current = content.attributes["package_version"] == metadata.version("aacmm_jax")
        root = content.file.id
        text = content.values(root, "summary") if current and "summary" in content.names(root) else None
        return content.attributes, None if text is None else json.loads(str(text))


@contextlib.contextmanager
def opened(
    path: str | os.PathLike, kinds: Sequence[str], *, verify: bool = True, bare: bool = False
) -> Iterator["Content"]:
    """The content of a file, where it is one of aacmm of a kind that is asked for.

    ``verify=False``: this process has verified it before. ``bare``: a file without attributes is taken as it is.
    Raises `InputError` where it is damaged.
    """
    with open_input(path, STREAMED if "study" in kinds else 1) as stream, undamaged(path):
        size, largest = stream.seek(0, os.SEEK_END), largest_file()
        stream.seek(0)
        if stream.read(8) != b"\x89HDF\r\n\x1a\n":
            raise InputError(f"{path} is not an HDF5 file, or it is damaged; name a file written by aacmm.")
        stream.seek(0)
        source = stream.read() if size <= _IN_MEMORY else stream
        if verify and "h5py" not in sys.modules:
            start()  # which takes as long as the import here
        from .hdf5_content import content_of, seal_of

        seal = seal_of(io.BytesIO(source) if isinstance(source, bytes) else source) if verify else None
        if seal == "":
            raise InputError(f"{path} is damaged or was edited: its content does not match its SHA-256; make it again.")
        if verify:
            read_through(path, source, size, largest, seal)
        with content_of(path, source, size, largest) as content:
            if content.attributes or not bare:
                _check_kind(path, content.attributes, kinds)
                if verify and seal is None:
                    _check_version(path, content.attributes)
            yield content


def _check_version(path: str | os.PathLike, attributes: Mapping[str, Any]) -> None:
    """Raise `InputError` where a file without a seal is of a version that has one."""
    sealed = attributes["format_version"] >= SEALED_SINCE or attributes["kind"] == BLOCK
    if sealed or _DIGEST in attributes:
        raise InputError(
            f"{path} is damaged, was cut short or was written to by another program: the SHA-256 at its end is "
            "missing; name the file as aacmm wrote it, or make it again."
        )


@contextlib.contextmanager
def undamaged(path: str | os.PathLike) -> Iterator[None]:
    """While the content of a file is interpreted: what cannot be read there was not written so.

    What fails for another reason (no memory, a JAX that cannot start or is told to stop) says nothing about the file.
    """
    try:
        yield
    except (InputError, ImportError):
        raise
    except MemoryError as error:
        raise InputError(f"{path} cannot be read: this process has no memory left; free some.") from error
    except Exception as error:  # a single wrong byte surfaces as almost any exception of HDF5, h5py and NumPy
        check_backend()
        if is_from_jax(error) or isinstance(error, AssertionError | FloatingPointError):
            raise
        raise damaged(path) from error


def _is_of_kind(path: Path, kind: str) -> bool:
    """Whether a file can be read as one of a kind."""
    try:
        with opened(path, (kind,)):
            return True
    except InputError:
        return False


def _check_kind(path: str | os.PathLike, attributes: Mapping[str, Any], kinds: Sequence[str]) -> None:
    wanted = _with_article(" or ".join(kinds))
    if attributes.get("format") != FORMAT:
        raise InputError(f"{path} is HDF5, but was not written by aacmm; name {wanted} file.")
    for name in ("kind",) if kinds == (BLOCK,) else ("created", "command", "package_version", "kind"):
        if not isinstance(attributes.get(name), str):
            raise InputError(f"{path} lacks the attribute '{name}'; it is damaged or was edited; make it again.")
    version = attributes["format_version"]
    if not isinstance(version, int) or version < 1:
        raise InputError(f"{path} has the format version {version!r}; it is damaged or was edited; make it again.")
    if version > FORMAT_VERSION:
        raise InputError(
            f"{path} has format version {version}, newer than this package reads ({FORMAT_VERSION}); update aacmm_jax."
        )
    check_sense(path, {"the time of writing is no date": not _is_time(attributes.get("created"))})
    if attributes["kind"] not in kinds:
        raise InputError(f"{path} holds {_with_article(attributes['kind'])}; name {wanted} file.")


def _with_article(name: str) -> str:
    return f"{'an' if name[:1] in 'aeiou' else 'a'} {name}"


def _is_time(text: str | None) -> bool:
    try:
        return text is None or bool(datetime.datetime.fromisoformat(text))
    except ValueError:
        return False


def check_sense(path: str | os.PathLike, problems: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file make no sense: with the first of ``problems`` that is true."""
    for problem, found in problems.items():
        if found:
            raise InputError(f"{path} is damaged or was edited: {problem}; make it again.")


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
