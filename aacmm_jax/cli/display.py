"""Prints the lines and tables of a view on a terminal of any width (`summaries.tables` declares them)."""

import os
from collections.abc import Iterable

from rich.cells import cell_len
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from ..summaries.tables import STYLES, Line, Styled, Table

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
    several blocks, each of which begins with the first column.
    """
    cells, columns = table.cells, range(len(table.headings))
    rows = [[Text(cell.text.translate(_PLAIN).strip(), STYLES.get(cell.mark, "")) for cell in row] for row in cells]
    texts = [[table.headings[i], *(row[i].plain for row in rows)] for i in columns]
    natural = [max(cell_len(line) for text in column for line in text.split("\n")) for column in texts]
    words = [max((cell_len(word) for text in column for word in text.split()), default=0) for column in texts]
    least = [min(word, _LONGEST_WORD) for word in words]
    blocks = [[0]]
    for i in columns[1:]:
        width = sum(least[j] + _GAP for j in (*blocks[-1], i)) - _GAP
        if width > console.width and len(blocks[-1]) > 1:
            blocks.append([0])
        blocks[-1].append(i)
    for block in blocks:
        widths = {i: natural[i] for i in block}
        # The widest column that can be narrower gives way until all fit.
        while sum(widths.values()) + _GAP * (len(widths) - 1) > console.width:
            wider = [i for i in block if widths[i] > least[i]]
            if not wider:
                break
            widths[max(wider, key=lambda i: widths[i])] -= 1
        title = Text(f"\n{table.title}") if table.title and block is blocks[0] else None
        part = RichTable(title=title, title_justify="left", title_style="bold", box=None)
        part.pad_edge, part.padding = False, (0, _GAP, 0, 0)
        for i in block:
            numeric = any(row[i].value is not None for row in cells)
            justify = "right" if numeric else "left"
            part.add_column(Text(table.headings[i]), justify=justify, width=widths[i], overflow="fold")
        for row in rows:
            part.add_row(*(row[i] for i in block))
        console.print(part, no_wrap=False)
