"""Tables of results, made of the rows of a summary: terminal and report show the same ones."""

from collections.abc import Mapping, Sequence
from typing import Any

from ..core.units import DEG, people_read
from .harmonics import harmonics_by_joint
from .tables import (
    METRICS,
    Cell,
    Columns,
    Table,
    decimals_for,
    difference_from_best,
    expanded_words,
    listed,
    number,
    quantity_words,
    volume_rows,
)

Row = Mapping[str, Any]
Rows = Sequence[Row]
STAGES = {"nominal": "nominal", "stage1": "stage 1", "calibrated": "calibrated"}
BY_CONSTRUCTION = "fixed the scale"  # so that its error is zero
MARKS = {"conforms": "good", "fails": "bad", "undecided": "unsure", None: ""}  # of decisions
_SIGNS = {"conforms": "✓ conforms", "fails": "✗ fails", "undecided": "? undecided", None: "–"}
_TRUTH = {
    "length_error_largest_mm": ("largest error of a length parameter [mm]", 1.0),
    "angle_error_largest_rad": ("largest error of an angle parameter [deg]", 1 / DEG),
}
_POOLED = (
    ("RMS distance of poses from their socket's centroid or geometry", "rms_mm", "rms_predicted_mm"),
    ("RMS error of reference lengths", "length_error_rms_mm", "length_u_mm"),
)


def with_u_digits(u: float | None, mark: str = "") -> Cell:
    """An uncertainty, to two digits."""
    return number(u, decimals_for(u), mark=mark)


def metrics_table(
    caption: str, summary: Row, stages: Mapping[str, str] = STAGES, *, fixed_scale: bool = False
) -> Table:
    """Repeatability and length errors, one column per arm.

    ``fixed_scale``: a single length fixed the scale of the last arm, so its error is zero by construction.
    """
    last = list(stages)[-1]

    def value(stage: str, key: str) -> Cell | str:
        by_construction = fixed_scale and stage == last and key.startswith("length")
        return BY_CONSTRUCTION if by_construction else number(summary[stage].get(key))

    rows = [(key, title) for key, title in METRICS if key in summary[next(iter(stages))]]
    columns = {words: lambda row, stage=stage: value(stage, row[0]) for stage, words in stages.items()}
    return listed(caption, rows, {"": lambda row: row[1]} | columns)


def truth_table(truth: Row, stages: Mapping[str, str] = STAGES) -> Table:
    """Errors of parameters against the true arm of a simulation."""
    columns: Columns = {"": lambda key: _TRUTH[key][0]}
    columns |= {words: lambda key, s=stage: _TRUTH[key][1] * truth[s][key] for stage, words in stages.items()}
    return listed("Against the true arm of the simulation", _TRUTH, columns)


def validation_tables(summary: Row) -> list[Table]:
    """Cross-validation, pooled and group by group, the most improbable group first."""
    pooled = [(title, summary[value], summary[u]) for title, value, u in _POOLED if summary[value] is not None]
    caption = f"Cross-validated: each of {summary['groups']} groups held out once [mm]"
    rows = summary.get("left_out") or []
    lengths = any(row["lengths"] for row in rows)

    def state(row: Row) -> Cell:
        words = "disagrees" if row["disagrees"] else "" if row["converged"] else "did not converge"
        return Cell(words, None, "bad" if words else "")

    groups: Columns = {
        "group held out": "group",
        "poses": "poses",
        "RMS distance": "rms_mm",
        "predicted": "rms_predicted_mm",
        "RMS length error": "length_error_rms_mm" if lengths else None,
        "u": "length_u_mm" if lengths else None,
        "by chance [%]": lambda row: number(None if row["probability"] is None else 100 * row["probability"], 2),
        "": state,
    }
    of_all = listed(caption, pooled, ("", "residual", "predicted by u"))
    return [of_all, *([listed("Groups held out [mm]", rows, groups)] if rows else [])]


def prior_table(rows: Rows) -> Table:
    """Each group of parameters that has a prior: its standard deviation, and how many parameters the data determine."""

    def deviation(row: Row) -> str:
        scale, unit = people_read(row["unit"])
        if not row["supported"]:
            return "0: not supported by the data, so exact"
        return f"{row['sd'] * scale:.3g} {unit}".strip()

    return listed("Priors of the parameters, and effective parameters", rows, {
        "group": "group",
        "prior": lambda row: "learned" if row["learned"] else "given",
        "standard deviation": deviation,
        "parameters": "parameters",
        "of these determined by the data": lambda row: number(row["effective_parameters"], 1),
    })  # fmt: skip


