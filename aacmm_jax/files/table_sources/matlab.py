"""Tables in files of MATLAB: v4 to v7 by SciPy, v7.3 by HDF5; matrices, structures and lists of texts."""

import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import h5py
import numpy as np
import scipy.io

from ...core.errors import InputError
from ...core.text import quoted
from .nested import nested_table

_HDF5 = b"\x89HDF\r\n\x1a\n"
_USER_BLOCK = 512  # bytes that MATLAB writes before it
_DEEPEST = 8
_LARGEST = 2**29  # bytes of a variable
_MOST_ITEMS = 1_000_000  # of a cell array


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of the table."""
    (content,) = members.values()
    if _HDF5 in (content[: len(_HDF5)], content[_USER_BLOCK : _USER_BLOCK + len(_HDF5)]):
        with h5py.File(io.BytesIO(content), "r") as file:
            variables = {name: _value(file, item) for name, item in _inside(file) if not name.startswith("#")}
    else:
        loaded = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True)
        variables = {name: value for name, value in loaded.items() if not name.startswith("__")}
    return nested_table(variables, tables, "variable")


def _inside(group: h5py.Group) -> Iterator[tuple[str, Any]]:
    """What is in a group itself, and not by a link somewhere else."""
    for name in map(str, group):
        if isinstance(group.get(name, getlink=True), h5py.HardLink):
            yield name, group[name]


def _value(file: h5py.File, item: Any, depth: int = 0) -> Any:
    """A variable of v7.3, whose matrices are stored by columns, so that their dimensions come in the other order."""
    if depth > _DEEPEST:
        return None
    if isinstance(item, h5py.Group):
        return {name: _value(file, part, depth + 1) for name, part in _inside(item)}
    if item.attrs.get("MATLAB_empty") or item.is_virtual or item.external:
        return np.zeros(0)
    if item.size * item.dtype.itemsize > _LARGEST:
        raise InputError(f"has more than {_LARGEST // 2**20} MiB in {quoted(item.name)}; give a smaller file.")
    array = item[()]
    if h5py.check_ref_dtype(item.dtype) is not None:  # a cell array, or the fields of an array of structures
        return [_value(file, file[reference], depth + 1) for reference in array.T.ravel()[:_MOST_ITEMS]]
    if item.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, array.ravel()))
    return np.squeeze(array.T) if array.ndim > 1 else array
