"""What ``aacmm arm`` prints for people."""

from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise
from ..summaries.reading_check import alternatives_sentence
from . import calibration_display
from .display import formatted, new_console, new_table, print_table, print_warnings, print_written


def survey(summary: dict[str, Any]) -> None:
    """An arm before its first calibration."""
    console = new_console()
    calibration_display.arm(summary)
    print_warnings(console, summary)
    table = new_table("\nAxes at zero readings", "joint", "through x [mm]", "y [mm]", "z [mm]", "direction x", "y", "z")
    for row in summary["frames"]:
        name = "tip" if row["joint"] is None else str(row["joint"])
        numbers = [formatted(x, 3) for x in row["origin_mm"]] + [f"{round(x, 4) + 0.0:.4f}" for x in row["axis"]]
        table.add_row(name, *numbers)
    print_table(console, table)
    reach = summary["reach_mm"]
    console.print(
        f"\nReach: {reach['nearest']:.0f} to {reach['farthest']:.0f} mm from the shoulder, on the first axis at "
        f"({', '.join(f'{x:.0f}' for x in reach['shoulder'])}) mm (self-collision is not considered). "
        f"The links together measure {reach['links']:.0f} mm."
    )
    if summary["determined"]:
        _determined(console, summary)
    if summary["needed"]:
        _needed(console, summary)
    print_written(console, summary)


def _determined(console: Console, summary: dict[str, Any]) -> None:
    console.print(f"\n[bold]Redundant[/bold], whatever is recorded ({summary['parameters']} parameters in all):")
    for text in summary["redundant"]:
        console.print(f"  {escape(text)}")
    if summary["weak"]:
        console.print("[bold]Hardly determined[/bold], even by poses all over the workspace:")
        for text in summary["weak"]:
            console.print(f"  {escape(text)}")
    why = [text for row in summary["determined"][1:2] for text in row["corrections"]]
    if summary["corrections_left_out"] or why:
        console.print("[bold]Joint corrections[/bold]:")
        for text in (*summary["corrections_left_out"], *why):
            console.print(f"  {escape(text)}")
    for i in summary["parallel"]:
        console.print(f"  Axes {i} and {i + 1} are nearly parallel: beta_{i} takes the place of d_{i}.")
    table = new_table("\nWhat data determine at their best", "data", "parameters", "well", "scale")
    for row in summary["determined"]:
        table.add_row(
            escape(row["data"]), str(row["determined"]), str(row["well_determined"]), "yes" if row["scale"] else "no"
        )
    print_table(console, table)
    console.print(f"To be freed, of sockets with a length: {len(summary['free'])}: {', '.join(summary['free'])}.")
    console.print("\n[bold]Where a joint stays still in all poses[/bold]")
    table = new_table("", "joint", "no longer determined well")
    table.columns[1].justify = "left"
    for row in summary["still"]:
        lost = "(the tip can hardly stay in a socket then)" if row["lost"] is None else ", ".join(row["lost"])
        table.add_row(str(row["joint"]), lost or "-")
    print_table(console, table)


def _needed(console: Console, summary: dict[str, Any]) -> None:
    for kind in summary["needed"]:
        counts = list(kind["rows"][0]["u_mm"])
        console.print(
            "\n[bold]U of a length that a calibration from random poses adds[/bold] \\[mm, k = 2]: "
            f"{escape(kind['class'])}"
        )
        table = new_table("", "data", *(f"{count} poses" for count in counts), "enough")
        for row in kind["rows"]:
            u = [None if x is None else 2 * x for x in row["u_mm"].values()]
            table.add_row(escape(row["data"]), *(formatted(x) for x in u), str(row["enough_poses"] or "-"))
        print_table(console, table)
        console.print(
            f"Medians over the volume, of encoders of {kind['encoder_arcsec']:.3g} arcsec and a seat of "
            f"{kind['seating_mm']:.3g} mm ({escape(kind['noise_source'])}), reference lengths of "
            f"u = {kind['u_length_mm']:g} mm, and a tracker of u = {kind['u_tracker_mm']:g} mm in each coordinate. Two "
            "sockets and a reference length are as good as a ball bar in one place."
        )
        console.print(
            f"Enough: poses from which on this is less than the noise of the readings themselves, "
            f"{formatted(2 * kind['u_reading_mm'])} mm."
        )
    console.print(f"\n{escape(summary['advice'])}")


def check(summary: dict[str, Any]) -> None:
    """Readings compared with an arm."""
    console = new_console()
    colour = "green" if summary["fits"] else "yellow" if summary["explained"] else "red"
    console.print(f"[{colour}]{escape(summary['sentence'])}[/{colour}]")
    if summary["tip"]:
        console.print(escape(summary["tip"]))
    if summary["unit"] is not None:
        console.print(f"Readings were taken to be in {summary['unit']}.")
    outside = (summary["found"] or summary["given"])["readings_outside_limits"]
    if outside:
        console.print(f"{pluralise(outside, 'reading')} are outside the joint limits.")
    words = alternatives_sentence(summary["alternatives"], summary["known_positions"])
    if words:
        console.print(escape(words))
    for row in summary["standing"]:
        console.print(f"[yellow]{escape(row['says'])}[/yellow]")
    if summary["reading_sets_sentence"]:
        console.print(escape(summary["reading_sets_sentence"]))
    if summary["units"] is not None:
        console.print("\nIn the manifest, in the table of the measured positions:")
        console.print(escape(summary["units"]), end="")
    if summary["angles"] is not None:
        console.print("\nIn the manifest:")
        console.print(escape(summary["angles"]), end="")
    console.print(f"\n{pluralise(summary['poses'], 'pose')}, {summary['hypotheses']:,} possibilities tried.")
