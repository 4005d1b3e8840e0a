"""Tables of results, made of the rows of a summary: terminal and report show the same ones."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from ..core.units import DEG, people_read
from ..uncertainty.coverage import K_IN_WORDS, U_AT_LEVEL
from . import tables
from .tables import METRICS, Cell, Columns, Table, decimals_for, listed, number

Row = Mapping[str, Any]
Rows = Sequence[Row]
# Arms by the keys of a summary. The arm as found, with the parameters that its controller had on arrival, is there only
# where these are known.
STAGES = {"nominal": "nominal", "as_found": "as found", "stage1": "stage 1", "calibrated": "calibrated"}
BEFORE = {stage: STAGES[stage] for stage in ("nominal", "as_found")}
BY_CONSTRUCTION = "fixed the scale"  # so that its error is zero
MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}  # of decisions
_SIGNS = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
_HARMONIC = re.compile(r"(?:cos|sin)(\d+)_(\d+)")  # order, joint
_REFITTED = "geometry (frame, target, ...) fitted to it again [mm]"
_MOST_LISTED = 48  # coefficients of harmonics that a table lists one by one


def with_u_digits(u: float | None) -> Cell:
    """An uncertainty, to two digits."""
    return number(u, decimals_for(u))


def _said(words: str, mark: str) -> Cell:
    """What is to be noticed in a row, if anything."""
    return Cell(words, None, mark if words else "")


def _two_decimals(key: str) -> Any:
    return lambda row: number(row[key], 2)


def metrics_table(
    caption: str, summary: Row, stages: Mapping[str, str] = STAGES, *, fixed_scale: bool = False
) -> Table:
    """Repeatability and length errors, one column per arm that the summary has.

    ``fixed_scale``: a single length fixed the scale of the last arm, so its error is zero by construction.
    """
    stages = {stage: words for stage, words in stages.items() if stage in summary}
    first, *_, last = stages

    def value(stage: str, key: str) -> Cell | str:
        by_construction = fixed_scale and stage == last and key.startswith("length")
        return BY_CONSTRUCTION if by_construction else number(summary[stage].get(key))

    rows = [(key, title) for key, title in METRICS if key in summary[first]]
    columns = {words: lambda row, stage=stage: value(stage, row[0]) for stage, words in stages.items()}
    return listed(caption, rows, {"": lambda row: row[1]} | columns)


def truth_table(truth: Row, stages: Mapping[str, str] = STAGES) -> Table:
    """Errors of parameters against the true arm of a simulation."""
    stages = {stage: words for stage, words in stages.items() if stage in truth}
    rows = [
        ["largest error of a length parameter [mm]", *(truth[stage]["length_error_largest_mm"] for stage in stages)],
        ["largest error of an angle parameter [deg]",
         *(truth[stage]["angle_error_largest_rad"] / DEG for stage in stages)],
    ]  # fmt: skip
    return listed("Largest differences from the true arm of the simulation", rows, ("", *stages.values()))


def validation_tables(summary: Row) -> list[Table]:
    """Cross-validation, pooled and group by group, the most improbable group first."""
    sockets = "socket's centroid or " if summary["of_sockets"] else ""
    pooled = [
        (f"RMS distance of poses from their {sockets}geometry", "rms_mm", "rms_predicted_mm", "rms_nominal_mm"),
        ("RMS error of reference lengths", "length_error_rms_mm", "length_u_mm", ""),
    ]
    cells = [
        (title, summary.get(nominal), summary[value], summary[u])
        for title, value, u, nominal in pooled
        if summary[value] is not None
    ]
    caption = f"Cross-validation: each of {summary['groups']} groups held out once, with its {_REFITTED}"
    if summary["groups"] == 1:
        caption = f"The group held out, with its {_REFITTED}"
    heads = ("", "nominal arm", "calibrated arm", "predicted by u")
    if all(nominal is None for _, nominal, *_ in cells):
        cells, heads = [(title, *rest) for title, _, *rest in cells], (heads[0], *heads[2:])
    shown = [listed(caption, cells, heads)]
    rows = summary.get("left_out") or []
    if rows:
        lengths = any(row["lengths"] for row in rows)
        shown.append(listed("Groups held out [mm]", rows, {
            "group held out": "group",
            "": lambda row: _said(
                "disagrees" if row["disagrees"] else "" if row["converged"] else "did not converge", "bad"
            ),
            "poses": "poses",
            "RMS distance": "rms_mm",
            "predicted": "rms_predicted_mm",
            "RMS length error": "length_error_rms_mm" if lengths else None,
            "u": "length_u_mm" if lengths else None,
            "probability [%]": lambda row: number(None if row["probability"] is None else 100 * row["probability"], 2),
        }))  # fmt: skip
    return shown


def prior_table(rows: Rows) -> Table:
    """Each group of parameters that has a prior: its standard deviation, and how many parameters the data determine."""

    def deviation(row: Row) -> str:
        scale, unit = people_read(row["unit"])
        given = f"{row['sd'] * scale:.3g} {unit}".strip()
        return given if row["supported"] else "0 (the data support no deviation; treated as exact)"

    return listed("Priors, and number of parameters that the data determine", rows, {
        "group": "group",
        "prior": lambda row: "learned" if row["learned"] else "given",
        "standard deviation": deviation,
        "parameters": "parameters",
        "determined by the data": lambda row: number(row["effective_parameters"], 1),
    })  # fmt: skip


def _value(row: Row, value: float, u: float | None, *, signed: bool = False, least: int = 0) -> Cell:
    """A number of a parameter in the unit that people read, to two digits of an uncertainty, or ``least`` decimals."""
    scale, _ = people_read(row["unit"])
    decimals = max(decimals_for(u and scale * u), least)
    return number(scale * value, decimals, signed=signed, rounded=u is not None and not least)


def _expanded(row: Row, u: float | None) -> Cell:
    return with_u_digits(u and people_read(row["unit"])[0] * u)


def parameter_table(caption: str, rows: Rows) -> Table:
    """Parameters with their expanded uncertainty, each in the unit that people read."""

    def state(row: Row) -> Cell:
        if row["bound"]:
            of_k = " in stage 1; U is the U of k" if row["expanded"] else ""
            return _said(f"on the {row['bound']} bound{of_k}", "unsure")
        return _said("" if row["expanded"] else "only with others", "unsure")

    return listed(caption, rows, {
        "parameter": "parameter",
        "unit": lambda row: people_read(row["unit"])[1],
        "calibrated": lambda row: _value(row, row["calibrated"], row["expanded"]),
        U_AT_LEVEL: lambda row: _expanded(row, row["expanded"]),
        "change": lambda row: _value(row, row["calibrated"] - row["nominal"], row["expanded"], signed=True),
        "nominal": lambda row: _value(row, row["nominal"], row["expanded"], least=4),
        "": state,
    })  # fmt: skip


def listed_apart(parameters: Rows) -> tuple[list[Row], list[Row]]:
    """The parameters that a table lists one by one, and the coefficients of harmonics if there are too many; rows of a
    summary, with their name as "parameter"."""
    harmonics = [row for row in parameters if _HARMONIC.fullmatch(row["parameter"])]
    if len(harmonics) <= _MOST_LISTED:
        return list(parameters), []
    return [row for row in parameters if not _HARMONIC.fullmatch(row["parameter"])], harmonics


def harmonics_by_joint(coefficients: Rows) -> list[dict[str, Any]]:
    """Coefficients of harmonics, joint by joint: rows with the orders in words, the RMS ("rms") that the harmonics have
    over a whole revolution, in the unit "unit", and the "largest" coefficient, itself a row."""
    joints: dict[int, list[tuple[int, Row]]] = {}
    for row in coefficients:
        match = _HARMONIC.fullmatch(row["parameter"])
        if match is not None:
            joints.setdefault(int(match[2]), []).append((int(match[1]), row))
    rows = []
    for joint, of_joint in sorted(joints.items()):
        orders, values = sorted({order for order, _ in of_joint}), [row for _, row in of_joint]
        whole = len(orders) > 1 and orders[-1] - orders[0] + 1 == len(orders)
        rows.append({
            "joint": joint,
            "coefficients": len(values),
            "orders": f"{orders[0]} to {orders[-1]}" if whole else ", ".join(map(str, orders)),
            "unit": values[0]["unit"],
            "rms": math.sqrt(sum(row["calibrated"] ** 2 for row in values) / 2),
            "largest": max(values, key=lambda row: abs(row["calibrated"])),
        })  # fmt: skip
    return rows


def harmonics_table(rows: Rows) -> Table:
    """Coefficients of harmonics, joint by joint: their RMS over a revolution, and the largest."""
    return listed("Harmonics of the joints", harmonics_by_joint(rows), {
        "joint": "joint",
        "coefficients": "coefficients",
        "orders": "orders",
        "RMS over a revolution": lambda row: _value(row, row["rms"], row["largest"]["expanded"]),
        "largest coefficient": lambda row: row["largest"]["parameter"],
        "its value": lambda row: _value(row, row["largest"]["calibrated"], row["largest"]["expanded"], signed=True),
        "its U": lambda row: _expanded(row, row["largest"]["expanded"]),
        "unit": lambda row: people_read(row["unit"])[1],
    })  # fmt: skip


def robot_bases_table(bases: Rows, factor: float) -> Table:
    """Where the bases of a robot's chains are, with their expanded uncertainty."""
    return base_table(bases, factor, f"Base of each chain in the base frame of '{bases[0]['of']}', with {U_AT_LEVEL}")


