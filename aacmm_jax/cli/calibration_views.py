"""What people see of arms, captures, calibrations and the demonstration; every heading names its unit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core.text import pluralise, shorten
from ..core.units import DEG, people_read, people_read_change
from ..summaries.harmonics import harmonics_by_joint, listed_apart
from ..summaries.tables import (
    METRICS,
    Line,
    Styled,
    Table,
    decimals_for,
    encoders_in_words,
    expanded_words,
    factor_words,
    formatted,
    lengths_sentence,
    listed,
    observed_words,
    quantity_words,
    seat_in_words,
    two_digits,
    verdict_of,
    volume_rows,
    warnings_of,
    written_of,
)
from ..summaries.uncertainty_sentences import shared_sentence, tried_sentence

View = Iterator[Line | Table]
_MOST_PARTS = 12  # rows of a table
_STAGES = {"nominal": "nominal", "stage1": "stage 1", "calibrated": "calibrated"}
_TRUTH = (
    ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
    ("angle_error_largest_rad", "largest error of an angle parameter [deg]", 1 / DEG),
)


def arm(summary: dict[str, Any]) -> View:
    """One arm: its table and what its file proposes."""
    joints = summary["joints"]
    slides = any(row["kind"] == "prismatic" for row in joints)

    def limits(row: dict[str, Any]) -> str | None:
        of_slide = row["kind"] == "prismatic"
        low_high, factor = (row["limits_mm"], 1.0) if of_slide else (row["limits_rad"], 1 / DEG)
        unit = "" if not slides else " mm" if of_slide else " deg"
        return low_high and f"{factor * low_high[0]:.0f} to {factor * low_high[1]:.0f}{unit}"

    beta = {"beta [deg]": lambda row: (row["beta_rad"] or 0.0) / DEG}
    yield listed(f"{summary['name']} (standard D-H)", joints, {
        "joint": "joint",
        "alpha [deg]": lambda row: row["alpha_rad"] / DEG,
        "a [mm]": "a_mm",
        "d [mm]": "d_mm",
        "theta [deg]": lambda row: row["theta_rad"] / DEG,
        **(beta if any(row["beta_rad"] is not None for row in joints) else {}),
        "limits of the reading" if slides else "limits [deg]": limits,
    })  # fmt: skip
    yield f"Probe {', '.join(formatted(x) for x in summary['probe_mm'])} mm. Fixed: {', '.join(summary['held'])}."
    yield from _corrections(summary["corrections"])
    if summary["urdf"] is not None:
        base, frame = summary["urdf"]["base"], summary["urdf"]["first_frame_in_base_mm"]
        where = f"in the frame of {base}"
        if any(x != (row == column) for row, values in enumerate(frame) for column, x in enumerate(values)):
            z, origin = (", ".join(f"{values[column]:.6g}" for values in frame[:3]) for column in (2, 3))
            where = f"in a frame at ({origin}) mm in {base}, with its z axis along ({z})"
        yield f"From a URDF: {base} to {summary['urdf']['tip']}; positions are {where}."


def _corrections(rows: Sequence[Mapping[str, Any]]) -> View:
    """The coefficients of an arm's corrections that are known, and what the others are."""
    known = [row for row in rows if row["value"] != 0]
    if known:
        units = [people_read_change(row["unit"]) if row["unit"] == "rad" else people_read(row["unit"]) for row in known]
        cells = [
            (row["coefficient"], f"{scale * row['value']:.4g}", unit, row["of"])
            for row, (scale, unit) in zip(known, units, strict=True)
        ]
        yield Table("\nJoint corrections", ("coefficient", "value", "unit", ""), cells)
    zero: dict[str, list[str]] = {}
    for row in rows:
        if row["value"] == 0 and row["of"]:  # not the direction of gravity
            zero.setdefault(row["of"], []).append(row["coefficient"])
    for kind, names in zero.items():
        amount = pluralise(len(names), "coefficient")
        yield f"Joint corrections of 0, until they are calibrated: {amount}, {kind} ({shorten(names)})."


