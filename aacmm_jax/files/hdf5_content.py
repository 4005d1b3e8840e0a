"""What an HDF5 file contains, checked before anything of it is used, and the SHA-256 by which damage is detected.

The seal, some bytes after the end of what HDF5 reads, is the SHA-256 of all bytes before it. It detects damage and is
no signature: whoever changes a file on purpose can compute it again. So `check` reads everything in a file once, in the
process of `reader_process`; what it has passed is then read plainly.
"""

import hashlib
import math
import os
from typing import Any

import h5py
import numpy as np

from ..core.errors import InputError

_LOW: Any = h5py  # whose type hints lack some of its modules
_SEAL = b"\naacmm_jax: SHA-256 of all bytes before this line: %s\n"
_SEAL_SIZE = len(_SEAL % (64 * b"0"))
# The arrays of a file that aacmm wrote exceed its size little; a few repeated numbers are compressed a thousand times.
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


def file_of(source: Any) -> h5py.File:
    """A file in memory, or one that is open for reading."""
    return h5py.File(h5py.h5f.open_file_image(source) if isinstance(source, bytes) else source, "r")


def check(path: str, source: Any, size: int, largest: int) -> None:
    """Read everything in a file of ``size`` bytes once: raise where HDF5 cannot, or it is not allowed (`InputError`).

    Whatever leads out of the file is refused (soft and external links, external storage, virtual arrays), and so is
    what no file of this package has: groups within groups, compound and reference types, and arrays that claim to be
    much larger than the file. ``largest`` is the most bytes that may be read into memory.
    """
    with file_of(source) as file:
        checked, root = _Check(path, size, largest), file.id
        checked.attributes(root)
        for name in root:
            item = checked.item(root, name)
            if isinstance(item, h5py.h5g.GroupID):
                checked.attributes(item)
                for inner in item:
                    checked.array(checked.item(item, inner), inner)
            else:
                checked.array(item, name)


class _Check:
    """What is allowed in one file, and how much text may still be read."""

    def __init__(self, path: str, size: int, largest: int):
        self._path, self._credible = path, _ALWAYS_READ + _MOST_COMPRESSED * size
        self._texts = min(largest, self._credible)
        self._texts_at_once = max(1, self._credible // size)

    def _refuse(self, name: bytes, what: str) -> InputError:
        where = f"{self._path}: '{name.decode()}'"
        return InputError(f"{where} is {what}, so aacmm does not read this file; give a file written by aacmm.")

    def _check_size(self, name: bytes, item: Any, size: float) -> None:
        if size > self._credible:
            sizes = " x ".join(map(str, item.shape)) or "1"
            raise self._refuse(name, f"an array of {sizes} values, far more than the file can contain")

    def item(self, group: Any, name: bytes) -> Any:
        """A member of a group."""
        if group.links.get_info(name).type != _LOW.h5l.TYPE_HARD:
            raise self._refuse(name, "a link to something else")
        return _LOW.h5o.open(group, name)

    def array(self, item: Any, name: bytes) -> None:
        """Read an array; numbers in parts, and some texts at a time: many may refer to the same bytes of the file."""
        if not isinstance(item, h5py.h5d.DatasetID):
            raise self._refuse(name, "not an array")
        properties = item.get_create_plist()
        if properties.get_external_count() or properties.get_layout() == h5py.h5d.VIRTUAL:
            raise self._refuse(name, "stored in another file")
        self._check_type(name, item)
        self.attributes(item)
        shape, kind, data = item.shape, item.dtype, h5py.Dataset(item)
        size = math.prod(shape) * kind.itemsize
        self._check_size(name, item, size)
        text = bool(h5py.check_string_dtype(kind))
        if text and len(shape) > 1:
            raise self._refuse(name, "an array of texts with more than one dimension")
        if not shape or not size:
            data[()]
            return
        step = self._texts_at_once if text else max(1, _BUFFER * shape[0] // size)
        for first in range(0, shape[0], step):
            part = (data.asstr() if text else data)[first : first + step]
            if text:
                self._texts -= sum(map(len, part))
                self._check_size(name, item, math.inf if self._texts < 0 else 0)

    def attributes(self, item: Any) -> None:
        """Read the attributes of a file, a group or an array."""
        for index in range(h5py.h5a.get_num_attrs(item)):
            attribute = h5py.h5a.open(item, index=index)
            name, shape, kind = attribute.name, attribute.shape, attribute.dtype
            if name not in (b"DIMENSION_LIST", b"REFERENCE_LIST"):  # by which HDF5 attaches scales
                self._check_type(name, attribute)
            self._check_size(name, attribute, math.prod(shape) * kind.itemsize)
            if math.prod(shape):
                attribute.read(np.empty(shape, kind))

    def _check_type(self, name: bytes, item: Any) -> None:
        if item.get_type().get_class() not in _TYPES:
            raise self._refuse(name, "of a type that does not occur in files of aacmm")


def values_of(data: h5py.Dataset) -> np.ndarray:
    """An array, read whole; texts are str, and what xarray marks as truth values is bool."""
    if h5py.check_string_dtype(data.dtype):
        return np.asarray(data.asstr()[()], dtype=object)
    values = np.asarray(data[()])
    return values.astype(bool) if data.attrs.get("dtype") == "bool" else values


def attributes_of(item: Any) -> dict[str, Any]:
    """The attributes of a file, a group or an array, in types of Python."""
    return {name: _plain(value) for name, value in item.attrs.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.decode()
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    return value.item() if isinstance(value, np.generic) else value
