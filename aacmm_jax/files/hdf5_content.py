"""What an HDF5 file contains, read without following it anywhere else, and the SHA-256 by which damage is detected.

A file carries two digests. The attribute ``content_sha256`` is of its logical content: groups, attributes, and arrays
with their types, shapes and values, in the order of their names; compression and layout do not change it, so it also
holds for a file that another program has repacked. The seal, some bytes after the end of what HDF5 reads, is of all
bytes before it. Where it matches, the content is what was written, at a hundredth of the time that the first one takes.
Where it does not match, the file is not opened, as the HDF5 library may crash on damaged metadata. Where it is gone
(other programs do not write it), the content decides. Both detect damage. Neither is a signature: whoever changes a
file on purpose can compute them again.
"""

import hashlib
import math
import os
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

from ..core.errors import InputError

_LOW: Any = h5py  # whose type hints lack some of its modules
DIGEST = "content_sha256"
_SEAL = b"\naacmm_jax: SHA-256 of all bytes before this line: %s\n"
_SEAL_SIZE = len(_SEAL % (64 * b"0"))
# An honest file's arrays exceed its size little; a few repeated numbers are compressed a thousand times.
_ALWAYS_READ, _MOST_COMPRESSED = 64 * 2**20, 100
_BUFFER = 16 * 2**20  # bytes of an array that are hashed at a time


def seal(stream: Any) -> None:
    """Append the SHA-256 of all bytes of a file that is open for reading and writing."""
    stream.seek(0)
    digest = hashlib.file_digest(stream, "sha256").hexdigest()
    stream.seek(0, os.SEEK_END)
    stream.write(_SEAL % digest.encode())


def sealed(image: bytes) -> bytes:
    """The bytes of a file with the SHA-256 of all of them appended."""
    return image + _SEAL % hashlib.sha256(image).hexdigest().encode()


def is_sealed(stream: Any) -> bool | None:
    """Whether the SHA-256 at the end of a file is that of all bytes before; None where there is none."""
    size = stream.seek(0, os.SEEK_END) - _SEAL_SIZE
    if size < 0:
        return None
    stream.seek(size)
    last = stream.read()
    if not last.startswith(_SEAL[: _SEAL.index(b"%")]):  # most files of other origin are not read whole
        return None
    stream.seek(0)
    digest, left = hashlib.sha256(), size
    while left and (part := stream.read(min(left, 2**20))):
        digest.update(part)
        left -= len(part)
    return last == _SEAL % digest.hexdigest().encode()