def capture(summary: dict[str, Any]) -> View:
    """One capture."""
    others = sum(row["kind"] != "socket" for row in summary["observations"])
    sockets = len(summary["sockets"]) + len(summary["observations"]) - others  # of sessions with an own probe, too
    yield [
        Styled(summary["arm"]),
        f": {pluralise(summary['poses'], 'pose')} of {pluralise(summary['joints'], 'joint')} in "
        f"{observed_words(sockets, others, len(summary['lengths']))}" + (", simulated" if summary["simulated"] else ""),
    ]
    yield from warnings_of(summary)
    if summary["sockets"]:
        yield listed("", summary["sockets"], {"socket": "socket", "poses": "poses"})
    if summary["observations"]:
        columns: dict[str, Any] = {key: key for key in ("observation", "kind", "target", "poses")}
        columns["unknown geometry"] = lambda row: ", ".join(row["unknowns"])
        yield listed("\nOther observations", summary["observations"], columns)
    for row in summary["observations"]:
        stated = [f"{number['quantity']} {quantity_words(number)}" for number in (*row["certified"], *row["stated"])]
        if stated:
            yield f"{row['observation']}: {shorten(stated, _MOST_PARTS)}."
    slides = any("lowest_mm" in row for row in summary["ranges"])

    def reading(row: dict[str, Any], end: str) -> str:
        if f"{end}_mm" in row:
            return f"{row[f'{end}_mm']:.3f} mm"
        return f"{row[f'{end}_rad'] / DEG:.3f}" + (" deg" if slides else "")

    unit = "" if slides else " [deg]"
    ends = {f"{end}{unit}": lambda row, end=end: reading(row, end) for end in ("lowest", "highest")}
    yield listed("\nReadings", summary["ranges"], {"joint": "joint"} | ends)
    if summary["temperature_C"] is not None:
        low, high = summary["temperature_C"]
        yield f"Temperature: {low:.2f} to {high:.2f} C."
    if summary["lengths"]:
        columns = {"from": "from", "to": "to", "value [mm]": "value_mm", "u [mm]": "u_mm"}
        yield listed("\nReference lengths", summary["lengths"], columns)
    yield from written_of(summary)


def calibration(summary: dict[str, Any]) -> View:
    """One calibration: warnings first."""
    yield solve(summary)
    yield from verdict_of(summary)
    if summary.get("lengths_tested"):
        yield lengths_sentence(summary["lengths_tested"])
    anchor = f"scale anchor {summary['hold']}" if summary["hold"] else "no scale anchor"
    if summary["scale_k"] is not None:
        u = summary["scale_u"] or 0.0
        yield f"Scale of stage 1: k = {summary['scale_k']:.{decimals_for(u, 8)}f}, u(k) = {u:.1e} ({anchor})"
    yield from warnings_of(summary)
    yield from _validated(summary["cross_validation"])
    if summary.get("sessions"):
        columns = {"session": "session", "poses": "poses", "together": "rms_mm", "alone": "rms_alone_mm"}
        yield listed("\nSessions, RMS distance of poses from their geometry [mm]", summary["sessions"], columns)
    yield from _observations(summary)
    stages = ("nominal", "calibrated") if summary["method"] == "joint" else tuple(_STAGES)
    if summary["nominal"]:
        title = "\nOn the poses it was identified from [mm]"
        yield by_stage(title, summary, stages, fitted=summary["fixed_by_one_length"])
    if "truth" in summary:
        rows = [(text, *(factor * summary["truth"][stage][key] for stage in _STAGES)) for key, text, factor in _TRUTH]
        yield Table("\nAgainst the true arm of the simulation", ("", *_STAGES.values()), rows)
    yield from _parameters(summary["parameters"])
    if summary["held"]:
        yield f"Fixed at their nominal values: {', '.join(summary['held'])}."
    if summary.get("prior"):
        yield _prior(summary["prior"])
    if summary["lengths"]:
        yield lengths(summary["lengths"], fitted=summary["fixed_by_one_length"])
    yield from _uncertainty(summary)
    if summary.get("shared_errors"):
        yield shared_sentence(summary["shared_errors"])
    yield from written_of(summary)