def _value(row: Row, value: float, u: float | None, *, signed: bool = False) -> Cell:
    """A number of a parameter in the unit that people read, to two digits of an uncertainty."""
    scale, _ = people_read(row["unit"])
    decimals = decimals_for(None if u is None else scale * u)
    return number(scale * value, decimals, signed=signed, rounded=u is not None)


def _expanded(row: Row, u: float | None) -> Cell:
    return with_u_digits(None if u is None else people_read(row["unit"])[0] * u)


def parameter_table(caption: str, rows: Rows) -> Table:
    """Parameters with their expanded uncertainty, each in the unit that people read."""

    def state(row: Row) -> Cell:
        words = "" if row["expanded"] else "only with others"
        if row["bound"]:
            words = f"on the {row['bound']} bound" + (" of stage 1; U is that of k" if row["expanded"] else "")
        return Cell(words, None, "unsure" if words else "")

    def nominal(row: Row) -> Cell:
        scale, _ = people_read(row["unit"])
        u = row["expanded"]
        return number(scale * row["nominal"], max(decimals_for(None if u is None else scale * u), 4))

    return listed(caption, rows, {
        "parameter": "parameter",
        "unit": lambda row: people_read(row["unit"])[1],
        "calibrated": lambda row: _value(row, row["calibrated"], row["expanded"]),
        "U (95 %)": lambda row: _expanded(row, row["expanded"]),
        "change": lambda row: _value(row, row["calibrated"] - row["nominal"], row["expanded"], signed=True),
        "nominal": nominal,
        "": state,
    })  # fmt: skip


def harmonics_table(rows: Sequence[Any]) -> Table:
    """Coefficients of harmonics, joint by joint: their RMS over a revolution, and the largest."""
    return listed("Harmonics of the joints", harmonics_by_joint(rows), {
        "joint": "joint",
        "coefficients": "coefficients",
        "orders": "orders",
        "RMS over a revolution": lambda row: _value(row, row["rms"], row["largest"]["expanded"]),
        "largest": lambda row: row["largest"]["parameter"],
        "its value": lambda row: _value(row, row["largest"]["calibrated"], row["largest"]["expanded"], signed=True),
        "its U": lambda row: _expanded(row, row["largest"]["expanded"]),
        "unit": lambda row: people_read(row["unit"])[1],
    })  # fmt: skip


def volume_table(caption: str, volume: Row) -> Table:
    """Expanded uncertainty of tips and lengths over the working volume."""
    columns: Columns = {"": lambda row: row[0]}
    for i, words in enumerate(("median", "95th percentile", "largest")):
        columns[words] = lambda row, i=i: "not determined" if row[1][i] is None else with_u_digits(row[1][i])
    return listed(caption, volume_rows(volume), columns)


def agreement_tables(summary: Row) -> list[Table]:
    """Root mean square residuals by kind and by observation, nominal and calibrated."""
    angles = any(row["rms_angle_rad"] is not None for row in summary["observations"])
    columns: Columns = {
        "poses": "poses",
        "nominal [mm]": "rms_before_mm",
        "calibrated [mm]": "rms_after_mm",
        "calibrated [deg]": _in_degrees if angles else None,
        "calibrated, in standard deviations": lambda row: number(row["reduced_chi"], 2),
    }
    by_kind, by_observation = (
        listed(f"RMS residuals by {first}", summary[f"{first}s"], {first: first, second: second} | columns)
        for first, second in (("kind", "observations"), ("observation", "kind"))
    )
    # Where each kind was observed once, both say the same.
    return [by_observation] if len(by_kind.rows) == len(by_observation.rows) else [by_kind, by_observation]


def _in_degrees(row: Row) -> Cell:
    angle = row["rms_angle_rad"]
    return number(None if angle is None else angle / DEG)


def other_poses_table(others: Row) -> Table:
    """How the calibrated arm agrees with poses that it was not calibrated with."""
    caption = f"Other poses, drawn at random and not calibrated with: {others['poses']}, RMS {others['rms_mm']:.4f} mm"
    columns: Columns = {"observation": "observation", "poses": "poses", "RMS [mm]": "rms_mm", "RMS [deg]": _in_degrees}
    return listed(caption, others["observations"], columns)


def weights_table(summary: Row, most: int | None = None) -> Table:
    """The poses that a robust loss took weight from; ``most``: the first ones only."""
    columns: Columns = {
        "observation": "observation",
        "pose": "pose",
        "weight": lambda row: number(row["weight"], 3),
        "residual [mm]": "residual_mm",
        "residual in standard deviations": lambda row: number(row["normalised"], 1),
    }
    caption = f"Poses that the robust loss ({summary['robust']}) took half of their weight from or more, and why"
    return listed(caption, summary["less_weight"][:most], columns)


