"""A plan on a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise
from .display import formatted, new_console, new_table, print_table, print_written


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
    table = new_table("", "socket", "x [mm]", "y [mm]", "z [mm]", "poses", "cone [deg]", "largest tilt [deg]")
    for row in summary["sockets"]:
        cone = "any" if row["cone_deg"] >= 180 else f"{row['cone_deg']:.0f}"
        table.add_row(
            escape(row["socket"]),
            *(f"{value:.0f}" for value in row["position_mm"]),
            str(row["poses"]),
            cone,
            f"{row['largest_tilt_deg']:.0f}",
        )
    print_table(console, table)
    for row in summary["lengths"]:
        console.print(
            f"Reference length {escape(row['from'])} - {escape(row['to'])}: {row['value_mm']:.1f} mm, "
            f"u = {row['u_mm']:.3g} mm"
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
    console.print(f"\n[bold]U that the calibration adds to lengths of {length} over the volume \\[mm, k = 2][/bold]")
    table = new_table("", "", "median", "largest")
    for key, text in (
        ("predicted", "this plan"),
        ("loose", "this plan, joints kept to about 5 deg only"),
        ("random", f"{summary['poses']} {random}"),
        ("more", f"this plan and {summary['more_poses']} more poses"),
        ("unconstrained", "as many without cones, obstacles and approach points"),
    ):
        if summary[key] is None:
            continue
        table.add_row(text, *(formatted(2 * summary[key][which]) for which in ("median_mm", "largest_mm")))
    for text, prediction in more or []:
        values = (
            ["not determined", ""]
            if prediction is None
            else [formatted(2 * prediction[which]) for which in ("median_mm", "largest_mm")]
        )
        table.add_row(text, *values)
    print_table(console, table)
    _print_noise(console, summary)
    _print_motion(console, summary)


def _print_noise(console: Console, summary: dict[str, Any]) -> None:
    """The noise that the plan assumes, and where its numbers come from."""
    encoders, seat = summary["encoder_arcsec"], summary["seating_mm"]
    each = isinstance(encoders, list)
    text = ", ".join(f"{value:.3g}" for value in encoders) if each else f"{encoders:.3g}"
    slide = summary["linear_encoder_mm"]
    linear, option = ("", "")
    if slide is not None:
        linear, option = f", linear ones of {slide:.3g} mm", f"--linear-encoder-mm {slide:.3g} "
    model = "" if summary.get("model") is None else f"--model {summary['model']} "
    options = "" if each else f" (--method joint {model}--encoder-arcsec {encoders:.3g} {option}--seating-mm {seat:g})"
    console.print(
        f"For a joint calibration with encoders of {text} arcsec{linear} and a seat of {seat:g} mm{options}; "
        f"{escape(summary['noise_source'])}."
    )


def _print_motion(console: Console, summary: dict[str, Any]) -> None:
    """Tilt, travel, clearance, and what was checked."""
    found, retract = summary["collisions"], summary["retract_mm"]
    by_way = f" by way of approach points {retract:g} mm above the sockets" if retract else ""
    tilt = summary["largest_tilt_deg"]
    tilted = "" if tilt is None else f"Largest tilt from a normal {tilt:.0f} deg. "
    console.print(
        f"{tilted}Joint travel {summary['travel_deg']:,.0f} "
        f"deg{by_way} ({summary['unordered_travel_deg']:,.0f} before ordering; each joint counts by what it carries)."
    )
    if found is None:
        console.print(
            "Checked: joint limits, reach, cones of approach, and that nothing comes below the table. Not checked: "
            "obstacles and collisions of the arm with itself (--collisions, --cell, --link-radius-mm)."
        )
        return
    obstacles = ", ".join(escape(name) for name in found["obstacles"]) or "none"
    console.print(
        f"Checked: joint limits, reach, cones of approach, the arm's body against itself and obstacles ({obstacles}), "
        "in each pose and along the straight joint moves between them. Smallest clearance of a pose "
        f"{found['smallest_clearance_mm']:.0f} mm."
    )
    if found["unchecked"]:
        pairs = "; ".join(f"{escape(one)} and {escape(other)}" for one, other in found["unchecked"])
        console.print(f"Not checked, since they touch wherever the arm is: {pairs}.")
    for row in found["blocked_moves"]:
        one, other = (escape(name) for name in row["between"])
        console.print(
            f"[yellow]The straight joint move to pose {row['before_pose']} ({escape(row['at'])}) hits: {one} and "
            f"{other}; go there by another way.[/yellow]"
        )
    for note in summary["notes"]:
        console.print(f"Note: {escape(note)}")