def base_table(frames: Rows, factor: float, caption: str = "") -> Table:
    """Where the base is in each frame of known coordinates, with its expanded uncertainty."""
    rows = []
    for frame in frames:
        for name, title, quantity, scale in (
            (frame["in"], "position [mm]", "position_{}mm", 1.0),
            ("", "rotation vector [deg]", "rotation_{}rad", 1 / DEG),
        ):
            expanded = [None if u is None else factor * scale * u for u in frame[quantity.format("u_")]]
            pairs = list(zip(frame[quantity.format("")], expanded, strict=True))
            rows.append((name, title, *(number(scale * x, decimals_for(u), rounded=True) for x, u in pairs)))
            rows.append(("", "U", *(number(u, decimals_for(u)) for u in expanded)))
    usual = f"Pose of the base frame in each frame with known coordinates, with {U_AT_LEVEL}"
    return listed(caption or usual, rows, ("of" if caption else "in", "", "x", "y", "z"))


def volume_table(caption: str, volume: Row) -> Table:
    """Expanded uncertainty of tips and lengths over the working volume."""
    length = f"{volume['length_mm']:.4g} mm length"
    titles = {
        "expanded_tip": "tip position (worst direction): contribution of the calibration",
        "expanded_length": f"{length}: contribution of the calibration",
        "expanded_length_reading": f"{length}: total, with the noise of both readings",
    }
    rows = []
    for key, title in titles.items():
        values = [volume[f"{key}_{statistic}_mm"] for statistic in ("median", "95", "largest")]
        rows.append([title, *("not determined" if u is None else with_u_digits(u) for u in values)])
    return listed(caption, rows, ("", "median", "95th percentile", "largest"))