class Content:
    """The content of an open HDF5 file: groups of arrays of numbers or text, and their attributes.

    Whatever leads out of the file is refused (soft and external links, external storage, virtual arrays), and so is
    what no file of this package has: groups within groups, compound and reference types, and arrays that claim to be
    much larger than the file.

    Args:
        path: The file's name, for messages.
        file: The open `h5py.File`.
        size: Its size in bytes.
        largest: The most bytes that may be read into memory.
        virtual: Folder of the blocks that virtual arrays may be made of, without its path; None allows no such arrays.
    """

    def __init__(self, path: str | os.PathLike, file: Any, size: int, largest: int, virtual: str | None = None):
        self.path, self.file, self._virtual, self._size = path, file, virtual, size
        self._credible = _ALWAYS_READ + _MOST_COMPRESSED * size
        self._left = min(largest, self._credible)

    def _refuse(self, name: str, what: str) -> InputError:
        return InputError(f"{self.path}: '{name}' is {what}, which is not read; name a file written by aacmm.")

    def names(self, group: Any) -> list[str]:
        """Names in a group, in their order."""
        return [name.decode() for name in group]

    def groups(self) -> Iterator[tuple[str, Any]]:
        """Every group with its name."""
        for name in self.names(self.file.id):
            item = self._item(self.file.id, name)
            if isinstance(item, h5py.h5g.GroupID):
                yield name, item

    def group(self, name: str) -> Any:
        """The identifier of a group."""
        return dict(self.groups())[name]

    def _item(self, group: Any, name: str) -> Any:
        if group.links.get_info(name.encode()).type != _LOW.h5l.TYPE_HARD:
            raise self._refuse(name, "a link to something else")
        return _LOW.h5o.open(group, name.encode())

    def array(self, group: Any, name: str) -> Any:
        """The identifier of an array, of which everything that is not data has been checked."""
        item = self._item(group, name)
        if not isinstance(item, h5py.h5d.DatasetID):
            raise self._refuse(name, "no array")
        properties = item.get_create_plist()
        if properties.get_external_count():
            raise self._refuse(name, "stored in another file")
        if properties.get_layout() == h5py.h5d.VIRTUAL:
            self._check_virtual(name, properties)
        _check_type(name, self._refuse, item.get_type())
        return item

    def dataset(self, group: Any, name: str) -> Any:
        """An array as an `h5py.Dataset`, to be read in parts."""
        return h5py.Dataset(self.array(group, name))

    def _check_virtual(self, name: str, properties: Any) -> None:
        if self._virtual is None:
            raise self._refuse(name, "made of other files")
        for i in range(properties.get_virtual_count()):
            folder, _, block = properties.get_virtual_filename(i).rpartition("/")
            if folder.replace("%%", "%") != self._virtual or not block or block in (".", ".."):
                raise self._refuse(name, "made of files that are not blocks of this study")

    def values(self, group: Any, name: str) -> np.ndarray:
        """An array, read whole; texts are str."""
        item = self.array(group, name)
        self._left -= math.prod(item.shape) * item.dtype.itemsize
        if self._left >= 0:
            return self._texts(item, name) if h5py.check_string_dtype(item.dtype) else _numbers(item)
        raise self._too_large(name, item)

    def _too_large(self, name: str, item: Any) -> InputError:
        return self._refuse(name, f"an array of {_sizes(item.shape)}, far more than the file contains")

    def _texts(self, item: Any, name: str) -> np.ndarray:
        """Some at a time: many may refer to the same bytes of the file."""
        texts: Any = h5py.Dataset(item).asstr()
        if len(item.shape) > 1:
            raise self._refuse(name, "a table of texts in several dimensions")
        if not item.shape:
            return np.asarray(texts[()], dtype=object)
        step, found = max(1, self._credible // self._size), []
        for first in range(0, item.shape[0], step):
            part = texts[first : first + step]
            self._left -= sum(map(len, part))
            if self._left < 0:
                raise self._too_large(name, item)
            found.append(part)
        return np.concatenate(found) if found else np.empty(0, dtype=object)

    def digest(self) -> str:
        """SHA-256 of the logical content, without the attribute that contains it."""
        found = _Digest()
        root = self.file.id
        self._add_attributes(found, root)
        for name in sorted(self.names(root)):
            item = self._item(root, name)
            if not isinstance(item, h5py.h5g.GroupID):
                self._add_array(found, root, name)
                continue
            found.add("group", name)
            self._add_attributes(found, item)
            for inner in sorted(self.names(item)):
                self._add_array(found, item, inner)
            found.add("end of group")
        return found.hexdigest()

    def _add_array(self, found: "_Digest", group: Any, name: str) -> None:
        item = self.array(group, name)
        found.add("array", name, _type_name(item.dtype), _sizes(item.shape))
        properties = item.get_create_plist()
        if properties.get_layout() == h5py.h5d.VIRTUAL:  # its values are those of other files, which have their own
            count = properties.get_virtual_count()
            sources = ((properties.get_virtual_filename(i), properties.get_virtual_dsetname(i)) for i in range(count))
            places = (properties.get_virtual_vspace(i).get_select_bounds() for i in range(count))
            for source, place in zip(sources, places, strict=True):
                found.add(*source, str(place))
        else:
            declared = math.prod(item.shape) * item.dtype.itemsize
            if declared > self._credible:
                raise self._too_large(name, item)
            if h5py.check_string_dtype(item.dtype):
                found.add_values(self._texts(item, name))
            elif declared <= _BUFFER:
                found.add_values(_numbers(item))
            else:
                for rows in _parts(item.shape, item.dtype.itemsize):
                    found.add_values(np.asarray(h5py.Dataset(item)[rows]))
        self._add_attributes(found, item)

    def _add_attributes(self, found: "_Digest", item: Any) -> None:
        attributes = (h5py.h5a.open(item, index=index) for index in range(h5py.h5a.get_num_attrs(item)))
        for name, attribute in sorted({attribute.name.decode(): attribute for attribute in attributes}.items()):
            # HDF5 itself keeps REFERENCE_LIST of a scale: the inverse of DIMENSION_LIST.
            if name == "REFERENCE_LIST" or (name == DIGEST and item == self.file.id):
                continue
            if name == "DIMENSION_LIST":
                found.add("attribute", name, *self._scales(attribute))
                continue
            _check_type(name, self._refuse, attribute.get_type())
            found.add("attribute", name, _type_name(attribute.dtype), _sizes(attribute.shape))
            values = np.empty(attribute.shape, attribute.dtype)
            if values.size:
                attribute.read(values)
            found.add_values(values)

    def _scales(self, attribute: Any) -> Iterator[str]:
        """The names of the scales that are attached to each dimension of an array."""
        values: Any = np.empty(attribute.shape, attribute.dtype)
        attribute.read(values)
        for axis, references in enumerate(values.tolist()):
            for reference in references:
                yield f"{axis} {(h5py.h5r.get_name(reference, self.file.id) or b'').decode()}"


class _Digest:
    """A SHA-256 of pieces, each preceded by its length."""

    def __init__(self) -> None:
        self._sha256 = hashlib.sha256()
        self.hexdigest = self._sha256.hexdigest

    def add(self, *texts: str) -> None:
        for text in texts:
            self._add(text.encode())

    def _add(self, piece: Any) -> None:
        self._sha256.update(len(piece).to_bytes(8, "little"))
        self._sha256.update(piece)

    def add_values(self, values: np.ndarray) -> None:
        if values.dtype.kind == "O":
            for value in values.reshape(-1).tolist():
                self._add(value.encode() if isinstance(value, str) else bytes(value))
            return
        self._add(np.ascontiguousarray(values).reshape(-1).view(np.uint8).data)


def _numbers(item: Any) -> np.ndarray:
    values = np.empty(item.shape, item.dtype)
    if values.size:
        item.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values


def _check_type(name: str, refuse: Any, kind: Any) -> None:
    """Numbers, truth values (an enumeration) and text; no compound, reference or array types, nor lists of lists."""
    allowed = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM)
    if kind.get_class() not in allowed:
        raise refuse(name, "of a type that no file of aacmm has")


def _type_name(kind: np.dtype) -> str:
    text = h5py.check_string_dtype(kind)
    return kind.str if text is None else f"text {text.encoding} {text.length}"


def _sizes(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape)) or "1"


def _parts(shape: tuple[int, ...], itemsize: int) -> Iterator[tuple[slice, ...]]:
    """Parts of an array, in the order of its elements, each of which fits into the buffer."""
    row = math.prod(shape[1:]) * itemsize
    if row <= _BUFFER:
        step = _BUFFER // max(row, 1)
        yield from ((slice(first, first + step),) for first in range(0, shape[0], step))
        return
    for first in range(shape[0]):
        yield from ((slice(first, first + 1), *rest) for rest in _parts(shape[1:], itemsize))
