"""What people see of arms, captures, calibrations and the demonstration; every heading names its unit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core.text import pluralise, shorten
from ..core.units import DEG, people_read, people_read_change
from ..summaries.harmonics import listed_apart
from ..summaries.result_tables import (
    BY_CONSTRUCTION,
    STAGES,
    agreement_tables,
    geometry_table,
    harmonics_table,
    metrics_table,
    other_poses_table,
    parameter_table,
    prior_table,
    truth_table,
    validation_tables,
    volume_table,
    weights_table,
)
from ..summaries.tables import (
    Line,
    Styled,
    Table,
    decimals_for,
    encoders_in_words,
    factor_words,
    formatted,
    lengths_sentence,
    listed,
    number,
    observed_words,
    quantity_words,
    seat_in_words,
    shared_sentence,
    tried_sentence,
    verdict_of,
    warnings_of,
    written_of,
)

View = Iterator[Line | Table]
_MOST_PARTS = 12  # rows of a table


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
    calibrated = [row for row in rows if row["value"] != 0]
    if calibrated:
        units = [
            people_read_change(row["unit"]) if row["unit"] == "rad" else people_read(row["unit"]) for row in calibrated
        ]
        cells = [
            (row["coefficient"], f"{scale * row['value']:.4g}", unit, row["of"])
            for row, (scale, unit) in zip(calibrated, units, strict=True)
        ]
        yield listed("Joint corrections", cells, ("coefficient", "value", "unit", ""))
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
        yield listed("Other observations", summary["observations"], columns)
    for row in summary["observations"]:
        stated = [f"{number['quantity']} {quantity_words(number)}" for number in (*row["certified"], *row["stated"])]
        if stated:
            yield f"{row['observation']}: {shorten(stated, _MOST_PARTS)}."
    slides = any("lowest_mm" in row for row in summary["ranges"])

    def reading(row: dict[str, Any], end: str) -> Any:
        if f"{end}_mm" in row:
            return f"{row[f'{end}_mm']:.3f} mm"
        value = row[f"{end}_rad"] / DEG
        return f"{value:.3f} deg" if slides else number(value, 3)

    unit = "" if slides else " [deg]"
    ends = {f"{end}{unit}": lambda row, end=end: reading(row, end) for end in ("lowest", "highest")}
    yield listed("Readings", summary["ranges"], {"joint": "joint"} | ends)
    if summary["temperature_C"] is not None:
        low, high = summary["temperature_C"]
        yield f"Temperature: {low:.2f} to {high:.2f} C."
    if summary["lengths"]:
        columns = {"from": "from", "to": "to", "value [mm]": "value_mm", "u [mm]": "u_mm"}
        yield listed("Reference lengths", summary["lengths"], columns)
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
    if summary["cross_validation"] is not None:
        yield from validation_tables(summary["cross_validation"])
    if summary.get("sessions"):
        columns = {"session": "session", "poses": "poses", "together": "rms_mm", "alone": "rms_alone_mm"}
        yield listed("Sessions, RMS distance of poses from their geometry [mm]", summary["sessions"], columns)
    yield from _observations(summary)
    stages = {stage: words for stage, words in STAGES.items() if stage != "stage1" or summary["method"] != "joint"}
    fixed_scale = summary["fixed_by_one_length"]
    if summary["nominal"]:
        yield metrics_table("On the poses it was identified from [mm]", summary, stages, fixed_scale=fixed_scale)
    if "truth" in summary:
        yield truth_table(summary["truth"])
    apart, harmonics = listed_apart(summary["parameters"])
    yield parameter_table("Parameters", apart)
    if harmonics:
        yield harmonics_table(harmonics)
        yield "Every coefficient: --json, or aacmm export --format csv."
    if summary["held"]:
        yield f"Fixed at their nominal values: {', '.join(summary['held'])}."
    if summary.get("prior"):
        yield prior_table(summary["prior"])
    if summary["lengths"]:
        yield lengths(summary["lengths"], fixed_scale=fixed_scale)
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
    factor = summary["uncertainty"]["coverage_factor_geometry_95"]
    if summary["observations"]:
        yield from agreement_tables(summary)
        parts = [row for row in summary["geometry"] if not row["part"].startswith("position of ")][:_MOST_PARTS]
        if parts:
            yield geometry_table(parts, factor)
        hidden = len(summary["geometry"]) - len(parts)
        if hidden:
            yield f"{pluralise(hidden, 'more part')} of the geometry, positions of sockets too: --json."
    if summary.get("base"):
        yield base(summary["base"], factor)
    if summary["robust"]:
        rows = summary["less_weight"]
        least = f"; the {_MOST_PARTS} of least weight, all by --json" if len(rows) > _MOST_PARTS else ""
        yield f"Robust loss {summary['robust']}: {pluralise(len(rows), 'pose')} with half the weight or less{least}."
        if rows:
            yield weights_table(summary, _MOST_PARTS)
    if "other_poses" in summary:
        yield other_poses_table(summary["other_poses"])


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
            rows.append((name, what, *(number(scale * x, digits, rounded=True) for x, digits in values)))
            rows.append(("", "U", *(number(u, digits) for u, digits in zip(expanded, decimals, strict=True))))
    title = "Base frame as seen from frames with known coordinates, U (95 %)"
    return listed(title, rows, ("in", "", "x", "y", "z"))


def _uncertainty(summary: dict[str, Any]) -> View:
    """The expanded uncertainty (95 %) over the volume, the noise that it follows from, and what the data determine."""
    part = summary["uncertainty"]
    factors = ", ".join(filter(None, ("95 %", factor_words(part["volume"]))))
    yield volume_table(f"Expanded uncertainty U over the working volume ({factors}) [mm]", part["volume"])
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
    rows = {
        "DE, mean distance from centroid [mm]": "de_mm",
        "Deltam, largest half range [mm]": "deltam_mm",
        f"RMS error of {summary['checks']} lengths of {summary['check_length_mm']:g} mm [mm]": "check_rms_mm",
    }
    cells = [(text, *(summary[stage][key] for stage in STAGES)) for text, key in rows.items()]
    yield listed("Lengths and repeatability", cells, ("", *STAGES.values()))
    yield truth_table(summary)
    yield (
        f"k = {summary['scale_k']:.7f}, u(k) = {summary['scale_u']:.1e}: stage 1 sees repeatability only and leaves "
        "every length off by this one factor; stage 2 divides it out."
    )
    yield f"Files in {summary['folder']}: {', '.join(summary['files'])}"
    for reason in summary["left_out"].values():
        yield f"Not made: {reason}"


def lengths(rows: Sequence[Mapping[str, Any]], *, fixed_scale: bool = False) -> Table:
    """Reference lengths; ``fixed_scale``: a single one fixed the scale, so that its error is zero by construction."""

    def read(key: str) -> Any:
        return lambda row: number(row[key], decimals_for(row["error_u_mm"]))

    return listed("Reference lengths [mm]", rows, {
        "between": lambda row: f"{row['from']} - {row['to']}",
        "value": "value_mm",
        "measured": read("measured_mm"),
        "error": (lambda row: BY_CONSTRUCTION) if fixed_scale else read("error_mm"),
        "u of error": read("error_u_mm"),
    })  # fmt: skip
