"""A plan on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape

from .display import _console, _table, _written


@contextmanager
def progress() -> Iterator[Callable[[str, float], None]]:
    """A bar on standard error, where that is a terminal; yields what tells it how far the work is."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what, share: None
        return
    from rich.progress import Progress

    with Progress(console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def tell(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=share)

        yield tell


def plan(summary: dict[str, Any]) -> None:
    """Where the sockets stand, and what the plan promises beside random poses."""
    console = _console()
    console.print(f"[bold]{escape(summary['arm'])}[/bold]: {summary['poses']} poses in {len(summary['sockets'])} sockets")
    table = _table("", "socket", "x [mm]", "y [mm]", "z [mm]", "poses")
    for row in summary["sockets"]:
        table.add_row(escape(row["socket"]), *(f"{value:.0f}" for value in row["position_mm"]), str(row["poses"]))
    console.print(table)
    for row in summary["lengths"]:
        console.print(
            f"Reference length {escape(row['from'])} - {escape(row['to'])}: {row['value_mm']:.1f} mm, u = {1e3 * row['u_mm']:.3g} um"
        )
    length = f"{summary['check_length_mm']:g} mm"
    console.print(
        f"\n[bold]Standard uncertainty that the calibration adds to lengths of {length} over the volume \\[um][/bold]"
    )
    table = _table("", "", "median", "largest")
    for key, text in (
        ("predicted", "this plan"),
        ("loose", "this plan, joints kept to about 5 deg only"),
        ("random", f"{summary['poses']} random poses in the same sockets"),
        ("more", f"this plan and {summary['more_poses']} more poses"),
    ):
        table.add_row(text, *(f"{1e3 * summary[key][figure]:.1f}" for figure in ("median_mm", "largest_mm")))
    console.print(table)
    console.print(
        f"For a joint calibration with encoders of {summary['encoder_arcsec']:g} arcsec and a seat of "
        f"{1e3 * summary['seating_mm']:g} um (--method joint --encoder-arcsec {summary['encoder_arcsec']:g} --seating-mm "
        f"{summary['seating_mm']:g})."
    )
    console.print(
        "Looked at: joint limits, reach, and that nothing comes below the table. Not looked at: obstacles, the arm's own body, and from "
        "which side a socket can be entered (the plan's file has the probe's direction)."
    )
    _written(console, summary)
