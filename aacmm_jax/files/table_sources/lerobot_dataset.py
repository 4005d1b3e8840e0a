"""Data sets of LeRobot (v2 and v3): files of Parquet, and the names of the motors in meta/info.json."""

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.text import quoted, shorten
from .nested import table_text

_STATE = "observation.state"  # what was measured; "action" is what was commanded
_INDICES = ("episode_index", "frame_index", "timestamp")
_MOST_CELLS = 20_000_000


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of the table: a row for each frame, with a column for each motor, by its name where it is known.

    ``tables``: the feature that is read, by default what was measured.
    """
    from pyarrow.parquet import ParquetFile

    info = next((json.loads(content) for name, content in members.items() if name.endswith("info.json")), {})
    names = [name for name in members if name.endswith(".parquet")]
    data = [name for name in names if name.replace("\\", "/").startswith("data/")] or names
    wanted = list(tables) or [_STATE]
    header: list[str] = []
    rows: list[list[Any]] = []
    for name in data:
        file = ParquetFile(io.BytesIO(members[name]))
        features = file.schema_arrow.names
        missing = [feature for feature in wanted if feature not in features]
        if missing:
            raise InputError(f"has no feature {quoted(missing[0])}; it has {shorten(list(map(quoted, features)), 12)}.")
        indices = [index for index in _INDICES if index in features]
        if file.metadata.num_rows * len(features) > _MOST_CELLS:
            raise InputError(f"has more than {_MOST_CELLS:,} numbers in {name}; give the files of some episodes.")
        table = file.read(columns=[*indices, *wanted])
        columns = {index: table[index].to_pylist() for index in indices}
        for feature in wanted:
            numbers = np.array(table[feature].to_pylist(), dtype=float).reshape(table.num_rows, -1)
            motors = _motors(info, feature, numbers.shape[1])
            columns |= dict(zip(motors, numbers.T.tolist(), strict=True))
        if header and header != list(columns):
            raise InputError(f"has other columns in {name} than in {data[0]}; give files of one data set.")
        header = list(columns)
        rows += map(list, zip(*columns.values(), strict=True))
    return table_text([header, *rows], header=True)


def _motors(info: Mapping[str, Any], feature: str, count: int) -> list[str]:
    """The names of a feature's numbers; of an action, with this word before them."""
    stated = info.get("features", {}).get(feature, {}).get("names")
    stated = next(iter(stated.values()), None) if isinstance(stated, dict) else stated  # {"motors": [...]}
    if not isinstance(stated, list) or len(stated) != count:
        return [f"{feature}_{i}" for i in range(1, count + 1)]
    return [str(name) if feature == _STATE else f"{feature} {name}" for name in stated]
