"""A plan on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise
from .display import new_console, new_table, print_table, print_written


@contextmanager
def progress() -> Iterator[Callable[[str, float], None]]:
    """A bar on standard error, where that is a terminal; yields the callback that moves it."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what, fraction: None
        return
    from rich.progress import Progress

    with Progress(console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def report(what: str, fraction: float) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=fraction)

        yield report


def plan(summary: dict[str, Any]) -> None:
    """Positions of the sockets, and the predicted uncertainty, compared with that of random poses."""
    console = new_console()
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {summary['poses']} poses in "
        f"{pluralise(len(summary['sockets']), 'socket')}"
    )
    table = new_table("", "socket", "x [mm]", "y [mm]", "z [mm]", "poses")
    for row in summary["sockets"]:
        table.add_row(escape(row["socket"]), *(f"{value:.0f}" for value in row["position_mm"]), str(row["poses"]))
    print_table(console, table)
    for row in summary["lengths"]:
        console.print(
            f"Reference length {escape(row['from'])} - {escape(row['to'])}: {row['value_mm']:.1f} mm, "
            f"u = {1e3 * row['u_mm']:.3g} um"
        )
    _print_predictions(console, summary, "random poses in the same sockets")
    print_written(console, summary)


def kit_plan(summary: dict[str, Any]) -> None:
    """Where artefacts are put, how many poses each gets, and the predicted uncertainty, also without each part."""
    console = new_console()
    console.print(f"[bold]{escape(summary['arm'])}[/bold]: {pluralise(summary['poses'], 'pose')}")
    table = new_table("", "observation", "kind", "tip's x [mm]", "y [mm]", "z [mm]", "poses")
    for row in summary["observations"]:
        for number, place in enumerate(row["places"]):
            name, kind = (escape(row["observation"]), row["kind"]) if number == 0 else ("", "")
            table.add_row(name, kind, *(f"{value:.0f}" for value in place["position_mm"]), str(place["poses"]))
    print_table(console, table)
    console.print("Positions are those of the points of an artefact; elsewhere the middle of the tips.")
    rows = [
        (f"without {escape(name)}: {pluralise(_poses_without(summary, name), 'pose')}", prediction)
        for name, prediction in summary["without"].items()
    ]
    _print_predictions(console, summary, "random poses in the same places", rows)
    print_written(console, summary)


def _poses_without(summary: dict[str, Any], name: str) -> int:
    """Poses of a plan but those with one thing of the kit, whose places are named after it."""
    return sum(
        place["poses"]
        for row in summary["observations"]
        if row["observation"] != name and not row["observation"].startswith(f"{name}/")
        for place in row["places"]
    )


def _print_predictions(
    console: Console,
    summary: dict[str, Any],
    random: str,
    more: list[tuple[str, dict[str, float] | None]] | None = None,
) -> None:
    length = f"{summary['check_length_mm']:g} mm"
    console.print(
        f"\n[bold]Standard uncertainty that the calibration adds to lengths of {length} over the volume \\[um][/bold]"
    )
    table = new_table("", "", "median", "largest")
    for key, text in (
        ("predicted", "this plan"),
        ("loose", "this plan, joints kept to about 5 deg only"),
        ("random", f"{summary['poses']} {random}"),
        ("more", f"this plan and {summary['more_poses']} more poses"),
    ):
        table.add_row(text, *(f"{1e3 * summary[key][which]:.1f}" for which in ("median_mm", "largest_mm")))
    for text, prediction in more or []:
        values = (
            ["not determined", ""]
            if prediction is None
            else [f"{1e3 * prediction[which]:.1f}" for which in ("median_mm", "largest_mm")]
        )
        table.add_row(text, *values)
    print_table(console, table)
    slide = summary["linear_encoder_mm"]
    linear, option = (
        ("", "") if slide is None else (f", linear ones of {1e3 * slide:.3g} um", f"--linear-encoder-mm {slide:.3g} ")
    )
    console.print(
        f"For a joint calibration with encoders of {summary['encoder_arcsec']:g} arcsec{linear} and a seat of "
        f"{1e3 * summary['seating_mm']:g} um (--method joint --encoder-arcsec {summary['encoder_arcsec']:g} "
        f"{option}--seating-mm {summary['seating_mm']:g})."
    )
    console.print(
        "Checked: joint limits, reach, and that nothing comes below the table. Not checked: obstacles, collisions of "
        "the arm with itself, and from which side a socket can be entered (the plan's file has the probe's direction)."
    )
