"""Records as tables: what a record holds is declared once, and written, read and checked by that.

A record is a NamedTuple, a module of Equinox or a dictionary. Its `Field`s without dimensions are attributes of its
table, the others arrays. Many records of one kind are the rows of a table; what differs in number from row to row (the
sockets of a group) is stored one after the other, with the number of the row that each is of, as the conventions CF
1.11 (section 9.3.4, indexed ragged arrays) have it.
"""

import json
from collections.abc import Iterable, Mapping
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import numpy as np

from .hdf5 import Entries, StoredTable, Table, Variable, check_sense

Content = Literal["number", "count", "truth", "text", "json"]
_TYPES = {"number": float, "count": int, "truth": bool, "text": str}  # of what stands in a dictionary


class Field(NamedTuple):
    """What a file says of one field of a record, and which values it may have."""

    says: str
    unit: str = ""
    dimensions: tuple[str, ...] = ()
    content: Content = "number"
    name: str = ""  # in the file, where it is not the field's
    least: float | None = None
    among: tuple[Any, ...] = ()
    fields: Mapping[str, "Field"] | None = None  # of a record within the record, whose fields are stored beside its own


Fields = Mapping[str, Field]


def text(says: str, *dimensions: str, name: str = "", among: tuple[str, ...] = ()) -> Field:
    """A name, a sentence, or a list of them."""
    return Field(says, "", dimensions, "text", name, among=among)


def number(says: str, unit: str, *dimensions: str, name: str = "", least: float | None = None) -> Field:
    """A real number, or an array of them."""
    return Field(says, unit, dimensions, "number", name, least)


def count(says: str, *dimensions: str, name: str = "", least: float | None = 0, among: tuple[int, ...] = ()) -> Field:
    """A whole number, or an array of them."""
    return Field(says, "1", dimensions, "count", name, least, among)


def truth(says: str, *dimensions: str) -> Field:
    """Yes or no, or an array of them."""
    return Field(says, "", dimensions, "truth")


def mapping(says: str) -> Field:
    """Numbers or lists by name, stored as JSON."""
    return Field(says, content="json")


def part(fields: Fields) -> Field:
    """A record within the record."""
    return Field("", fields=fields)


def attribute_name(name: str, field: Field) -> str:
    """What an attribute is called in a file: it has no unit of its own, but bears it in the name."""
    return field.name or (name if field.unit in ("", "1") else f"{name}_{field.unit}")


def _flat(fields: Fields, record: Any = None) -> list[tuple[str, Field, Any]]:
    """Fields, those of records within the record too, with their values where there is a record."""
    rows = []
    for name, field in fields.items():
        value = None if record is None else _value(record, name)
        rows += [(name, field, value)] if field.fields is None else _flat(field.fields, value)
    return rows


def _value(record: Any, name: str) -> Any:
    return record[name] if isinstance(record, dict) else getattr(record, name)


def _array(values: Any, field: Field) -> np.ndarray:
    kinds = {"truth": bool, "text": object, "count": np.int64, "number": float}
    given = np.asarray(values)
    exact = field.content in ("count", "number") and given.dtype.kind in "if" and given.size
    return given if exact else np.asarray(values, dtype=kinds[field.content])


def table_of(record: Any, fields: Fields) -> Table:
    """The table of one record; a field that is None is left out."""
    variables: dict[str, Variable] = {}
    attributes: dict[str, Any] = {}
    for name, field, value in _flat(fields, record):
        if value is None:
            continue
        if field.dimensions:
            values = _array(value, field)
            variables[field.name or name] = Variable(field.dimensions, values, field.unit, field.says)
        elif field.content == "json":
            attributes[attribute_name(name, field)] = json.dumps(
                dict(value) if isinstance(value, Mapping) else value, default=float
            )
        else:
            attributes[attribute_name(name, field)] = sorted(value) if isinstance(value, frozenset) else value
    return Table(variables, attributes)


def rows_table(dimension: str, records: Iterable[Any], fields: Fields) -> Table:
    """The table of many records: a row each, and one after the other what has a dimension of its own. A text that is
    None is empty, and left out where all are, as any other field is."""
    records, variables = list(records), {}
    for name, field in fields.items():
        values = [_value(record, name) for record in records]
        if records and all(value is None for value in values):
            continue
        if field.content == "text" and not field.dimensions and None in values:
            if not any(values):
                continue
            values = [value or "" for value in values]
        dimensions = field.dimensions or (dimension,)
        if field.dimensions:
            row = np.repeat(np.arange(len(records)), [len(value) for value in values])
            says = f"row of the dimension '{dimension}' to which the value belongs, counted from 0"
            variables[_index(dimension, field)] = Variable(dimensions, row, "1", says)
            values = [entry for value in values for entry in value]
        variables[field.name or name] = Variable(dimensions, _array(values, field), field.unit, field.says)
    return Table(variables)


def _index(dimension: str, field: Field) -> str:
    return f"{dimension}_of_{field.dimensions[0]}"


