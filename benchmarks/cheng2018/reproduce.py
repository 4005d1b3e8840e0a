"""Everything of Cheng et al. 2018 that can be recomputed, in one run.

    make reproduce             # recomputes all rows and compares them with those stored, each within its tolerance
    make reproduce WRITE=1     # stores them: results/*.csv, results/rows.json, results/*.png and REPRODUCTION.md

The first writes nothing and exits with 1 where a row fails. The second also repeats the searches of the paper's method,
of which the first repeats only a few, but for the 2,000 of `paper_method.py`.

REPRODUCTION.md gives for every published number: the printed value, what the printed vectors give, what the paper's
method gives when rerun, what this toolkit gives, a verdict, the tolerance of the check and the line of code that made
it.
"""

import json
import os
import platform
import sys
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import aacmm_jax as aj  # noqa: I001, F401 - must come before arrays are made
import beyond
import checks
import figures
import jax
import numpy as np
import table1
import table2
import table3
from paper import HERE, PUBLISHED, Row, write_table

VECTORS = ("eq. 16: ", "eq. 17: ", "eq. 18: ", "Table 2: ")
HEADER = """\
# Cheng et al. 2018, reproduced and questioned

Every result that the paper prints (doi 10.1155/2018/1760190), compared with what its own printed vectors give, with its
method rerun, and with this toolkit. Made by `make reproduce`; only the published numbers are typed in, and the last
column names the line of code that made each row. Lengths in mm, angles in rad unless a unit is given.

- **Recomputed** uses printed numbers only.
- **Paper's method**: for the simulations, an interior-point search on DE within the printed box, every length free
  (`paper_method.py`); all runs stop at 300 iterations, so their DE, Deltam and angles depend on that number. For the
  experiment, whose recordings (figshare 6223811) were not available, simulated twins of it (`twin.py`): with every
  length free as in the paper, but with squared distances; the row on k uses the interior-point search itself.
- **This toolkit** minimises squared distances within the same box: for the simulations with every length free, and
  after both stages; for the experiment with `d_3` as the scale anchor of stage 1.
- A verdict with a percentage gives the position of the printed number among the reruns.
- **Tolerance**: `make reproduce` recomputes every row and compares it with this page: words exactly, numbers to one
  unit of the last digit shown, or more where the tolerance says so, with the reason. Whole numbers are exact, but for
  rounded percentages and ratios.
- Not printed, and therefore chosen here: the position of the simulated socket, the starts of the searches (at random in
  the box), the positions of the three sockets, the reference length and the plate of the experiment (all round the arm,
  every joint turning fully), and how many readings are averaged at each end of a length (ten, in one pose; one at an
  end of the plate). In the joint solve an end counts as one pose.
- Repaired, because an element is missing in print: the simulation's nominal vector (one zero of theta), the upper
  bounds of simulation 1 (a joined "7210" and one theta) and of the experiment (one theta).
"""


def main() -> int:
    write, folder = sys.argv[1:] == ["--write"], HERE / "results"
    rows, tables = [], {}
    for module in (table1, table2, table3, beyond):
        started = time.perf_counter(), time.process_time()
        found, made = module.run(search=write)
        rows += found
        tables |= made
        wall, cpu = time.perf_counter() - started[0], time.process_time() - started[1]
        print(f"{module.__name__}: {len(found)} rows in {wall:.0f} s ({cpu:.0f} s of CPU)", file=sys.stderr)
    if not write:
        compared = checks.compared(json.loads((folder / "rows.json").read_text()), rows)
        print(checks.table(compared))
        failed = sum(not check.passed for check in compared)
        print(f"{len(compared) - failed} of {len(compared)} rows passed, {failed} failed.")
        return 1 if failed else 0
    folder.mkdir(exist_ok=True)
    for name, table in tables.items():
        write_table(folder / f"{name}.csv", table)
    (folder / "rows.json").write_text(json.dumps([in_words(row) for row in rows], indent=1) + "\n")
    about = figures.draw(tables, folder)
    (HERE / "REPRODUCTION.md").write_text(page(rows, about))
    print(f"REPRODUCTION.md: {len(rows)} rows written", file=sys.stderr)
    return 0


def in_words(row: Row) -> dict[str, str]:
    return row._asdict() | {"tolerance": str(row.tolerance)}


def page(rows: list[Row], about: dict[str, str]) -> str:
    vectors = [row for row in rows if row.what.startswith(VECTORS) and "scaled copy" not in row.what]
    counted = sum(len(value) if isinstance(value, list) else 1 for value in leaves(PUBLISHED))
    parts = [
        HEADER,
        f"Python {platform.python_version()}, JAX {jax.__version__}, NumPy {np.__version__}. {len(rows)} rows; "
        f"published.toml holds {counted} values, bounds and nominal vectors among them.\n",
        "## Numbers and claims\n",
        markdown([row for row in rows if row not in vectors]),
        "## The vectors, element by element\n",
        markdown(vectors),
        "## Figures\n",
        *(f"### {name}\n\n{text}\n\n![{text}](results/{name}.png)\n" for name, text in about.items()),
    ]
    return "\n".join(parts)


def leaves(tree: dict) -> list:
    return [leaf for value in tree.values() for leaf in (leaves(value) if isinstance(value, dict) else [value])]


def markdown(rows: list[Row]) -> str:
    lines = [
        "| number | printed | recomputed | paper's method | this toolkit | verdict | tolerance | from |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in in_words(row).values()) + " |" for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
