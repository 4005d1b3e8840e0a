"""Arrays and lists by name, in each other or not, as a table: what files of MATLAB, NumPy and JSON have in common."""

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.text import quoted, shorten

_BLANK = re.compile(r"[\t\r\n\v\f\x1c-\x1e\x85\u2028\u2029\"]+")  # what would end a cell or a line
_MOST_CELLS, _MOST_COLUMNS = 20_000_000, 10_000
_SHOWN = 12  # names that a message lists
_SIDE = 4  # of a matrix of a pose


def table_text(lines: Iterable[Sequence[Any]], *, header: bool, note: str = "") -> dict[str, Any]:
    """What a reader returns: lines of cells, the first of them perhaps the ``header``."""
    return {"text": "\n".join("\t".join(map(cell_text, line)) for line in lines), "header": header, "note": note}


def cell_text(value: Any) -> str:
    """A value as the cell of a text table has it; empty where there is none."""
    if isinstance(value, float):
        return repr(value)
    return "" if value is None else _BLANK.sub(" ", str(value)).strip()


def nested_table(content: Any, tables: Sequence[str], what: str) -> dict[str, Any]:
    """The table in arrays and lists, whose rows are the first dimension that all of them have; in arrays of more than
    two, it may be the last.

    An array has a column of its name, or columns ``name_1`` to ``name_k`` where a row of it has k numbers; one without
    a name has columns without names. A record in a list is a row. ``tables`` are names of what is taken, with points
    between what is in each other; ``what`` is what they name in messages. Raises `InputError`.
    """
    everything = dict(_arrays(content))
    arrays = everything if not tables else {}
    for name in tables:
        below = {key.removeprefix(f"{name}."): array for key, array in everything.items() if key.startswith(f"{name}.")}
        picked = {name.rpartition(".")[2]: everything[name]} if name in everything else below
        if not picked:
            raise InputError(f"has no {what} {quoted(name)}; it has {_listed(everything)}.")
        arrays |= picked
    if not arrays:
        raise InputError(f"has no {what} with numbers; give a file that has some.")
    lengths = {_length(array) for array in arrays.values()}
    several = len(lengths) > 1
    if several and not tables:  # single numbers beside the table say something else
        arrays = {name: array for name, array in arrays.items() if _length(array) > 1}
        lengths = {_length(array) for array in arrays.values()}
    # In arrays of three dimensions, that of the others decides.
    flat = {_length(array) for array in arrays.values() if array.ndim < 3} or lengths
    if len(flat) > 1:
        raise InputError(
            f"has {what}s of different lengths: {_listed(arrays)}; name those that are one table, for example table = "
            f'"{next(iter(arrays))}".'
        )
    count = flat.pop()
    columns: dict[str, list[Any]] = {}
    for name, array in arrays.items():
        rows = _rows(array, count, name)
        # A name that begins with a digit would be taken for a number.
        label = re.sub(r"^(?=[\W\d])", "_", cell_text(name))
        if rows.shape[1] == 1 and name:
            columns[label] = rows[:, 0].tolist()
        else:
            columns |= {f"{label}_{i}": column for i, column in enumerate(rows.T.tolist(), start=1)}
    if count * len(columns) > _MOST_CELLS or len(columns) > _MOST_COLUMNS:
        raise InputError(f"has a table of {count:,} x {len(columns):,} cells, which is too large; give a smaller one.")
    header = any(arrays)
    return table_text([*[list(columns)] * header, *zip(*columns.values(), strict=True)], header=header)


def _listed(arrays: Mapping[str, np.ndarray]) -> str:
    """The names with the sizes of what they are of."""
    sizes = {name: " x ".join(map(str, array.shape)) or "one value" for name, array in arrays.items()}
    return shorten([f"{quoted(name)[1:-1]} ({size})" for name, size in sizes.items()], _SHOWN)


def _arrays(content: Any, name: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Every array of numbers or texts, by its name with points; lists of records are one for each name in them."""
    if isinstance(content, np.ndarray) and content.dtype.names:
        content = {key: content[key] for key in content.dtype.names}
    records = content.ravel().tolist() if isinstance(content, np.ndarray) and content.dtype == object else content
    if isinstance(records, list) and records and all(isinstance(record, Mapping) for record in records):
        names = dict.fromkeys(key for record in records for key in record)
        content = {key: [record.get(key) for record in records] for key in names}
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _arrays(value, f"{name}.{key}" if name else str(key))
        return
    try:
        array = np.asarray(content)
    except ValueError as error:
        where = f" in {quoted(name)}" if name else ""
        raise InputError(f"has lists of different lengths{where}; give each row as many numbers.") from error
    if array.dtype == object:
        try:  # numbers, some of which are missing
            array = array.astype(float)
        except (TypeError, ValueError):  # functions, objects, lists of different lengths
            texts = array.ndim == 1 and all(isinstance(item, str) for item in array)
            array = array.astype(str) if texts else np.zeros(0)
    if array.dtype.kind in "bui":
        array = array.astype(np.int64 if array.dtype.kind == "b" else array.dtype)
    if array.size and array.dtype.kind in "fuiU":
        yield name, array.astype(float) if array.dtype.kind == "f" else array


def _length(array: np.ndarray) -> int:
    """The number of rows: the elements of a vector, however it lies, or the first dimension."""
    shape = array.shape or (1,)
    lies = array.ndim == 2 and shape[0] == 1
    matrices_first = array.ndim > 2 and shape[0] <= _SIDE < shape[-1]
    return shape[-1] if lies or matrices_first else shape[0]


def _rows(array: np.ndarray, count: int, name: str) -> np.ndarray:
    """The array with so many rows and the numbers of each in a line."""
    if array.ndim == 2 and array.shape[0] == 1 != count:
        array = array.T
    elif array.ndim > 2 and array.shape[0] != count:
        array = np.moveaxis(array, -1, 0)
    if (array.shape or (1,))[0] != count:
        raise InputError(f"has {' x '.join(map(str, array.shape))} numbers in {quoted(name)}, but {count} rows.")
    return array.reshape(count, math.prod(array.shape[1:]))