def agreement_tables(summary: Row) -> list[Table]:
    """Root mean square residuals by kind and by observation, nominal and calibrated."""
    columns: Columns = {
        "poses": "poses",
        "nominal [mm]": "rms_before_mm",
        "calibrated [mm]": "rms_after_mm",
        **tables.other_rms_columns(summary["observations"], "calibrated"),
        "calibrated, in standard deviations": _two_decimals("reduced_chi"),
    }
    by_kind, by_observation = (
        listed(f"RMS residuals by {first}", summary[f"{first}s"], {first: first, second: second} | columns)
        for first, second in (("kind", "observations"), ("observation", "kind"))
    )
    # Where each kind was observed once, both say the same.
    return [by_observation] if len(by_kind.rows) == len(by_observation.rows) else [by_kind, by_observation]


def held_out_tables(summary: Row) -> list[Table]:
    """How the calibrated arm agrees with poses that it was not calibrated with, beside those that it was."""
    uses = [{"": name.replace("_", "-")} | summary[name] for name in ("held_out", "used")]
    rows, columns = summary["observations"], {
        "poses": "poses",
        **({"RMS nominal": "rms_nominal_mm"} if uses[0]["rms_nominal_mm"] is not None else {}),
        "RMS": "rms_mm",
        "mean": "mean_mm",
        "largest": "largest_mm",
        "RMS predicted": "rms_predicted_mm",
    }  # fmt: skip
    title = "Distances of poses from their geometry [mm]"
    shown = [listed(title, uses, {"": ""} | columns | tables.other_rms_columns(uses, "RMS"))]
    if len(rows) > 1:
        by_observation = {"observation": "observation"} | columns | tables.other_rms_columns(rows, "RMS")
        shown.append(listed("Held-out poses by observation [mm]", rows, by_observation))
    return shown