def solve(summary: dict[str, Any]) -> Line:
    """How the solve ended; a residual that no arm has is not called converged, whatever the solver says."""
    ended = Styled("converged", "green") if summary["converged"] else Styled("did not converge", "red")
    if summary["converged"] and not summary["residual_plausible"]:
        ended = Styled("ended with a residual that no arm has,", "red")
    rows = summary["observations"]  # with observations of other kinds, or a probe for each session: sockets too
    sockets = {*summary["sockets_used"], *(row["observation"] for row in rows if row["kind"] == "socket")}
    others = sum(row["kind"] != "socket" for row in rows)
    steps, poses = pluralise(summary["steps"], "step"), pluralise(summary["poses"], "pose")
    words = f" in {steps} on {poses} in {observed_words(len(sockets), others)}"
    return [Styled(summary["arm"]), f", {summary['method']}: ", ended, words]


def _observations(summary: dict[str, Any]) -> View:
    """Observations, the geometry found, poses that lost weight, and poses that were left out at random."""
    if summary["observations"]:
        yield listed("\nObservations, RMS distance from their geometry", summary["observations"], {
            **{key: key for key in ("observation", "kind", "poses")},
            "nominal [mm]": "rms_before_mm",
            "calibrated [mm]": "rms_after_mm",
            "in s.d.": lambda row: f"{row['reduced_chi']:.2f}",
        })  # fmt: skip
        factor = summary["uncertainty"]["coverage_factor_geometry_95"]
        parts = [row for row in summary["geometry"] if not row["part"].startswith("position of ")]
        rows = [
            (row["part"], number["quantity"], quantity_words(number, coverage=factor), expanded_words(number, factor))
            for row in parts[:_MOST_PARTS]
            for number in row["quantities"]
        ]
        if parts:
            yield Table("\nUnknown geometry", ("part", "quantity", "found", "U (95 %)"), rows)
        hidden = len(summary["geometry"]) - len(parts[:_MOST_PARTS])
        if hidden:
            yield f"{pluralise(hidden, 'more part')} of the geometry, positions of sockets too: --json."
    if summary.get("base"):
        yield base(summary["base"], summary["uncertainty"]["coverage_factor_geometry_95"])
    if summary["robust"]:
        rows = summary["less_weight"]
        least = f"; the {_MOST_PARTS} of least weight, all by --json" if len(rows) > _MOST_PARTS else ""
        yield f"Robust loss {summary['robust']}: {pluralise(len(rows), 'pose')} with half the weight or less{least}."
        if rows:
            yield listed("", rows[:_MOST_PARTS], {
                "observation": "observation",
                "pose": "pose",
                "weight": lambda row: f"{row['weight']:.3f}",
                "residual [mm]": "residual_mm",
                "[standard deviations]": lambda row: f"{row['normalised']:.1f}",
            })  # fmt: skip
    if "other_poses" in summary:
        others = summary["other_poses"]
        words = f", drawn at random and not calibrated with: {others['poses']}, RMS {formatted(others['rms_mm'])} mm."
        yield ["\n", Styled("Other poses"), words]
        yield from orientations(others["observations"])


def orientations(rows: Sequence[dict[str, Any]]) -> View:
    """Residuals of orientations, where an observation has them."""
    for row in rows:
        if row["rms_angle_rad"] is not None:
            yield f"Orientation of {row['observation']}: RMS {row['rms_angle_rad'] / DEG:.4f} deg."


def base(frames: Sequence[dict[str, Any]], factor: float) -> Table:
    """Where the base is in each frame of known coordinates, with its expanded uncertainty."""
    rows = []
    for frame in frames[:_MOST_PARTS]:
        for name, what, quantity, scale in (
            (frame["in"], "position [mm]", "position_{}mm", 1.0),
            ("", "rotation vector [deg]", "rotation_{}rad", 1 / DEG),
        ):
            expanded = [None if u is None else factor * scale * u for u in frame[quantity.format("u_")]]
            decimals = [decimals_for(u) for u in expanded]
            values = zip(frame[quantity.format("")], decimals, strict=True)
            rows.append((name, what, *(f"{scale * x:.{digits}f}" for x, digits in values)))
            known = zip(expanded, decimals, strict=True)
            rows.append(("", "U", *("-" if u is None else f"{u:.{digits}f}" for u, digits in known)))
    title = "\nBase frame as seen from frames with known coordinates, U (95 %)"
    return Table(title, ("in", "", "x", "y", "z"), rows, left=(0, 1))


