"""Prints the lines and tables of a view on a terminal of any width (`summaries.tables` declares them)."""

import os
from collections.abc import Iterable

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from ..summaries.tables import STYLES, Cell, Line, Styled, Table

_DEFAULT = 110  # columns of what is not a terminal, where COLUMNS does not say
_LEAST = 20  # columns: fewer than these cannot be meant
_GAP = 2  # between columns
_LONGEST_WORD = 24  # a longer one (a path) is broken over lines
_PLAIN = str.maketrans("−–\u00a0", "-- ", "✓✗")  # signs of typography that not every terminal has


def new_console() -> Console:
    """Standard output, as wide as the terminal or as COLUMNS says."""
    console = Console(highlight=False, emoji=False)
    if console.width < _LEAST or (not console.is_terminal and not os.environ.get("COLUMNS", "").isdigit()):
        console.width = _DEFAULT
    return console


def display(view: Iterable[Line | Table]) -> None:
    """Print a view; markup in its texts is shown as it is."""
    console = new_console()
    for part in view:
        if isinstance(part, Table):
            print_table(console, part)
        else:
            parts = (part,) if isinstance(part, str | Styled) else part
            console.print(Text.assemble(*parts))


def print_table(console: Console, table: Table) -> None:
    """Print a table so that nothing in it is cut off.

    Cells wrap between words where the console is narrow. Where even that is not enough, the columns are printed in
    several blocks, each of which begins with the first ``keys`` columns.
    """
    cells = table.cells
    rows = [[Text(heading) for heading in table.headings], *([_text(cell) for cell in row] for row in cells)]
    columns = list(zip(*rows, strict=True))
    numeric = [any(row[i].value is not None for row in cells) for i in range(len(columns))]
    texts = [[cell.plain for cell in column] for column in columns]
    natural = [max(cell_len(line) for cell in cells for line in cell.split("\n")) for cells in texts]
    words = [max((cell_len(word) for cell in cells for word in cell.split()), default=0) for cells in texts]
    least = [min(word, _LONGEST_WORD) for word in words]
    for number, block in enumerate(_blocks(least, console.width, table.keys)):
        widths = _fitted([natural[i] for i in block], [least[i] for i in block], console.width)
        title = Text(f"\n{table.title}") if table.title and number == 0 else None
        part = RichTable(title=title, title_justify="left", title_style="bold", box=None)
        part.pad_edge, part.padding = False, (0, _GAP, 0, 0)
        for i, width in zip(block, widths, strict=True):
            part.add_column(columns[i][0], justify="right" if numeric[i] else "left", width=width, overflow="fold")
        for row in rows[1:]:
            part.add_row(*(row[i] for i in block))
        console.print(part, no_wrap=False)


def _text(cell: Cell) -> Text:
    return Text(cell.text.translate(_PLAIN).strip(), STYLES.get(cell.mark, ""))


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
