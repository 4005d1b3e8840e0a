"""Tables and warnings of a study, made of its summary: terminal and report show the same ones."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..core.units import error_unit
from ..summaries.tables import Cell, Table, listed, number
from .statistics import concise, factor_title, level_text, level_title, shown_unit

Row = Mapping[str, Any]
MEANING = (
    "Digits in parentheses: Monte Carlo standard error of the last digits. Length and angle error: the largest of all "
    "parameters."
)
_NAMED = 6  # most cells in a warning
_STATISTICS = {"mean": "mean", "spread": "standard deviation", "p5": "5 %", "p50": "50 %", "p95": "95 %"}
_FAILED = {
    "max_steps": "reached the step limit",
    "stalled": "stalled",
    "nonfinite": "had a pose that the true arm cannot take",
}


def estimate(pair: Row | None, factor: float = 1.0) -> Cell:
    """A statistic with its Monte Carlo standard error."""
    if pair is None or pair["value"] is None:
        return number(None)
    value = factor * pair["value"]
    return Cell(concise(value, None if pair["se"] is None else factor * pair["se"]).replace("-", "−"), value)


def cell_label(summary: Row, cell: Row) -> str:
    """A cell by its number and the levels of what varies."""
    varied = [name for name, levels in summary["factors"].items() if len(levels) > 1]
    return ", ".join((f"cell {cell['cell']}", *(level_title(name, cell["factors"][name]) for name in varied)))


def warnings_of(summary: Row) -> list[str]:
    """What a user should know before the numbers."""
    cells = [cell for cell in summary["results"] if cell["trials_run"]]
    failed = {words: sum(cell["reasons"][reason] for cell in cells) for reason, words in _FAILED.items()}
    why = ", ".join(f"{count:,} {words}" for words, count in failed.items() if count)
    sentences = []
    if not summary["finished"]:
        sentences.append(
            f"The study is not finished: {summary['trials_run']:,} trials so far; the same command continues it."
        )
    for key, least, says in (
        ("converged", 0.99, f"Not all trials converged, and metrics are of those that did{why and f' ({why})'}"),
        ("truth_inside", 1.0, "The true arm lies within the bounds in some of the trials only"),
    ):
        shares = [(cell, cell[key]["value"] or 0.0) for cell in cells]
        named = [f"{cell_label(summary, cell)} ({100 * share:.3g} %)" for cell, share in shares if share < least]
        more = f"; and {len(named) - _NAMED} more cells" if len(named) > _NAMED else ""
        sentences += [f"{says}: {'; '.join(named[:_NAMED])}{more}."] if named else []
    return sentences


def cell_table(summary: Row, cells: Sequence[Row]) -> Table:
    """How many trials of each cell converged, and which parameters ended on a bound."""

    def converged(cell: Row) -> Cell:
        value = cell["converged"]["value"]
        return estimate(cell["converged"], 100.0)._replace(mark="unsure" if value is not None and value < 0.99 else "")

    def most_often(cell: Row) -> str:
        worst = max(cell["parameters"], key=lambda row: row["on_a_bound"]["value"], default=None)
        if worst is None or not worst["on_a_bound"]["value"]:
            return ""
        return f"{worst['parameter']} {estimate(worst['on_a_bound'], 100.0).text} %"

    return listed("Trials by cell", cells, {
        "cell": "cell",
        **_levels(summary),
        "trials": lambda cell: f"{cell['trials_run']:,}",
        "converged [%]": converged,
        "truth within bounds [%]": lambda cell: estimate(cell["truth_inside"], 100.0),
        "on a bound [%]": lambda cell: estimate(cell["on_a_bound"], 100.0),
        "most often": most_often if any(map(most_often, cells)) else None,
    })  # fmt: skip


def means_table(summary: Row, cells: Sequence[Row], metrics: Mapping[str, str]) -> Table:
    """The mean of each metric in each cell."""
    means = {
        heading: lambda cell, name=name: estimate(cell["figures"].get(name, {}).get("mean"), shown_unit(name)[1])
        for name, heading in metrics.items()
    }
    return listed("Means over converged trials", cells, {"cell": "cell", **_levels(summary)} | means)


def distribution_table(title: str, rows: Iterable[tuple[str, Row, str]]) -> Table:
    """Statistics of metrics over converged trials: rows of a label, a cell and a metric."""
    statistics = {
        words: lambda row, key=key: estimate((row[1]["figures"].get(row[2]) or {}).get(key), shown_unit(row[2])[1])
        for key, words in _STATISTICS.items()
    }
    return listed(title, rows, {"": lambda row: row[0]} | statistics)


def parameter_table(rows: Iterable[Row], *, by_cell: bool = False) -> Table:
    """Bias and standard deviation of parameters, and how often they are on a bound."""
    return listed("Parameters: estimate less truth", rows, {
        "cell": "cell" if by_cell else None,
        "parameter": "parameter",
        "unit": lambda row: error_unit(row["unit"])[1],
        "bias": lambda row: estimate(row["bias"], error_unit(row["unit"])[0]),
        "standard deviation": lambda row: estimate(row["spread"], error_unit(row["unit"])[0]),
        "on a bound [%]": lambda row: estimate(row["on_a_bound"], 100.0),
    }, folded=by_cell)  # fmt: skip


def _levels(summary: Row) -> dict[str, Any]:
    def level(cell: Row, name: str) -> Cell:
        value = cell["factors"][name]
        return Cell(level_text(value), float(value) if isinstance(value, float) else None)

    return {factor_title(name): lambda cell, name=name: level(cell, name) for name in summary["factors"]}