def _validated(result: dict[str, Any] | None) -> View:
    """Cross-validation, and every group that was held out, the most improbable first."""
    if result is None:
        return
    rows = [("RMS distance of poses from their socket or geometry", result["rms_mm"], result["rms_predicted_mm"])]
    if result["length_error_rms_mm"] is not None:
        rows.append(("RMS error of reference lengths", result["length_error_rms_mm"], result["length_u_mm"]))
    title = f"\nCross-validated: each of {result['groups']} groups held out once [mm]"
    yield Table(title, ("", "found", "predicted by u"), rows)
    groups = result.get("left_out")
    if groups is None:
        return

    def mark(row: dict[str, Any]) -> Styled | str:
        if row["disagrees"]:
            return Styled("disagrees", "red")
        return "" if row["converged"] else Styled("did not converge", "red")

    of_lengths = {"length error": "length_error_rms_mm", "u": "length_u_mm"}
    columns = {"held out": "group", "poses": "poses", "RMS": "rms_mm", "predicted": "rms_predicted_mm"}
    columns |= of_lengths if any(row["lengths"] for row in groups) else {}
    yield listed("", groups, columns | {"": mark})


def _uncertainty(summary: dict[str, Any]) -> View:
    """The expanded uncertainty (95 %) over the volume, the noise that it follows from, and what the data determine."""
    part = summary["uncertainty"]
    factors = ", ".join(filter(None, ("95 %", factor_words(part["volume"]))))
    rows = [
        (text, *("not determined" if value is None else two_digits(value) for value in values))
        for text, values in volume_rows(part["volume"])
    ]
    title = f"\nExpanded uncertainty U over the working volume ({factors}) [mm]"
    yield Table(title, ("", "median", "95th percentile", "largest"), rows)
    yield "Propagated from u of the parameters to 400 positions that random poses within the joint limits reach."
    if part.get("tried"):
        yield tried_sentence(part["tried"])
    noise = f"{encoders_in_words(part)}, {seat_in_words(summary)} {1e3 * part['seating_mm']:.3g} um"
    joints = ", ".join(str(row["joint"]) for row in part.get("noisy_encoders", ()))
    replaced = f", but for joint {joints}" if joints else ""
    source = {
        "given": f"Noise as given{replaced}: {noise}; residuals are {part['misfit'] or 0:.2f} times what it predicts.",
        "estimated": f"Noise estimated from the residuals: {noise} (only their combination is well determined).",
        "common": f"One variance for all poses: {1e3 * part['seating_mm']:.3g} um a coordinate.",
        "robust": "The variance of each pose is taken from its own residual (robust noise model).",
    }[part["form"]]
    pairs = [f"{row['one']} with {row['other']} ({row['r']:+.3f})" for row in part["correlated"][:6]]
    yield source + (f" Strongly correlated: {', '.join(pairs)}." if pairs else "")
    rest = " (the priors determine the rest)" if summary.get("prior") and part["rank"] < part["parameters"] else ""
    yield (
        f"Observability: rank {part['rank']} of {part['parameters']}{rest}, "
        f"condition {part['condition'] or math.inf:.3g}, "
        + ", ".join(f"{name} = {value:.3g}" for name, value in part["indices"].items())
    )
    if summary["monte_carlo"]:
        yield f"Monte Carlo (JCGM 101): {summary['monte_carlo']}"


def demo(summary: dict[str, Any]) -> View:
    """The demonstration: nominal arm, stage 1 and calibrated arm against the truth."""
    yield (
        f"The simulated arm of Cheng et al. 2018, off by up to {summary['deviation_mm']:g} mm and "
        f"{summary['deviation_deg']:g} deg, measured with {summary['encoder_arcsec']:g} arcsec and "
        f"{summary['seating_um']:g} um of noise:\n{summary['poses']} poses in one socket, {summary['more_poses']} in "
        f"another (stage 1), between them one length of {summary['length_mm']:.4f} mm with u = "
        f"{summary['length_u_um']:g} um (stage 2)."
    )
    rows = (
        ("de_mm", "DE, mean distance from centroid [mm]", 1.0),
        ("deltam_mm", "Deltam, largest half range [mm]", 1.0),
        *_TRUTH,
        ("check_rms_mm", f"RMS error of {summary['checks']} lengths of {summary['check_length_mm']:g} mm [mm]", 1.0),
    )
    cells = [(text, *(factor * summary[stage][key] for stage in _STAGES)) for key, text, factor in rows]
    yield Table("", ("against the truth", *_STAGES.values()), cells)
    yield (
        f"k = {summary['scale_k']:.7f}, u(k) = {summary['scale_u']:.1e}: stage 1 sees repeatability only and leaves "
        "every length off by this one factor; stage 2 divides it out."
    )
    yield f"Files in {summary['folder']}: {', '.join(summary['files'])}"
    for reason in summary["left_out"].values():
        yield f"Not made: {reason}"


