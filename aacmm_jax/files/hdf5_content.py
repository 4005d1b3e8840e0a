"""What an HDF5 file contains, read without following it anywhere else, and the SHA-256 by which damage is detected.

The seal, some bytes after the end of what HDF5 reads, is the SHA-256 of all bytes before it. It detects damage and is
no signature: whoever changes a file on purpose can compute it again. So `reader_process` reads everything in a file
once, by `Content.check`, before anything of it is used.
"""

import contextlib
import hashlib
import math
import os
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from ..core.errors import InputError

_LOW: Any = h5py  # whose type hints lack some of its modules
_SEAL = b"\naacmm_jax: SHA-256 of all bytes before this line: %s\n"
_SEAL_SIZE = len(_SEAL % (64 * b"0"))
# An honest file's arrays exceed its size little; a few repeated numbers are compressed a thousand times.
_ALWAYS_READ, _MOST_COMPRESSED = 64 * 2**20, 100
_BUFFER = 16 * 2**20  # bytes of an array that are read at a time
# Numbers, truth values (an enumeration) and text; no compound, reference or array types, nor lists of lists.
_TYPES = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)


def seal(stream: Any) -> str:
    """Append the SHA-256 of all bytes of a file that is open for reading and writing; returns it."""
    stream.seek(0)
    digest = hashlib.file_digest(stream, "sha256").hexdigest()
    stream.seek(0, os.SEEK_END)
    stream.write(_SEAL % digest.encode())
    return digest


def seal_of(stream: Any) -> str | None:
    """The SHA-256 at the end of a file: empty where it is not that of all bytes before, None where there is none."""
    left = stream.seek(0, os.SEEK_END) - _SEAL_SIZE
    if left < 0:
        return None
    stream.seek(left)
    last = stream.read()
    if not last.startswith(_SEAL[: _SEAL.index(b"%")]):  # most files of other origin are not read whole
        return None
    stream.seek(0)
    sha256 = hashlib.sha256()
    while left and (part := stream.read(min(left, 2**20))):
        sha256.update(part)
        left -= len(part)
    digest = sha256.hexdigest()
    return digest if last == _SEAL % digest.encode() else ""


@contextlib.contextmanager
def content_of(path: str | os.PathLike, source: Any, size: int, largest: int) -> "Iterator[Content]":
    """The content of a file in memory, or of one that is open for reading."""
    with h5py.File(h5py.h5f.open_file_image(source) if isinstance(source, bytes) else source, "r") as file:
        yield Content(path, file, size, largest)


