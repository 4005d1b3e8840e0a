"""Tables in files of NumPy: arrays by name (.npz), or one array (.npy). Python objects in them are not read."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import InputError
from .nested import nested_table


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of the table."""
    (content,) = members.values()
    loaded = np.load(io.BytesIO(content), allow_pickle=False)
    if isinstance(loaded, np.ndarray):
        return nested_table(loaded, tables, "array")
    arrays = {}
    for name in loaded.files:
        try:
            arrays[name] = loaded[name]
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
    if not arrays and loaded.files:
        raise InputError("has Python objects only, which are not read; save arrays of numbers.")
    return nested_table(arrays, tables, "array")
