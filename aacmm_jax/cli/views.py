"""What people see of arms, captures, calibrations, evaluations and the demonstration; every heading names its unit."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ..core.text import pluralise, shorten
from ..core.units import DEG, people_read, people_read_change
from ..summaries import result_tables as tables
from ..summaries import tables as words
from ..summaries.camera_tables import camera_view, images_words, shown_apart
from ..summaries.result_tables import BY_CONSTRUCTION, STAGES, listed_apart
from ..summaries.tables import Line, Styled, Table, View, decimals_for, formatted, listed, number
from ..uncertainty.coverage import LEVEL_IN_PERCENT

_MOST_PARTS = 12  # rows of a table
_ARMS = {stage: words for stage, words in STAGES.items() if stage != "stage1"}
_GROUPS = {
    "held_out": "Held-out data, which were not used for the calibration",
    "identified_from": "Data used for identification",
}


def arm(summary: dict[str, Any]) -> View:
    """One arm: its table and what its file proposes."""
    joints, urdf = summary["joints"], summary["urdf"]
    slides = any(row["kind"] == "prismatic" for row in joints)

    def limits(row: dict[str, Any]) -> str | None:
        ends, size, unit = (
            (row["limits_rad"], DEG, "deg") if row["limits_mm"] is None else (row["limits_mm"], 1.0, "mm")
        )
        return ends and f"{ends[0] / size:.0f} to {ends[1] / size:.0f}" + (f" {unit}" if slides else "")

    yield listed(f"{summary['name']} (standard D-H)", joints, {
        "joint": "joint",
        "alpha [deg]": lambda row: row["alpha_rad"] / DEG,
        "a [mm]": "a_mm",
        "d [mm]": "d_mm",
        "theta [deg]": lambda row: row["theta_rad"] / DEG,
        "beta [deg]": (lambda row: (row["beta_rad"] or 0.0) / DEG)
        if any(row["beta_rad"] is not None for row in joints)
        else None,
        "limits of the reading" if slides else "limits [deg]": limits,
    })  # fmt: skip
    yield (
        f"Position of the probe in the last frame: ({', '.join(formatted(x) for x in summary['probe_mm'])}) mm. Fixed "
        f"parameters: {', '.join(summary['held'])}."
    )
    calibrated = [row for row in summary["corrections"] if row["value"] != 0]
    if calibrated:
        cells = []
        for row in calibrated:
            scale, unit = people_read_change("rad") if row["unit"] == "rad" else people_read(row["unit"])
            cells.append((row["coefficient"], f"{scale * row['value']:.4g}", unit, row["of"]))
        yield listed("Joint corrections", cells, ("coefficient", "value", "unit", ""))
    zero: dict[str, list[str]] = {}
    for row in summary["corrections"]:
        if row["value"] == 0 and row["of"]:  # not the direction of gravity
            zero.setdefault(row["of"], []).append(row["coefficient"])
    for kind, names in zero.items():
        amount = pluralise(len(names), "coefficient")
        yield f"Joint corrections that are 0 until they are calibrated: {amount}, {kind} ({shorten(names)})."
    if urdf is not None:
        base, frame = urdf["base"], urdf["first_frame_in_base_mm"]
        where = f"in the frame of {base}"
        if any(x != (row == column) for row, values in enumerate(frame) for column, x in enumerate(values)):
            z, origin = (", ".join(f"{values[column]:.6g}" for values in frame[:3]) for column in (2, 3))
            where = f"in a frame at ({origin}) mm in {base}, with its z axis along ({z})"
        source = "MJCF" if urdf["format"] == "MJCF" else "a URDF"
        yield f"From {source}, links {base} to {urdf['tip']}; positions are {where}."


def capture(summary: dict[str, Any]) -> View:
    """One capture."""
    observations = summary["observations"]
    others = sum(row["kind"] != "socket" for row in observations)
    sockets = len(summary["sockets"]) + len(observations) - others  # of sessions with an own probe, too
    observed = words.observed_words(sockets, others, len(summary["lengths"]))
    yield [
        Styled(summary["arm"]),
        f": {pluralise(summary['poses'], 'pose')} of {pluralise(summary['joints'], 'joint')} in {observed}"
        + (", simulated" if summary["simulated"] else ""),
    ]
    yield from words.warnings_of(summary)
    if summary["sockets"]:
        yield listed("", summary["sockets"], {"socket": "socket", "poses": "poses"})
    if observations:
        columns: dict[str, Any] = {key: key for key in ("observation", "kind", "target", "poses")}
        columns["unknown geometry"] = lambda row: ", ".join(row["unknowns"])
        yield listed("Other observations", observations, columns)
    for row in observations:
        quantities = (*row["certified"], *row["stated"])
        stated = [f"{quantity['quantity']} {words.quantity_words(quantity)}" for quantity in quantities]
        if stated:
            yield f"{row['observation']}: {shorten(stated, _MOST_PARTS)}."
    yield from images_words(summary.get("images") or ())
    yield from (f"{note}." for note in summary.get("notes") or ())
    slides = any("lowest_mm" in row for row in summary["ranges"])

    def reading(row: dict[str, Any], end: str) -> Any:
        value, unit = (row[f"{end}_mm"], "mm") if f"{end}_mm" in row else (row[f"{end}_rad"] / DEG, "deg")
        return f"{value:.3f} {unit}" if slides else number(value, 3)

    ends = {end: end if slides else f"{end} [deg]" for end in ("lowest", "highest")}
    columns = {heading: lambda row, end=end: reading(row, end) for end, heading in ends.items()}
    yield listed("Readings", summary["ranges"], {"joint": "joint"} | columns)
    if summary["largest_torques_Nm"] is not None:
        torques = ", ".join(f"{torque:.3g}" for torque in summary["largest_torques_Nm"])
        yield f"Largest torques of the joints: {torques} N m."
    if summary["load_kg"] is not None:
        low, high = summary["load_kg"]
        yield f"Load at the tip: {low:.3g} to {high:.3g} kg."
    if summary["temperature_C"] is not None:
        low, high = summary["temperature_C"]
        yield f"Temperature: {low:.2f} to {high:.2f} C."
    if summary["lengths"]:
        columns = {"from": "from", "to": "to", "value [mm]": "value_mm", "u [mm]": "u_mm"}
        yield listed("Reference lengths", summary["lengths"], columns)
    yield from words.written_of(summary)


def calibration(summary: dict[str, Any]) -> View:
    """One calibration: what it is good for first, then warnings."""
    yield from words.verdict_of(summary)
    yield solve(summary)
    if summary.get("lengths_tested"):
        yield words.lengths_sentence(summary["lengths_tested"])
    if "held_out_poses" in summary:
        yield words.held_out_sentence(summary["held_out_poses"]["held_out"])
    elif (validated := summary["cross_validation"]) is not None and validated["rms_mm"] is not None:
        yield words.cross_validated_sentence(validated)
    yield from words.decided_of(summary)
    if summary["masses"]:
        yield summary["masses"]
    anchor = f"scale anchor {summary['hold']}" if summary["hold"] else "no scale anchor"
    if summary["scale_k"] is not None:
        u = summary["scale_u"] or 0.0
        yield f"Scale of stage 1: k = {summary['scale_k']:.{decimals_for(u, 8)}f}, u(k) = {u:.1e} ({anchor})"
    yield from words.warnings_of(summary)
    yield from camera_view(summary)
    if summary["cross_validation"] is not None:
        yield from tables.validation_tables(summary["cross_validation"])
    if summary.get("sessions"):
        columns = {
            "session": "session",
            "poses": "poses",
            "all sessions fitted": "rms_mm",
            "this session alone": "rms_alone_mm",
        }
        yield listed("Sessions: RMS distance of poses from their geometry [mm]", summary["sessions"], columns)
    yield from _observations(summary)
    stages = {stage: name for stage, name in STAGES.items() if stage != "stage1" or summary["method"] != "joint"}
    fixed_scale = summary["fixed_by_one_length"]
    if summary["nominal"] and summary["parameters"]:
        title = "Errors in the poses used for identification (nominal: with the tip as stated) [mm]"
        yield tables.metrics_table(title, summary, stages, fixed_scale=fixed_scale)
    if "truth" in summary:
        yield tables.truth_table(summary["truth"])
    apart, harmonics = listed_apart(summary["parameters"])
    if apart:
        yield tables.parameter_table("Parameters", apart)
    if harmonics:
        yield tables.harmonics_table(harmonics)
        yield "All coefficients are written with --json and by aacmm export --format csv."
    if summary["held"] and summary["parameters"]:
        yield f"Fixed at their nominal values: {', '.join(summary['held'])}."
    if summary.get("prior"):
        yield tables.prior_table(summary["prior"])
    if summary["lengths"]:
        yield lengths(summary["lengths"], fixed_scale=fixed_scale)
    if summary["parameters"]:
        yield from _uncertainty(summary)
    if summary.get("shared_errors"):
        yield words.shared_sentence(summary["shared_errors"])
    yield from words.written_of(summary)


def solve(summary: dict[str, Any]) -> Line:
    """How the solve ended; a residual or a scale that no arm has is not called converged, whatever the solver says."""
    ended = Styled("converged", "green") if summary["converged"] else Styled("did not converge", "red")
    if not summary["scale_plausible"]:
        ended = Styled("ended with a scale that is not plausible", "red")
    if summary["converged"] and not summary["residual_plausible"]:
        ended = Styled("ended with residuals that are too large for this arm,", "red")
    rows = summary["observations"]  # with observations of other kinds, or a probe for each session: sockets too
    sockets = {*summary["sockets_used"], *(row["observation"] for row in rows if row["kind"] == "socket")}
    observed = words.observed_words(len(sockets), sum(row["kind"] != "socket" for row in rows))
    steps, poses = pluralise(summary["steps"], "step"), pluralise(summary["poses"], "pose")
    return [Styled(summary["arm"]), f", {summary['method']}: ", ended, f" in {steps} on {poses} in {observed}"]


def _observations(summary: dict[str, Any]) -> View:
    """Observations, the geometry found, poses that lost weight, and poses that were left out at random."""
    factor = summary["uncertainty"]["coverage_factor_geometry_95"]
    if summary["observations"]:
        yield from tables.agreement_tables(summary)
        parts = [row for row in shown_apart(summary) if not row["part"].startswith("position of ")][:_MOST_PARTS]
        if parts:
            yield tables.geometry_table(parts, factor)
        hidden = len(shown_apart(summary)) - len(parts)
        if hidden:
            yield (
                f"--json also shows {pluralise(hidden, 'more part')} of the geometry, including the positions of the "
                "sockets."
            )
    if summary.get("robot_bases"):
        yield tables.robot_bases_table(summary["robot_bases"], factor)
    if summary.get("base"):
        yield tables.base_table(summary["base"][:_MOST_PARTS], factor)
    if summary["robust"]:
        rows = summary["less_weight"]
        least = (
            f"; the {_MOST_PARTS} with the least weight are listed (all with --json)" if len(rows) > _MOST_PARTS else ""
        )
        yield (
            f"Robust loss {summary['robust']}: {pluralise(len(rows), 'pose')} with half of the full weight or "
            f"less{least}."
        )
        if rows:
            yield tables.weights_table(summary, _MOST_PARTS)
    if "held_out_poses" in summary:
        yield from tables.held_out_tables(summary["held_out_poses"])


def _uncertainty(summary: dict[str, Any]) -> View:
    """The expanded uncertainty over the volume, the noise that it follows from, and what the data determine."""
    part = summary["uncertainty"]
    regions = {"where poses were taken": part["where_poses_were_taken"], "over all joint limits": part["volume"]}
    for region, volume in regions.items():
        if volume is not None:
            factors = ", ".join(filter(None, (LEVEL_IN_PERCENT, words.factor_words(volume))))
            yield tables.volume_table(f"Expanded uncertainty U {region} ({factors}) [mm]", volume)
    yield (
        "U is propagated from the uncertainties of the parameters to tip positions: those of poses of the calibration, "
        "and those of 400 random poses within the joint limits."
    )
    if part.get("tried"):
        yield words.tried_sentence(part["tried"])
    pairs = [f"{row['one']} with {row['other']} ({row['r']:+.3f})" for row in part["correlated"][:6]]
    yield words.noise_sentence(summary) + (f" Strongly correlated: {', '.join(pairs)}." if pairs else "")
    rest = " (the priors determine the rest)" if summary.get("prior") and part["rank"] < part["parameters"] else ""
    indices = ", ".join(f"{name} = {value:.3g}" for name, value in part["indices"].items())
    yield (
        f"Observability: rank {part['rank']} of {part['parameters']}{rest}, "
        f"condition {part['condition'] or math.inf:.3g}, {indices}"
    )
    if summary["monte_carlo"]:
        yield f"Monte Carlo (JCGM 101): {summary['monte_carlo']}"


def demo(summary: dict[str, Any]) -> View:
    """The demonstration: nominal arm, stage 1 and calibrated arm against the truth."""
    before, after = (summary[stage]["check_rms_mm"] for stage in ("nominal", "calibrated"))
    yield Styled(
        f"Calibrated: lengths of {summary['check_length_mm']:g} mm are measured with an error of {after:.2g} mm RMS, "
        f"where the nominal arm has {before:.2g} mm."
    )
    yield (
        "Simulated arm of Cheng et al. 2018: its parameters differ from the nominal ones by up to "
        f"{summary['deviation_mm']:g} mm and {summary['deviation_deg']:g} deg; the noise is "
        f"{summary['encoder_arcsec']:g} arcsec for the encoders and {summary['seating_um']:g} um for the seat.\nStage "
        f"1 uses {summary['poses']} poses in one socket and {summary['more_poses']} in another. Stage 2 uses one "
        f"length of {summary['length_mm']:.4f} mm between the sockets, with u = {summary['length_u_um']:g} um."
    )
    rows = {
        "DE, mean distance from centroid [mm]": "de_mm",
        "Deltam, largest half range [mm]": "deltam_mm",
        f"RMS error of {summary['checks']} lengths of {summary['check_length_mm']:g} mm [mm]": "check_rms_mm",
    }
    stages = {stage: words for stage, words in STAGES.items() if stage in summary}
    cells = [(text, *(summary[stage][key] for stage in stages)) for text, key in rows.items()]
    yield listed("Lengths and repeatability", cells, ("", *stages.values()))
    yield tables.truth_table(summary)
    yield (
        f"k = {summary['scale_k']:.7f}, u(k) = {summary['scale_u']:.1e}: stage 1 uses repeatability only, so all "
        "lengths are wrong by this common factor; stage 2 divides all lengths by this factor."
    )
    yield f"Files in {summary['folder']}: {', '.join(summary['files'])}"
    yield from (f"Not written: {reason}" for reason in summary["left_out"].values())


def lengths(rows: Sequence[Mapping[str, Any]], *, fixed_scale: bool = False, predicted: bool = False) -> Table:
    """Reference lengths; ``fixed_scale``: a single one fixed the scale, so that its error is zero by construction.
    ``predicted``: held-out ones, whose U contains the uncertainty of the calibration and of the length, and the noise.
    """
    u = "expanded_mm" if predicted else "error_u_mm"

    def read(key: str) -> Any:
        return lambda row: number(row[key], decimals_for(row[u]))

    def ratio(row: Mapping[str, Any]) -> Any:
        value = None if fixed_scale else row["error_over_expanded"]
        return number(value, 2, signed=True, mark="bad" if value is not None and abs(value) > 1 else "")

    return listed("Reference lengths [mm]" + (f"; U: {LEVEL_IN_PERCENT}" if predicted else ""), rows, {
        "between": lambda row: f"{row['from']} - {row['to']}",
        "value": "value_mm",
        "measured": read("measured_mm"),
        "error": (lambda row: BY_CONSTRUCTION) if fixed_scale else read("error_mm"),
        "U" if predicted else "u of error": read(u),
        "error / U": ratio if predicted else None,
    })  # fmt: skip


def evaluation(summary: dict[str, Any]) -> View:
    """One evaluation: decisions first, then held-out data, since they are what counts."""
    yield from words.verdict_of(summary)
    if statable := summary.get("conformity_verdict"):
        yield f'To state this in a certificate: conformity.verdict = "{statable}" in the file of --about.'
    yield Styled(summary["arm"])
    yield from words.warnings_of(summary)
    yield from words.limits_of(summary)
    if summary["acceptance"] or summary["standards"]:
        yield from _acceptance(summary)
    yield from words.warnings_of(summary, "Warning from the calibration:", "calibration_warnings")
    for group, text in _GROUPS.items():
        part = summary[group]
        if part is None:
            continue
        fixed_scale, predicted = part["fixed_by_one_length"], part.get("predicted") is not None
        yield tables.metrics_table(f"{text} [mm]", part, _ARMS, fixed_scale=fixed_scale)
        if part["sockets"]:
            yield listed("", part["sockets"], {
                "socket": "socket",
                "poses": "poses",
                "DE [mm]": "de_mm",
                "Deltam [mm]": "deltam_mm",
                "RMS [mm]": "rms_mm",
                "predicted [mm]": "rms_predicted_mm" if predicted else None,
            })  # fmt: skip
        if part["observations"]:
            title = "Observations, RMS distance of poses from their geometry [mm]"
            yield tables.observations_table(title, part["observations"])
        if predicted:
            yield from _predicted(part)
        if part["lengths"]:
            yield lengths(part["lengths"], fixed_scale=fixed_scale, predicted=predicted)
    yield from words.written_of(summary)


def _predicted(part: dict[str, Any]) -> View:
    """Residuals of held-out data by kind, and by what shares a geometry or a length."""
    kinds, groups, poses = part["kinds"], part["groups"], part["predicted"]["poses"]
    numbers: dict[str, Any] = {"poses": "poses", "RMS": "rms_mm", "predicted": "rms_predicted_mm"}
    numbers["in standard deviations"] = lambda row: number(row["reduced_chi"], 2)
    if len(kinds) > 1 and part["observations"]:
        yield listed("By kind [mm]", kinds, {"kind": "kind"} | numbers)
    if len(groups) > 1 and any(len(row["members"]) > 1 for row in groups):
        title = "Groups of observations that share a length or an unknown geometry [mm]"
        yield listed(title, groups, {"group": "group"} | numbers)
    if poses["rms_mm"] is not None:
        prediction = poses["rms_predicted_mm"]
        predicted = (
            "no prediction, because the data do not determine all the parameters that a prediction needs"
            if prediction is None
            else f"{formatted(prediction)} mm predicted from the uncertainty of the calibration and the noise"
        )
        yield f"All held-out poses: RMS {formatted(poses['rms_mm'])} mm; {predicted}."


def report(summary: dict[str, Any]) -> View:
    """A report that was written."""
    yield [Styled(summary["title"]), f": {summary['verdict']}"]
    yield from words.warnings_of(summary)
    yield f"Written: {summary['written']} ({summary['bytes'] / 1e6:.1f} MB; open it in a browser)"


def points(summary: dict[str, Any]) -> View:
    """Acceptance tests of points: the decision first."""
    counts = (pluralise(summary[f"{noun}s"], noun) for noun in ("socket", "length", "sphere"))
    yield from words.verdict_of(summary)
    yield f"{pluralise(summary['points'], 'point')}: {', '.join(counts)}"
    yield from words.warnings_of(summary)
    yield from _acceptance(summary)
    yield from words.written_of(summary)


def _acceptance(summary: dict[str, Any]) -> View:
    """Every metric with its limit, and what the full procedure of each test would need."""
    tests = summary["acceptance"]
    if not tests:
        yield (
            "No acceptance test applies: the data contain no socket with several poses, no length and no sphere for "
            "such a test."
        )
        return
    yield "\nAcceptance tests, single readings"
    for test, metrics in zip(tests, tables.acceptance_tables(tests, brief=True), strict=True):
        yield metrics
        if test["missing"]:
            yield "The procedure is not complete:"
            yield from (f"  - {sentence}" for sentence in test["missing"])
    limited = any(metric["limit_mm"] is not None for test in tests for metric in test["figures"])
    rules = dict.fromkeys(test["rule"] for test in tests if test["decision"])
    of_test = summary["u_test_mm"] or any(summary["influences"].values())
    stated = " and of the test (--test-u-mm, --expansion)" if of_test else ""
    yield f"U is the uncertainty of the artefacts{stated}." + (
        f" Decision rule: {'; '.join(rules)}." if limited else ""
    )
