"""What the terminal output of all commands shares: the console, tables that fit it, numbers, warnings, verdicts."""

import os
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from rich.text import Text

_DEFAULT = 110  # columns of what is not a terminal, where COLUMNS does not say
_LEAST = 20  # columns: fewer than these cannot be meant
_MOST = 1e9  # from here on decimals say nothing
_GAP = 2  # between columns
_LONGEST_WORD = 24  # a longer one (a path) is broken over lines


def new_console() -> Console:
    """Standard output, as wide as the terminal or as COLUMNS says."""
    console = Console(highlight=False, emoji=False)  # a name with ":art:" in it is not to become a picture
    if console.width < _LEAST or (not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit()):
        console.width = _DEFAULT
    return console


def new_table(title: str, *columns: str) -> Table:
    """A table without lines; the first column is set flush left, the others flush right."""
    table = Table(title=escape(title) or None, title_justify="left", title_style="bold", box=None, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if number == 0 else "right")
    return table


def print_table(console: Console, table: Table, keys: int = 1) -> None:
    """Print a table so that nothing in it is cut off.

    Cells wrap between words where the console is narrow. Where even that is not enough, the columns are printed in
    several blocks, each of which begins with the first ``keys`` columns.
    """

    def plain(cell: object) -> str:
        return Text.from_markup(str(cell), emoji=False).plain

    texts = [[plain(cell) for cell in (column.header, *column.cells)] for column in table.columns]
    natural = [max((cell_len(line) for cell in cells for line in cell.split("\n")), default=0) for cells in texts]
    words = [max((cell_len(word) for cell in cells for word in cell.split()), default=0) for cells in texts]
    least = [min(word, _LONGEST_WORD) for word in words]
    for number, block in enumerate(_blocks(least, console.width, keys)):
        widths = _fitted([natural[i] for i in block], [least[i] for i in block], console.width)
        part = Table(title=table.title if number == 0 else None, title_justify="left", title_style="bold", box=None)
        part.pad_edge, part.padding = False, (0, _GAP, 0, 0)
        for i, width in zip(block, widths, strict=True):
            column = table.columns[i]
            part.add_column(column.header, justify=column.justify, width=width, overflow="fold")
        cells = [list(table.columns[i].cells) for i in block]
        for row in zip(*cells, strict=True):
            part.add_row(*row)
        console.print(part, no_wrap=False)


def _blocks(least: list[int], available: int, keys: int) -> list[list[int]]:
    """Columns that fit side by side; the first ones are in every block."""
    blocks, current = [], list(range(keys))
    for i in range(keys, len(least)):
        if len(current) > keys and sum(least[j] + _GAP for j in (*current, i)) - _GAP > available:
            blocks.append(current)
            current = list(range(keys))
        current.append(i)
    return [*blocks, current]


def _fitted(natural: list[int], least: list[int], available: int) -> list[int]:
    """Widths of columns: the natural ones, the widest reduced until all fit."""
    widths = list(natural)
    while sum(widths) + _GAP * (len(widths) - 1) > available:
        wider = [i for i in range(len(widths)) if widths[i] > least[i]]
        if not wider:
            break
        widths[max(wider, key=lambda i: widths[i])] -= 1
    return widths


def formatted(value: float | None, decimals: int = 4) -> str:
    """A number of mm with a fixed number of decimals, or in scientific notation if too small or too large for them."""
    if value is None:
        return "-"
    if abs(value) < 1e-9:  # mm: rounding
        value = 0.0
    if not abs(value) < _MOST:
        return f"{value:.6g}"
    small = value != 0 and abs(value) < 0.5 * 10**-decimals
    return f"{value:.1e}" if small else f"{value:.{decimals}f}"


def print_warnings(console: Console, summary: dict[str, Any]) -> None:
    """What a user should know before the numbers."""
    for warning in summary["warnings"]:
        console.print(f"[yellow]Warning:[/yellow] {escape(warning)}")


def print_verdict(console: Console, summary: dict[str, Any]) -> None:
    """What a result is good for, in one line; summaries of earlier versions have none."""
    verdict = summary.get("verdict")
    if verdict:
        style = {"good": "green", "unsure": "yellow", "bad": "red"}.get(verdict["mark"], "bold")
        console.print(f"[{style}]{escape(verdict['says'])}[/]")


def print_verdicts(console: Console, summary: dict[str, Any]) -> None:
    """Limits that are kept, and limits that are exceeded."""
    for sentence in summary["kept"]:
        console.print(f"[green]Passed:[/green] {escape(sentence)}")
    for sentence in summary["failed"]:
        console.print(f"[red]Failed:[/red] {escape(sentence)}")


def print_written(console: Console, summary: dict[str, Any]) -> None:
    """The file that was written, where there is one."""
    if "written" in summary:
        console.print(f"\nWritten: {escape(summary['written'])}")
