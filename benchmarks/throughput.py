"""Identifications a second: every contender on the same problems, tolerance and machine, alternating in one run.

The problem is the paper's: 70 noise-free poses, 21 parameters, random starts in the box of simulation 1, and DE of at
most 1e-9 mm in every problem. Then the costs of kinematics, sizes of problems, memory, calls and whole commands. Prints
tables (medians, and the range over the rounds) and writes everything as JSON into benchmarks/results/. Contenders that
are not installed are named as absent; `make peers` installs those that pip can.

    python benchmarks/throughput.py [--rounds 5] [--only contenders --only kinematics ...]
"""

import argparse
import json
import os
import platform
import statistics
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # SciPy's contenders are one core by definition

import costs
import jax
import numpy as np
from contenders import ASKED_DE, Contender, Task, build_ceres, ceres, everyone, ours, ours_alone
from rich.console import Console
from rich.table import Table

RESULTS = Path(__file__).resolve().parent / "results"
Row = dict[str, Any]


def contenders(rounds: int) -> list[Row]:
    """All on the paper's problem, nothing held; the two fastest with d_3 held; and one large problem at a time."""
    all_of_them = everyone()
    fastest = {name: pair for name, pair in all_of_them.items() if name.startswith(("aacmm", "Ceres"))}
    binary = build_ceres()
    single = {"aacmm_jax.identify": (ours_alone, 4), "Ceres": (None if binary is None else ceres(binary, threads=1), 4)}
    return [
        *race(Task(), all_of_them, rounds),
        *race(Task(hold="d_3"), fastest, rounds),
        *race(Task(poses=7_000), single, rounds),
        *race(Task(poses=7_000, hold="d_3"), {"aacmm_jax.identify_many": (ours, 4), **single}, rounds),
    ]


def race(task: Task, entrants: dict[str, tuple[Contender | None, int]], rounds: int) -> list[Row]:
    present = {name: (run, count) for name, (run, count) in entrants.items() if run is not None}
    for run, count in present.values():
        run(task, task.starts(count, 0))  # compile, warm up
    rates: dict[str, list[float]] = {name: [] for name in present}
    des: dict[str, list[np.ndarray]] = {name: [] for name in present}
    for number in range(1, rounds + 1):
        for name, (run, count) in present.items():
            seconds, found = run(task, task.starts(count, number))
            rates[name].append(count / seconds)
            des[name].append(task.de(found))
    rows = []
    for name, (run, count) in entrants.items():
        row: Row = {"contender": name, "poses": len(task.q), "held": task.hold, "batch": count, "absent": run is None}
        if run is not None:
            de = np.concatenate(des[name])
            row |= {
                "rate_median": statistics.median(rates[name]),
                "rate_lowest": min(rates[name]),
                "rate_highest": max(rates[name]),
                "worst_de_mm": float(de.max()),
                "share_within_de": float(np.mean(de <= ASKED_DE)),
            }
        rows.append(row)
    best = rows[0]["rate_median"]
    return [row if row["absent"] else row | {"first_over_it": best / row["rate_median"]} for row in rows]


PARTS: dict[str, Callable[[int], list[Row]]] = {
    "contenders": contenders,
    "kinematics": costs.kinematics,
    "identifications": costs.identifications,
    "memory": lambda rounds: costs.memory(),
    "calls": lambda rounds: costs.calls(),
    "commands": lambda rounds: costs.commands(max(rounds, 9)),
    "arithmetic": costs.arithmetic,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", choices=PARTS, action="append", help="parts to run; all by default")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    console, results = Console(width=150), {}
    for part in arguments.only or PARTS:
        results[part] = PARTS[part](arguments.rounds)
        console.print(table_of(part, results[part]))
    now = datetime.now(UTC)
    content = {
        "when": now.isoformat(timespec="seconds"),
        "device": str(jax.devices()[0].device_kind),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "results": results,
    }
    arguments.results.mkdir(exist_ok=True)
    path = arguments.results / f"throughput-{now:%Y-%m-%d-%H%M}.json"
    path.write_text(json.dumps(content, indent=1) + "\n")
    print(f"Written: {os.path.relpath(path)}", file=sys.stderr)


def table_of(title: str, rows: list[Row]) -> Table:
    columns = list(dict.fromkeys(key for row in rows for key in row if key != "absent"))
    table = Table(title=title, box=None, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column.replace("_", " "), justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(
            *("absent" if row.get("absent") and i == 1 else shown(row.get(key)) for i, key in enumerate(columns))
        )
    return table


def shown(value: Any) -> str:
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
