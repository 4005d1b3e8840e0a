"""What people see of a plan."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from ..core.text import pluralise
from ..summaries.tables import Cell, Line, Styled, listed, number, written_of
from .calibration_views import View

_PREDICTED = {
    "predicted": "this plan",
    "loose": "this plan, joints kept to about 5 deg only",
    "random": "{poses} {random}",
    "more": "this plan and {more_poses} more poses",
    "unconstrained": "as many without cones, obstacles and approach points",
}


@contextmanager
def progress() -> Iterator[Callable[[str, float], None]]:
    """A bar on standard error, where that is a terminal; yields the callback that moves it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda what, fraction: None
        return
    with Progress(console=console, transient=True) as bar:
        tasks: dict[str, Any] = {}

        def report(what: str, fraction: float) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=1.0)
            bar.update(tasks[what], completed=fraction)

        yield report


def plan(summary: dict[str, Any]) -> View:
    """Positions of the sockets, and the predicted uncertainty, compared with that of random poses."""
    sockets = pluralise(len(summary["sockets"]), "socket")
    yield [Styled(summary["arm"]), f": {summary['poses']} poses in {sockets}"]
    yield listed("", summary["sockets"], {
        "socket": "socket",
        **_position(),
        "poses": "poses",
        "cone [deg]": lambda row: "any" if row["cone_deg"] >= 180 else number(row["cone_deg"], 0),
        "largest tilt [deg]": lambda row: number(row["largest_tilt_deg"], 0),
    })  # fmt: skip
    for row in summary["lengths"]:
        ends = f"{row['from']} - {row['to']}"
        yield f"Reference length {ends}: {row['value_mm']:.1f} mm, u = {row['u_mm']:.3g} mm"
    yield from _predictions(summary, "random poses in the same sockets")
    yield from written_of(summary)


def kit_plan(summary: dict[str, Any]) -> View:
    """Where artefacts are put, how many poses each gets, and the predicted uncertainty, also without each part."""
    yield [Styled(summary["arm"]), f": {pluralise(summary['poses'], 'pose')}"]
    rows = []
    for row in summary["observations"]:
        for i, place in enumerate(row["places"]):
            names = (row["observation"], row["kind"]) if i == 0 else ("", "")
            rows.append((*names, *(number(value, 0) for value in place["position_mm"]), place["poses"]))
    yield listed("", rows, ("observation", "kind", "tip's x [mm]", "y [mm]", "z [mm]", "poses"))
    yield "Positions are those of the points of an artefact; elsewhere the middle of the tips."

    def poses_without(name: str) -> int:
        """Poses of a plan but those with one thing of the kit, whose places are named after it."""
        others = [row for row in summary["observations"] if not f"{row['observation']}/".startswith(f"{name}/")]
        return sum(place["poses"] for row in others for place in row["places"])

    without = [
        (f"without {name}: {pluralise(poses_without(name), 'pose')}", prediction)
        for name, prediction in summary["without"].items()
    ]
    yield from _predictions(summary, "random poses in the same places", without)
    yield from written_of(summary)


def _position() -> dict[str, Callable[[dict[str, Any]], Cell]]:
    return {f"{axis} [mm]": lambda row, i=i: number(row["position_mm"][i], 0) for i, axis in enumerate("xyz")}


def _predictions(summary: dict[str, Any], random: str, others: Sequence[tuple[str, Any]] = ()) -> View:
    """U of a length by this plan, and by what it is compared with; the noise it assumes; how the arm moves."""
    length = f"{summary['check_length_mm']:g} mm"
    yield ["\n", Styled(f"U that the calibration adds to lengths of {length} over the volume [mm, k = 2]")]
    named = [
        (text.format(**summary | {"random": random}), summary[key])
        for key, text in _PREDICTED.items()
        if summary[key] is not None
    ]
    rows = [
        (text, *(("not determined", "") if u is None else (2 * u["median_mm"], 2 * u["largest_mm"])))
        for text, u in (*named, *others)
    ]
    yield listed("", rows, ("", "median", "largest"))
    yield _noise(summary)
    yield from _motion(summary)


def _noise(summary: dict[str, Any]) -> Line:
    """The noise that the plan assumes, and where its numbers come from."""
    encoders, seat, slide = summary["encoder_arcsec"], summary["seating_mm"], summary["linear_encoder_mm"]
    by_joint = isinstance(encoders, list)
    text = ", ".join(f"{value:.3g}" for value in encoders) if by_joint else f"{encoders:.3g}"
    linear = "" if slide is None else f", linear ones of {slide:.3g} mm"
    model = "" if summary.get("model") is None else f"--model {summary['model']} "
    options = "" if slide is None else f"--linear-encoder-mm {slide:.3g} "
    options = f" (--method joint {model}--encoder-arcsec {text} {options}--seating-mm {seat:g})"
    return (
        f"For a joint calibration with encoders of {text} arcsec{linear} and a seat of {seat:g} mm"
        f"{'' if by_joint else options}; {summary['noise_source']}."
    )


def _motion(summary: dict[str, Any]) -> View:
    """Tilt, travel, clearance, and what was checked."""
    collisions, retract, tilt = summary["collisions"], summary["retract_mm"], summary["largest_tilt_deg"]
    by_way = f" by way of approach points {retract:g} mm above the sockets" if retract else ""
    yield (
        ("" if tilt is None else f"Largest tilt from a normal {tilt:.0f} deg. ")
        + f"Joint travel {summary['travel_deg']:,.0f} deg{by_way} ({summary['unordered_travel_deg']:,.0f} before "
        "ordering; each joint counts by what it carries)."
    )
    if collisions is None:
        yield (
            "Checked: joint limits, reach, cones of approach, and that nothing comes below the table. Not checked: "
            "obstacles and collisions of the arm with itself (--collisions, --cell, --link-radius-mm)."
        )
        return
    yield (
        "Checked: joint limits, reach, cones of approach, the arm's body against itself and obstacles "
        f"({', '.join(collisions['obstacles']) or 'none'}), in each pose and along the straight joint moves between "
        f"them. Smallest clearance of a pose {collisions['smallest_clearance_mm']:.0f} mm."
    )
    if collisions["unchecked"]:
        pairs = "; ".join(" and ".join(pair) for pair in collisions["unchecked"])
        yield f"Not checked, since they touch wherever the arm is: {pairs}."
    for row in collisions["blocked_moves"]:
        yield Styled(
            f"The straight joint move to pose {row['before_pose']} ({row['at']}) hits: {' and '.join(row['between'])}; "
            "go there by another way.",
            "yellow",
        )
    for note in summary["notes"]:
        yield f"Note: {note}"