class Content:
    """The content of an open HDF5 file: groups of arrays of numbers or text, and their attributes.

    Whatever leads out of the file is refused (soft and external links, external storage, virtual arrays), and so is
    what no file of this package has: groups within groups, compound and reference types, and arrays that claim to be
    much larger than the file, of ``size`` bytes; ``largest`` is the most bytes that may be read into memory.
    """

    def __init__(self, path: str | os.PathLike, file: Any, size: int, largest: int):
        self.path, self.file = path, file
        self.attributes = attributes_of(file)
        self._credible = _ALWAYS_READ + _MOST_COMPRESSED * size
        self._left = min(largest, self._credible)
        self._texts_at_once = max(1, self._credible // size)

    def _refuse(self, name: str, what: str) -> InputError:
        return InputError(f"{self.path}: '{name}' is {what}, which is not read; name a file written by aacmm.")

    def _too_large(self, name: str, item: Any) -> InputError:
        sizes = " x ".join(map(str, item.shape)) or "1"
        return self._refuse(name, f"an array of {sizes}, far more than the file contains")

    def names(self, group: Any) -> list[str]:
        """Names in a group, in their order."""
        return [name.decode() for name in group]

    def groups(self) -> Iterator[tuple[str, Any]]:
        """Every group with its name."""
        for name in self.names(self.file.id):
            item = self._item(self.file.id, name)
            if isinstance(item, h5py.h5g.GroupID):
                yield name, item

    def _item(self, group: Any, name: str) -> Any:
        if group.links.get_info(name.encode()).type != _LOW.h5l.TYPE_HARD:
            raise self._refuse(name, "a link to something else")
        return _LOW.h5o.open(group, name.encode())

    def array(self, group: Any, name: str) -> Any:
        """The identifier of an array, of which everything that is not data has been checked."""
        item = self._item(group, name)
        if not isinstance(item, h5py.h5d.DatasetID):
            raise self._refuse(name, "not an array")
        properties = item.get_create_plist()
        if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
            raise self._refuse(name, "stored in another file")
        self._check_type(name, item.get_type())
        return item

    def dataset(self, group: str, name: str) -> Any:
        """An array as an `h5py.Dataset`, to be read in parts."""
        return h5py.Dataset(self.array(dict(self.groups())[group], name))

    def values(self, group: Any, name: str) -> np.ndarray:
        """An array, read whole; texts are str, and what xarray marks as truth values is bool."""
        item = self.array(group, name)
        shape, kind = item.shape, item.dtype
        self._left -= math.prod(shape) * kind.itemsize
        if self._left < 0:
            raise self._too_large(name, item)
        if h5py.check_string_dtype(kind):
            return self._texts(item, name)
        values = _read(item, shape, kind)
        return values.astype(bool) if h5py.Dataset(item).attrs.get("dtype") == "bool" else values

    def _texts(self, item: Any, name: str) -> np.ndarray:
        """Some at a time: many may refer to the same bytes of the file."""
        texts: Any = h5py.Dataset(item).asstr()
        if len(item.shape) > 1:
            raise self._refuse(name, "a table of texts in several dimensions")
        if not item.shape:
            return np.asarray(texts[()], dtype=object)
        parts = [np.empty(0, dtype=object)]
        for first in range(0, item.shape[0], self._texts_at_once):
            parts.append(texts[first : first + self._texts_at_once])
            self._left -= sum(map(len, parts[-1]))
            if self._left < 0:
                raise self._too_large(name, item)
        return np.concatenate(parts)

    def check(self) -> None:
        """Read everything once that a reader of the file may read: raise where HDF5 cannot, or it is not allowed."""
        root = self.file.id
        self._check_attributes(root, read=False)  # as they have been
        for name in self.names(root):
            item = self._item(root, name)
            if not isinstance(item, h5py.h5g.GroupID):
                self._check_array(root, name)
                continue
            self._check_attributes(item)
            for inner in self.names(item):
                self._check_array(item, inner)

    def _check_array(self, group: Any, name: str) -> None:
        item = self.array(group, name)
        self._check_attributes(item)
        shape, kind = item.shape, item.dtype
        declared = math.prod(shape) * kind.itemsize
        if declared > self._credible:
            raise self._too_large(name, item)
        if h5py.check_string_dtype(kind) and math.prod(shape) > self._texts_at_once:
            self._texts(item, name)
        elif declared <= _BUFFER:
            _read(item, shape, kind)
        else:
            step = max(1, _BUFFER * shape[0] // declared)
            for first in range(0, shape[0], step):
                h5py.Dataset(item)[first : first + step]

    def _check_attributes(self, item: Any, read: bool = True) -> None:
        for index in range(h5py.h5a.get_num_attrs(item)):
            attribute = h5py.h5a.open(item, index=index)
            name, shape, kind = attribute.name.decode(), attribute.shape, attribute.dtype
            if name not in ("DIMENSION_LIST", "REFERENCE_LIST"):  # by which HDF5 attaches scales
                self._check_type(name, attribute.get_type())
            if math.prod(shape) * kind.itemsize > self._credible:
                raise self._too_large(name, attribute)
            if read and math.prod(shape):
                attribute.read(np.empty(shape, kind))

    def _check_type(self, name: str, kind: Any) -> None:
        if kind.get_class() not in _TYPES:
            raise self._refuse(name, "of a type that no file of aacmm has")


def attributes_of(item: Any) -> dict[str, Any]:
    """The attributes of a file, a group or an array, in types of Python."""
    return {name: _plain(value) for name, value in item.attrs.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    return value.item() if isinstance(value, np.generic) else value


def _read(item: Any, shape: tuple[int, ...], kind: np.dtype) -> np.ndarray:
    """An array as HDF5 reads it: numbers, or texts as bytes."""
    values = np.empty(shape, kind)
    if values.size:
        item.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values
