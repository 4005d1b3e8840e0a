"""Plans of poses and of acceptance tests as plain dictionaries with the unit in every key, and as people see them."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..acceptance.procedure import Procedure
from ..acceptance.standards import STANDARDS
from ..core.text import listed as listed_words
from ..core.text import pluralise
from ..data.noise import linear_encoder_mm
from ..kinematics.robots import chains_taken
from ..planning.design import Plan
from ..planning.kit import KitPlan
from ..planning.motion import Motion
from ..planning.problem import MORE, Prediction
from ..uncertainty.coverage import COVERAGE_FACTOR, K_IN_WORDS
from .calibration import reference_length_rows
from .tables import Styled, View, attributes, listed, number, two_digits, warnings_of, written_of

_PREDICTED = {
    "predicted": "this plan",
    "loose": "this plan, with joints set only to within about 5 deg",
    "random": "{poses} random poses in the same {where}",
    "more": "this plan and {more_poses} more poses",
    "unconstrained": "{poses} poses planned without limits of {limited}",
}


def plan_summary(plan: Plan, arm: str) -> dict[str, Any]:
    """Positions of the sockets, how many poses each gets, and the predicted uncertainties."""
    rows = [
        {
            "socket": name,
            "position_mm": list(point),
            "poses": int(np.sum(plan.owner == i)),
            **({"chains": dict(Counter(chains_taken(plan.arm, plan.q[plan.owner == i])))} if plan.arm.chains else {}),
            "normal": plan.cones.normals[i].tolist(),
            "cone_deg": math.degrees(float(plan.cones.half_angles[i])),
            "largest_tilt_deg": math.degrees(float(plan.motion.tilt[plan.owner == i].max())),
        }
        for i, (name, point) in enumerate(plan.sockets.items())
    ]
    lengths = reference_length_rows(plan.lengths, u_mm=[float(length.u) for length in plan.lengths])
    stated = _stated(plan, arm, [plan.motion], list(plan.sockets), plan.owner)
    return {"kind": "plan", **stated, "sockets": rows, "lengths": lengths}


def kit_plan_summary(plan: KitPlan, arm: str) -> dict[str, Any]:
    """Where everything is put, how many poses each gets, the predicted uncertainties, and what each part adds."""
    rows = []
    for simulated, observation, part in zip(plan.kit, plan.observations, plan.parts, strict=True):
        held = plan.arm if simulated.offset is None else plan.arm.replace(probe=simulated.offset)
        tips, places = np.asarray(held.position(np.asarray(observation.q))), observation.places
        put = [
            {"position_mm": tips[places == i].mean(axis=0).tolist(), "poses": int(np.sum(places == i))}
            for i in range(int(places.max()) + 1)
        ]
        row = {"observation": observation.name, "kind": observation.kind, "part": part}
        rows.append(row | {"poses": observation.q.shape[0], "places": put})
    owner = np.repeat(np.arange(len(rows)), [row["poses"] for row in rows])
    without = {name: _prediction(u) if np.isfinite(u.largest) else None for name, u in plan.without.items()}
    stated = _stated(plan, arm, plan.motions, [row["observation"] for row in rows], owner)
    return {"kind": "kit plan", **stated, "held": list(plan.held), "observations": rows, "without": without}


def _stated(
    plan: Plan | KitPlan, arm: str, motions: Sequence[Motion], names: Sequence[str], owner: np.ndarray
) -> dict[str, Any]:
    """What both kinds of plans state: the noise assumed, how the arm moves (largest tilt, smallest clearance, travel,
    moves that hit something by pose number), and the predicted uncertainties."""
    tilts = np.concatenate([np.zeros(0), *(motion.tilt[np.isfinite(motion.tilt)] for motion in motions)])
    collisions, cell = None, plan.cell
    if cell is not None:
        starts = np.cumsum([0, *(len(motion.tilt) for motion in motions)]).tolist()
        hits = [
            (start + index, [part, touched])
            for start, motion in zip(starts, motions, strict=False)
            for index, part, touched in motion.blocked
        ]
        clearances = [motion.clearance.min() for motion in motions if motion.clearance is not None]
        collisions = {
            "smallest_clearance_mm": float(min(clearances)),
            "allowed_clearance_mm": cell.clearance,
            "obstacles": [obstacle.name for obstacle in cell.obstacles],
            "unchecked": [list(pair) for pair in cell.unchecked],
            "blocked_moves": [{"before_pose": i + 1, "at": names[int(owner[i])], "between": pair} for i, pair in hits],
        }
    return {
        "arm": arm,
        **attributes(plan, "criterion", check_length_mm="check_length"),
        "poses": len(owner),
        "encoder_arcsec": np.asarray(plan.noise.encoder_arcsec).tolist(),
        "linear_encoder_mm": linear_encoder_mm(plan.noise, plan.arm),
        "seating_mm": float(plan.noise.seating),
        "largest_tilt_deg": float(np.degrees(tilts.max())) if len(tilts) else None,
        "heights_mm": plan.heights and [height if math.isfinite(height) else None for height in plan.heights],
        "retract_mm": plan.retract if any(motion.approach is not None for motion in motions) else 0.0,
        "travel_deg": math.degrees(sum(motion.travel for motion in motions)),
        "unordered_travel_deg": math.degrees(sum(motion.unordered for motion in motions)),
        "collisions": collisions,
        **{name: _prediction(getattr(plan, name)) for name in _PREDICTED},
        "more_poses": MORE,
    }


def _prediction(prediction: Prediction | None) -> dict[str, float] | None:
    return None if prediction is None else {"median_mm": prediction.median, "largest_mm": prediction.largest}


def procedure_summary(procedure: Procedure, arm: str) -> dict[str, Any]:
    """A planned acceptance test: what to set up, and how many poses to take."""
    lengths = Counter(value for *_, value in procedure.lengths)
    return {
        "kind": "acceptance plan",
        "arm": arm,
        "standard": STANDARDS[procedure.standard],
        **attributes(procedure, "poses", measuring_range_mm="measuring_range", measuring_range_stated="range_stated"),
        **attributes(procedure.reach, reach_mm="radius", shoulder_mm="shoulder"),
        "bars": [{"length_mm": value, "positions": count} for value, count in lengths.items()],
        "spheres": [
            attributes(sphere, "name", "test", diameter_mm="diameter", centre_mm="centre")
            for sphere in procedure.spheres
        ],
        "items": [
            attributes(item, "test", "name", "group")
            | {"position_mm": item.points.mean(axis=0).tolist(), "poses": len(item.q)}
            for item in (*procedure.sockets, *procedure.touches)
        ],
        "warnings": list(procedure.left_out),
    }


def plan(summary: dict[str, Any]) -> View:
    """Positions of the sockets, and the predicted uncertainty, compared with that of random poses."""
    yield from _answer(summary)
    sockets = pluralise(len(summary["sockets"]), "socket")
    chains = sorted({chain for row in summary["sockets"] for chain in row.get("chains", ())})
    yield [Styled(summary["arm"]), f": {summary['poses']} poses in {sockets}"]
    yield listed("", summary["sockets"], {
        "socket": "socket",
        **{f"{axis} [mm]": lambda row, i=i: number(row["position_mm"][i], 0) for i, axis in enumerate("xyz")},
        "poses": "poses",
        **{chain: lambda row, chain=chain: row["chains"].get(chain, 0) for chain in chains},
        "cone [deg]": lambda row: "any" if row["cone_deg"] >= 180 else number(row["cone_deg"], 0),
        "largest tilt [deg]": lambda row: number(row["largest_tilt_deg"], 0),
    })  # fmt: skip
    for row in summary["lengths"]:
        ends = f"{row['from']} - {row['to']}"
        yield f"Reference length {ends}: {row['value_mm']:.1f} mm, u = {row['u_mm']:.3g} mm"
    yield from _limits(summary, {row["cone_deg"] for row in summary["sockets"]})
    yield from _predictions(summary, "sockets")
    yield from written_of(summary)


def kit_plan(summary: dict[str, Any]) -> View:
    """Where artefacts are put, how many poses each gets, and the predicted uncertainty, also without each part."""
    yield from _answer(summary)
    yield [Styled(summary["arm"]), f": {pluralise(summary['poses'], 'pose')}"]
    if summary["held"]:
        held = listed_words(summary["held"])
        yield f"Held at their nominal values, since no poses with this kit determine them: {held}."
    rows = []
    for row in summary["observations"]:
        for i, place in enumerate(row["places"]):
            names = (row["observation"], row["kind"]) if i == 0 else ("", "")
            rows.append((*names, *(number(value, 0) for value in place["position_mm"]), place["poses"]))
    yield listed("", rows, ("observation", "kind", "x [mm]", "y [mm]", "z [mm]", "poses"))
    yield (
        "Positions: for an artefact, the centre of its points; for all other observations, the centre of the tip "
        "positions."
    )
    without = {}
    for name, prediction in summary["without"].items():
        # The places of a thing of the kit are named after it.
        others = [row for row in summary["observations"] if not f"{row['observation']}/".startswith(f"{name}/")]
        poses = sum(place["poses"] for row in others for place in row["places"])
        without[f"without {name}: {pluralise(poses, 'pose')}"] = prediction
    yield from _limits(summary, set())
    yield from _predictions(summary, "places", without)
    yield from written_of(summary)


def _answer(summary: dict[str, Any]) -> View:
    """How good a calibration with this plan will be."""
    predicted = summary["predicted"]
    if predicted is None or not math.isfinite(predicted["largest_mm"]):
        yield Styled(
            "With these poses, a calibration does not determine lengths everywhere in the working volume.", "red"
        )
        return
    median, largest = (two_digits(COVERAGE_FACTOR * predicted[f"{which}_mm"]) for which in ("median", "largest"))
    yield Styled(
        f"A calibration with these {pluralise(summary['poses'], 'pose')} contributes {median} mm to U of a length of "
        f"{summary['check_length_mm']:g} mm ({K_IN_WORDS}; at worst {largest} mm)."
    )


def _limits(summary: dict[str, Any], cones: set[float]) -> View:
    """Where sockets or artefacts may be placed, and from which directions the tool may come to them."""
    limits, (low, high) = [], summary["heights_mm"] or (None, None)
    if low is not None or high is not None:
        ends = [f"from {low:g} mm"] * (low is not None) + [f"to {high:g} mm"] * (high is not None)
        limits.append(f"{'sockets' if cones else 'artefacts'} at z {' '.join(ends)} (--region)")
    if min(cones, default=180) < 180:
        angle = f"{min(cones):.3g} deg" if len(cones) == 1 else "the angle in the table"
        axis = f" (axis {summary['tool_axis']} of the last frame)" if "tool_axis" in summary else ""
        limits.append(f"tool{axis} within {angle} of the socket normal (--cone-deg)")
    if limits:
        cost = "" if summary["unconstrained"] else " To see what these limits cost, add --unconstrained."
        yield f"Limits: {'; '.join(limits)}.{cost}"


def _predictions(summary: dict[str, Any], where: str, without: dict[str, Any] | None = None) -> View:
    """U of a length by this plan, and by what it is compared with; the noise it assumes; how the arm moves."""
    length = f"{summary['check_length_mm']:g} mm"
    title = f"Contribution of the calibration to U of lengths of {length} over the volume [mm, {K_IN_WORDS}]"
    yield ["\n", Styled(title)]
    limited = "direction, obstacles and approach points"
    limited = f"height, {limited}" if where == "sockets" and summary["heights_mm"] else limited
    titles = {key: text.format(**summary, where=where, limited=limited) for key, text in _PREDICTED.items()}
    predictions = {title: summary[key] for key, title in titles.items() if summary[key] is not None} | (without or {})
    yield listed("", predictions.items(), {
        "": lambda row: row[0],
        "median": lambda row: "not determined" if row[1] is None else COVERAGE_FACTOR * row[1]["median_mm"],
        "largest": lambda row: "" if row[1] is None else COVERAGE_FACTOR * row[1]["largest_mm"],
    })  # fmt: skip
    encoders, seat, slide = summary["encoder_arcsec"], summary["seating_mm"], summary["linear_encoder_mm"]
    by_joint = isinstance(encoders, list)
    arcsec = ", ".join(f"{value:.3g}" for value in encoders) if by_joint else f"{encoders:.3g}"
    linear, option = (
        ("", "") if slide is None else (f", {slide:.3g} mm (linear encoders)", f"--linear-encoder-mm {slide:.3g} ")
    )
    model = "" if summary.get("model") is None else f"--model {summary['model']} "
    source = f"; {summary['noise_source']}" if "noise_source" in summary else ""
    options = f" (--method joint {model}--encoder-arcsec {arcsec} {option}--seating-mm {seat:g})"
    yield (
        f"Assumed: one least-squares fit of all data{'' if by_joint else options}; noise of {arcsec} arcsec "
        f"(encoders){linear} and {seat:g} mm (seating{source})."
    )
    collisions, retract, tilt = summary["collisions"], summary["retract_mm"], summary["largest_tilt_deg"]
    by_way = f" via approach points {retract:g} mm above the sockets" if retract else ""
    yield (
        ("" if tilt is None else f"Largest angle between tool and socket normal: {tilt:.0f} deg. ")
        + f"Joint travel: {summary['travel_deg']:,.0f} deg{by_way} ({summary['unordered_travel_deg']:,.0f} deg before "
        "ordering; each joint is weighted by the length of the arm beyond this joint)."
    )
    if collisions is None:
        yield (
            "Checked: joint limits, reach, cones of approach, and that no part of the arm is below the table. Not "
            "checked: obstacles and collisions of the arm with itself (use --collisions, --cell or --link-radius-mm)."
        )
    else:
        yield from _collisions(collisions)
        yield from (f"Note: {note}" for note in summary.get("notes", ()))


def _collisions(collisions: dict[str, Any]) -> View:
    """Clearance, and what was checked."""
    yield (
        "Checked: joint limits, reach, cones of approach, and collisions of the arm's body with itself and with "
        f"obstacles ({', '.join(collisions['obstacles']) or 'none'}), in each pose and along the straight joint moves "
        f"between poses. Smallest clearance in a pose: {collisions['smallest_clearance_mm']:.0f} mm."
    )
    if collisions["unchecked"]:
        pairs = "; ".join(" and ".join(pair) for pair in collisions["unchecked"])
        yield f"Not checked for collisions, because these parts touch in every pose of the arm: {pairs}."
    for row in collisions["blocked_moves"]:
        yield Styled(
            f"The straight joint move to pose {row['before_pose']} ({row['at']}) makes {' and '.join(row['between'])} "
            "collide; use another path to this pose.",
            "yellow",
        )


def procedure(summary: dict[str, Any]) -> View:
    """A planned acceptance test: positions of the artefacts, and number of poses."""

    def at(point: list[float]) -> str:
        return ", ".join(f"{value:.0f}" for value in point)

    stated = (
        ""
        if summary["measuring_range_stated"]
        else " (twice the reach; if the maker states a range, give this range with --range-mm)"
    )
    yield [
        Styled(summary["arm"]),
        f": {summary['standard']}, {summary['poses']} poses. Measuring range {summary['measuring_range_mm']:.0f} mm"
        f"{stated}. Reach {summary['reach_mm']:.0f} mm from the shoulder at ({at(summary['shoulder_mm'])}) mm",
    ]
    yield from warnings_of(summary)
    for bar in summary["bars"]:
        yield f"A bar of about {bar['length_mm']:.0f} mm, in {bar['positions']} positions"
    for sphere in summary["spheres"]:
        yield f"A sphere of {sphere['diameter_mm']:g} mm for the test '{sphere['test']}'"
    rows, by_name = [], {row["name"]: row for row in summary["items"]}
    for row in summary["items"]:
        bar, _, side = row["name"].rpartition("/")
        other = by_name.get(f"{bar}/b") if side == "a" else None
        if side == "b" and f"{bar}/a" in by_name:
            continue  # in the row of the bar's other end
        end, poses = ("", "") if other is None else (at(other["position_mm"]), f" + {other['poses']}")
        name = row["name"] if other is None else bar
        rows.append((row["test"], name, row["group"], at(row["position_mm"]), end, f"{row['poses']}{poses}"))
    headings = ("test", "name", "group", "at (x, y, z) [mm]", "to (x, y, z) [mm]", "poses")
    yield listed("Positions", rows, headings)
    yield (
        "Checked: joint limits, reach, that no part of the arm is below the table, and that spheres are touched from "
        "outside. Not checked: obstacles, collisions of the arm with itself, and how artefacts are mounted."
    )
    yield from written_of(summary)