def weights_table(summary: Row, most: int | None = None) -> Table:
    """The poses that a robust loss took weight from; ``most``: the first ones only."""
    caption = (
        f"Poses to which the robust loss ({summary['robust']}) gives half of the full weight or less, with their "
        "residuals"
    )
    return listed(caption, summary["less_weight"][:most], {
        "observation": "observation",
        "pose": "pose",
        "weight": lambda row: number(row["weight"], 3),
        "residual [mm]": "residual_mm",
        "residual in standard deviations": lambda row: number(row["normalised"], 1),
    })  # fmt: skip


def geometry_table(parts: Rows, coverage: float) -> Table:
    """Parts of the unknown geometry, beside what is certified of them; ``coverage``: the coverage factor of U."""
    rows = []
    for part in parts:
        # What is certified has its numbers in the order of the quantities.
        pairs = iter([] if part["certified"] is None else zip(part["values"], part["certified"], strict=True))
        for quantity in part["quantities"]:
            errors = [abs(value - stated) for _, (value, stated) in zip(quantity["values"], pairs, strict=False)]
            rows.append(quantity | {"part": part["part"], "difference": max(errors, default="")})
    certified = any(part["certified"] is not None for part in parts)
    framed = any(part["units"] == ["rad"] * 3 + ["mm"] * 3 for part in parts)
    caption = "Geometry found" + (" (a frame takes its points x to R x + origin)" if framed else "")
    return listed(caption, rows, {
        "part": "part",
        "quantity": "quantity",
        "value": lambda row: tables.quantity_words(row, u=False, coverage=coverage),
        U_AT_LEVEL: lambda row: tables.expanded_words(row, coverage),
        "largest difference from the certified values [mm]": "difference" if certified else None,
    })  # fmt: skip


def observations_table(caption: str, rows: Rows) -> Table:
    """Observations besides sockets in an evaluation; of held-out ones, what the calibration predicts too."""
    return listed(caption, rows, {
        "observation": "observation",
        "kind": "kind",
        "poses": "poses",
        "nominal": "nominal_rms_mm",
        "calibrated": "rms_mm",
        "predicted": "rms_predicted_mm" if any("rms_predicted_mm" in row for row in rows) else None,
        **tables.other_rms_columns(rows, "calibrated"),
        "calibrated, in standard deviations": _two_decimals("reduced_chi"),
    })  # fmt: skip


def stated_expanded(u: float) -> Cell:
    """U, or that nothing was stated to compute it from."""
    return with_u_digits(u) if u > 0 else Cell("not stated")


def acceptance_tables(tests: Rows, *, brief: bool = False) -> list[Table]:
    """The metrics of each acceptance test, with their limits and decisions where there are any.

    ``brief``: without the decisions of the nominal arm and of the arm as found, and without what each metric is.
    """
    metrics = [metric for test in tests for metric in test["figures"]]
    limited = any(metric["limit_mm"] is not None for metric in metrics)
    earlier = [stage for stage in BEFORE if any(metric.get(f"{stage}_mm") is not None for metric in metrics)]
    value = "calibrated" if earlier else "value"

    def decided(row: Row) -> Cell:
        parts = len(row["parts"])
        count = f" ({row['failing']} of {parts})" if row["failing"] and parts > 1 else ""
        return Cell(_SIGNS[row["decision"]] + count, None, MARKS[row["decision"]])

    def decided_before(stage: str) -> Any:
        key = f"{stage}_decision"
        return lambda row: Cell(_SIGNS[row[key]], None, MARKS[row[key]])

    def read(key: str) -> Any:
        return lambda row: number(row[key], decimals_for(row["expanded_mm"]))

    # Decisions first: on a telephone, what stands behind them is off the screen.
    columns: Columns = {
        "metric": "symbol",
        f"decision, {value}" if earlier and not brief else "decision": decided if limited else None,
        **{f"decision, {BEFORE[stage]}": decided_before(stage) for stage in earlier if limited and not brief},
        value: read("value_mm"),
        f"U ({K_IN_WORDS})": lambda row: stated_expanded(row["expanded_mm"]),
        "MPE": "limit_mm" if limited else None,
        **{BEFORE[stage]: read(f"{stage}_mm") for stage in earlier},
        "worst at": "where",
        "meaning": None if brief else "what",
    }
    return [listed(f"{test['called']}: {test['title']} [mm]", test["figures"], columns) for test in tests]