def values_in(cls: type, fields: Fields, arrays: Entries, attributes: Entries) -> dict[str, Any]:
    """The fields of one record, from the arrays and the attributes of a table; what may be None may be missing."""
    hints, values = get_type_hints(cls), {}
    for name, field in fields.items():
        hint = hints.get(name, np.ndarray)
        if field.fields is not None:
            values[name] = hint(**values_in(hint, field.fields, arrays, attributes))
            continue
        source, key = (arrays, field.name or name) if field.dimensions else (attributes, attribute_name(name, field))
        value = source.get(key) if NoneType in get_args(hint) or not hints.get(name) else source[key]
        values[name] = json.loads(str(value)) if field.content == "json" else restored(hint, value)
    return values


def record_in(cls: type, fields: Fields, table: StoredTable | None) -> Any:
    """The record that `table_of` stored; None without a table."""
    return None if table is None else cls(**values_in(cls, fields, table, table.attributes))


def rows_in(cls: type, fields: Fields, dimension: str, table: StoredTable | None) -> tuple[Any, ...]:
    """The records that `rows_table` stored; none without a table."""
    if table is None:
        return ()
    size = len(next(table[field.name or name] for name, field in fields.items() if not field.dimensions))
    return tuple(cls(**row_values(cls, fields, dimension, table, i)) for i in range(size))


class Within(NamedTuple):
    """A record within a record, or many of them, as a table of its own; of many, each is a row of ``dimension``."""

    table: str
    cls: type
    fields: Fields
    dimension: str = ""


def tables_within(record: Any, parts: Mapping[str, Within]) -> dict[str, Table]:
    """Tables of the records that there are in fields of a record."""
    tables = {}
    for name, (table, _, fields, dimension) in parts.items():
        value = getattr(record, name)
        if value is not None and value != ():
            tables[table] = rows_table(dimension, value, fields) if dimension else table_of(value, fields)
    return tables


def records_within(tables: Entries, parts: Mapping[str, Within]) -> dict[str, Any]:
    """What `tables_within` stored, by field."""
    records = {}
    for name, (key, cls, fields, dimension) in parts.items():
        table = tables.get(key)
        records[name] = rows_in(cls, fields, dimension, table) if dimension else record_in(cls, fields, table)
    return records


def row_values(cls: type, fields: Fields, dimension: str, table: StoredTable, i: int) -> dict[str, Any]:
    """The fields of one row, from 0; what may be None may be missing."""
    hints, values = get_type_hints(cls), {}
    for name, field in fields.items():
        if NoneType in get_args(hints.get(name)) and (field.name or name) not in table:
            continue
        column = table[field.name or name]
        chosen = column[table[_index(dimension, field)] == i] if field.dimensions else column[i]
        values[name] = restored(hints.get(name, np.ndarray if field.dimensions else _TYPES[field.content]), chosen)
    return values


def restored(hint: Any, value: Any) -> Any:
    """What a file holds as the type that a field has: plain numbers and texts, tuples of them, or arrays."""
    if value is None:
        return None
    origin = get_origin(hint) or hint
    if origin in (Union, UnionType):
        return restored(next(option for option in get_args(hint) if option is not NoneType), value)
    if origin in (tuple, frozenset):
        entries = () if isinstance(value, str) and not value else np.atleast_1d(np.asarray(value, dtype=object))
        return origin(restored(get_args(hint)[0], entry) for entry in entries)
    if origin in (str, int, float, bool):
        return origin(value)
    return str(value) if origin is Literal else np.asarray(value)


def check_fields(fields: Fields, arrays: Entries, attributes: Entries) -> None:
    """Raise `InputError` where a field is of another type or shape than declared, or has a value that it cannot have.

    What is missing is left to whoever needs it. This takes no record, so that no library of theirs is loaded.
    """
    sizes: dict[str, int] = {}
    for name, field, _ in _flat(fields):
        key = field.name or name
        dimensions = (field.dimensions or ("row",)) if key in arrays else ()
        if not dimensions:
            key = attribute_name(name, field)
        value = (arrays if dimensions else attributes).get(key)
        if value is None or field.content == "json" or (field.content == "text" and not (field.among or dimensions)):
            continue
        values = np.asarray(value)
        kinds = {"number": "if", "count": "i", "truth": "bi", "text": "OU"}[field.content]
        shape = tuple(sizes.setdefault(*pair) for pair in zip(dimensions, values.shape, strict=False))
        check_sense(
            arrays.path,
            {
                f"{key} ({field.says}) has the wrong type": values.size and values.dtype.kind not in kinds,
                f"{key} ({field.says}) has the wrong shape": dimensions
                and (values.shape != shape or values.ndim != len(dimensions)),
            },
        )
        below = field.least is not None and np.any(values < field.least)
        foreign = field.among and not np.all(np.isin(values.astype(str), [str(allowed) for allowed in field.among]))
        check_sense(
            arrays.path,
            {
                f"{key} ({field.says}) is below {field.least}": below,
                f"{key} ({field.says}) is not one of {', '.join(filter(None, map(str, field.among)))}": foreign,
            },
        )
