"""The bench of mistakes: forty single mistakes, with eight arms and kinds of data, and captures without any.

    python benchmarks/mistakes                                   # every mistake with every case, at 3 times its limit
    python benchmarks/mistakes --kind "slipped zero" --case panda-plate --size 10
    python benchmarks/mistakes --sound 500                       # captures that are sound, of all cases in turn

Each capture is simulated with realistic noise and true u, changed by one mistake (`kinds.KINDS`), written as a manifest
with its tables, read again, and calibrated as ``aacmm calibrate`` does. The size of a mistake is a multiple of its
detection limit (`judge.detection_limit`). A mistake that has no size, such as exchanged columns, is made as it is.
Where no residual shows a mistake, because free parameters take it up, it is counted as absorbed, and not calibrated.

A row for each mistake: captures; the right culprit named first, and among the first two findings; captures without any
finding; and those called usable without a doubt although lengths are wrong by more than U. Below it, what is said first
where that is wrong. Results are appended to a file (JSON lines); what it has already is not run again.
"""

import argparse
import collections
import json
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from mistakes.cases import CASES
from mistakes.judge import SOUND, Job, applies, measured, rank_of
from mistakes.kinds import KINDS


def jobs(options: argparse.Namespace) -> list[Job]:
    """What is asked for, case after case."""
    cases = options.case or list(CASES)
    if options.sound:
        wanted = [(SOUND, cases[i % len(cases)], 0.0, 1 + i) for i in range(options.sound)]
    else:
        kinds = options.kind or list(KINDS)
        wanted = [(k, case, options.size, options.seed) for case in cases for k in kinds if applies(k, case)]
    return wanted[: options.limit]


def rows_of(path: Path, wanted: Sequence[Job], processes: int) -> Iterator[dict[str, Any]]:
    """The results of a file, and then those that it lacks."""
    lines = path.read_text().splitlines() if path.exists() else []
    before = {(row["kind"], row["case"], row["times"], row["seed"]): row for row in map(json.loads, lines)}
    yield from (before[job] for job in wanted if job in before)
    missing = [job for job in wanted if job not in before]
    # Processes that are started afresh: JAX does not survive a fork once it has computed.
    context = multiprocessing.get_context("spawn")
    with path.open("a") as stream, ProcessPoolExecutor(processes, mp_context=context) as pool:
        for row in map(measured, missing) if processes == 1 else pool.map(measured, missing):
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            yield row


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A line for each mistake, and what is wrong below it."""
    by_kind: dict[str, list[dict[str, Any]]] = collections.defaultdict(list)
    for row in rows:
        by_kind[row["kind"]].append(row)
    header = (
        f"{'mistake':26}{'captures':>9}{'first':>7}{'in two':>7}{'silent':>7}{'usable beyond U':>17}{'absorbed':>10}"
    )
    lines, total = [header], collections.Counter()
    for kind, of_kind in by_kind.items():
        counts, wrong = collections.Counter(), []
        for row in of_kind:
            if row.get("limit", 0.0) is None:
                counts["absorbed"] += 1
                continue
            rank = rank_of(row)
            counts["captures"] += 1
            counts["first"] += rank == 1
            counts["in two"] += rank in (1, 2)
            counts["silent"] += not row["findings"]
            counts["beyond"] += row["severity"] not in ("doubt", "unusable") and (row["over_u"] or 0.0) > 1
            if rank != 1 and (kind != SOUND or row["findings"]):
                said = row["findings"][0] if row["findings"] else "nothing"
                over = "" if row["over_u"] is None else f" (error {row['over_u']:.2g} U)"
                wrong.append(f"    {row['case']}{over}: {said[:150]}")
        total += counts
        lines += [_line(kind, counts), *wrong]
    return "\n".join([*lines, _line("all", total)])


def _line(kind: str, counts: collections.Counter) -> str:
    widths = {"captures": 9, "first": 7, "in two": 7, "silent": 7, "beyond": 17, "absorbed": 10}
    return f"{kind:26}" + "".join(f"{counts[name]:>{width}}" for name, width in widths.items())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kind", action="append", choices=list(KINDS), help="mistake; may be given several times")
    parser.add_argument("--case", action="append", choices=list(CASES), help="case; may be given several times")
    parser.add_argument("--size", type=float, default=3.0, help="multiple of the detection limit (default 3)")
    parser.add_argument("--sound", type=int, default=0, help="calibrate so many captures without a mistake instead")
    parser.add_argument("--limit", type=int, help="run only so many captures")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, default=Path("mistakes.jsonl"), help="JSON lines, which are resumed")
    options = parser.parse_args()
    print(table(list(rows_of(options.results, jobs(options), options.processes))))


if __name__ == "__main__":
    main()