def by_stage(title: str, metrics: dict[str, Any], stages: Sequence[str], *, fitted: bool = False) -> Table:
    """Repeatability and length errors by stage; ``fitted``: the scale makes the last length error zero."""
    rows = []
    for key, text in METRICS:
        if key in metrics[stages[0]]:
            cells = [metrics[stage][key] for stage in stages]
            if fitted and key.startswith("length"):
                cells[-1] = "fixed the scale"
            rows.append((text, *cells))
    return Table(title, ("", *(_STAGES[stage] for stage in stages)), rows)


def _parameters(rows: list[dict[str, Any]]) -> View:
    """Every free parameter in its own unit, to two digits of its standard uncertainty; hundreds of coefficients joint
    by joint."""

    def scaled(row: Mapping[str, Any]) -> tuple[str, ...]:
        factor, unit = people_read(row["unit"])
        nominal, value = factor * row["nominal"], factor * row["calibrated"]
        u = None if row["u"] is None else factor * row["u"]
        decimals = 9 if u == 0 else decimals_for(u)
        numbers = f"{nominal:z.4f}", f"{value:z.{decimals}f}", f"{value - nominal:+z.{decimals}f}"
        return row["parameter"], unit, *numbers, "-" if u is None else f"{u:.{decimals}f}", row["bound"] or ""

    def of_joint(row: Mapping[str, Any]) -> tuple[Any, ...]:
        factor, unit = people_read(row["unit"])
        largest = row["largest"]
        u = None if largest["u"] is None else factor * largest["u"]
        decimals = decimals_for(u)
        rms, value = f"{factor * row['rms']:.{decimals}f}", f"{factor * largest['calibrated']:+z.{decimals}f}"
        counts = row["joint"], row["coefficients"], row["orders"]
        return *counts, unit, rms, largest["parameter"], value, formatted(u, decimals)

    apart, harmonics = listed_apart(rows)
    headings = ("parameter", "unit", "nominal", "calibrated", "change", "u", "bound")
    yield Table("\nFree parameters, with standard uncertainty u", headings, [scaled(row) for row in apart])
    if harmonics:
        title = "\nHarmonics of the joints; every coefficient: --json, or aacmm export --format csv"
        headings = ("joint", "coefficients", "orders", "unit", "RMS", "largest", "its value", "its u")
        yield Table(title, headings, [of_joint(row) for row in harmonics_by_joint(harmonics)])


def _prior(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Each group of parameters that has a prior: its standard deviation, and how many of them the data determine."""

    def deviation(row: Mapping[str, Any]) -> str:
        scale, unit = people_read(row["unit"])
        return f"{row['sd'] * scale:.3g} {unit}".strip() if row["supported"] else "0: not supported by the data"

    return listed("\nPriors of the parameters", rows, {
        "group": "group",
        "standard deviation": deviation,
        "": lambda row: "learned" if row["learned"] else "given",
        "parameters": "parameters",
        "determined by the data": lambda row: f"{row['effective_parameters']:.1f}",
    })  # fmt: skip


def lengths(rows: list[dict[str, Any]], *, fitted: bool = False) -> Table:
    """Reference lengths; ``fitted``: a single one fixed the scale, so that its error is zero by construction."""
    cells = []
    for row in rows:
        decimals = decimals_for(row["error_u_mm"])
        measured, error, u = (formatted(row[f"{key}_mm"], decimals) for key in ("measured", "error", "error_u"))
        ends = f"{row['from']} - {row['to']}"
        cells.append((ends, row["value_mm"], measured, "fixed the scale" if fitted else error, u))
    headings = ("between", "value [mm]", "measured [mm]", "error [mm]", "u of error [mm]")
    return Table("\nReference lengths", headings, cells)