def geometry_table(parts: Rows, coverage: float) -> Table:
    """Parts of the unknown geometry, beside what is certified of them; ``coverage``: the coverage factor of U."""
    rows = []
    for part in parts:
        certified, quantities = part["certified"], part["quantities"]
        # What is certified has its numbers in the order of the quantities.
        pairs = iter([] if certified is None else zip(part["values"], certified, strict=True))
        for quantity in quantities:
            errors = [abs(value - stated) for _, (value, stated) in zip(quantity["values"], pairs, strict=False)]
            rows.append(quantity | {"part": part["part"], "difference": max(errors) if errors else ""})
    certified = any(part["certified"] is not None for part in parts)
    return listed("Geometry found", rows, {
        "part": "part",
        "quantity": "quantity",
        "value": lambda row: quantity_words(row, u=False, coverage=coverage),
        "U (95 %)": lambda row: expanded_words(row, coverage),
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
        "calibrated, in standard deviations": lambda row: number(row["reduced_chi"], 2),
    })  # fmt: skip


def stated_expanded(u: float) -> Cell:
    """U, or that nothing was stated to compute it from."""
    return with_u_digits(u) if u > 0 else Cell("not stated")


def decided(decision: str | None, failing: int = 0, parts: int = 1) -> Cell:
    """A decision of an acceptance test, and how many of its parts fail."""
    count = f" ({failing} of {parts})" if failing and parts > 1 else ""
    return Cell(_SIGNS[decision] + count, None, MARKS[decision])


def acceptance_tables(tests: Rows, *, brief: bool = False) -> list[Table]:
    """The metrics of each acceptance test, with their limits and decisions where there are any.

    ``brief``: without the decisions of the nominal arm, and without what each metric is.
    """
    metrics = [metric for test in tests for metric in test["figures"]]
    limited = any(metric["limit_mm"] is not None for metric in metrics)
    nominal = any(metric["as_found_mm"] is not None for metric in metrics)
    value = "calibrated" if nominal else "value"
    # Decisions first: on a telephone, what stands behind them is off the screen.
    columns: Columns = {
        "metric": "symbol",
        f"decision, {value}" if nominal and not brief else "decision": (
            (lambda row: decided(row["decision"], row["failing"], len(row["parts"]))) if limited else None
        ),
        "decision, nominal": (
            (lambda row: decided(row["as_found_decision"])) if limited and nominal and not brief else None
        ),
        value: lambda row: number(row["value_mm"], decimals_for(row["expanded_mm"])),
        "U (k = 2)": lambda row: stated_expanded(row["expanded_mm"]),
        "MPE": "limit_mm" if limited else None,
        "nominal": (lambda row: number(row["as_found_mm"], decimals_for(row["expanded_mm"]))) if nominal else None,
        "worst at": "where",
        "what it is": None if brief else "what",
    }
    return [listed(f"{test['called']}: {test['title']} [mm]", test["figures"], columns) for test in tests]


MODELS_MEANING = (
    "Determined: parameters that the data determine. Inside, outside: RMS distance from the geometry of all poses, and "
    "of regions left out one by one. To the best: difference of the error outside to the best one, compared region by "
    "region. u: standard errors by the scatter of the regions. Ratio: mean of (error / predicted standard deviation)² "
    "outside. Evidence: its logarithm, less that of the most probable model."
)


def model_tables(summary: Row) -> tuple[Table, Table]:
    """Compared models, and their errors region by region."""
    models, regions = summary["models"], summary["regions"]
    most_probable = max(row["log_evidence"] for row in models)
    least = min(row["rms_outside"] for row in models)

    def name(row: Row) -> str | Cell:
        return row["model"] if row["converged"] else Cell(f"{row['model']}: did not converge", None, "unsure")

    columns = {
        "model": name,
        "parameters": "parameters",
        "determined": lambda row: number(row["effective_parameters"], 1),
        "inside [mm]": "rms_inside",
        "outside [mm]": "rms_outside",
        "u of outside": "u_outside",
        "to the best": lambda row: difference_from_best(row, least)[0],
        "u of it": lambda row: difference_from_best(row, least)[1],
        "ratio": lambda row: number(row["ratio"], 2),
        "evidence": lambda row: number(row["log_evidence"] - most_probable, 1),
        "CPU [s]": lambda row: number(row["cpu_seconds"], 1),
    }
    of_region: Columns = {"region": lambda i: regions[i], "poses": lambda i: models[0]["regions"][i]["poses"]}
    of_region |= {row["model"]: lambda i, row=row: row["regions"][i]["rms"] for row in models}
    by_region = listed("RMS error of each region [mm]", range(len(regions)), of_region)
    return listed("Models", models, columns), by_region
