"""Tables in JSON: lists of rows, a list for each name, or a list of records."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import InputError
from .nested import nested_table


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of the table."""
    (content,) = members.values()
    try:
        values = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not valid JSON ({error}); correct the file.") from error
    return nested_table(values, tables, "list")
