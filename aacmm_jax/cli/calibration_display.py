"""Arms, captures, calibrations and the demonstration on a terminal; every heading names its unit."""

import math
from typing import Any

from rich.console import Console
from rich.markup import escape

from ..core.text import pluralise, shorten
from ..core.units import DEG
from ..summaries.tables import (
    METRICS,
    decimals_for,
    encoders_in_words,
    expanded_words,
    factor_words,
    lengths_sentence,
    observed_words,
    quantity_words,
    seat_in_words,
    two_digits,
    volume_rows,
)
from .display import (
    formatted,
    new_console,
    new_table,
    print_table,
    print_verdict,
    print_warnings,
    print_written,
)
from .parameter_display import print_corrections, print_lengths, print_parameters, print_prior

_MOST_PARTS = 12  # rows of a table
_TRUTH = (
    ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
    ("angle_error_largest_rad", "largest error of an angle parameter [deg]", 1 / DEG),
)


def arm(summary: dict[str, Any]) -> None:
    """One arm: its table and what its file proposes."""
    console = new_console()
    beta = any(row["beta_rad"] is not None for row in summary["joints"])
    slides = any(row["kind"] == "prismatic" for row in summary["joints"])
    limits_of = "limits of the reading" if slides else "limits [deg]"
    table = new_table(
        f"{summary['name']} (standard D-H)",
        "joint", "alpha [deg]", "a [mm]", "d [mm]", "theta [deg]", *(["beta [deg]"] if beta else []), limits_of,
    )  # fmt: skip
    for row in summary["joints"]:
        limits, (factor, unit) = row["limits_rad"], (DEG, " deg" if slides else "")
        if row["kind"] == "prismatic":
            limits, factor, unit = row["limits_mm"], 1.0, " mm"
        angles = [row["alpha_rad"] / DEG, row["a_mm"], row["d_mm"], row["theta_rad"] / DEG]
        cells = [formatted(value) for value in angles] + ([formatted((row["beta_rad"] or 0.0) / DEG)] if beta else [])
        cells.append("-" if limits is None else f"{limits[0] / factor:.0f} to {limits[1] / factor:.0f}{unit}")
        table.add_row(str(row["joint"]), *cells)
    print_table(console, table)
    console.print(
        f"Probe {', '.join(formatted(x) for x in summary['probe_mm'])} mm. Fixed: {', '.join(summary['held'])}."
    )
    print_corrections(console, summary["corrections"])
    if summary["urdf"] is not None:
        base, frame = summary["urdf"]["base"], summary["urdf"]["first_frame_in_base_mm"]
        where = f"in the frame of {base}"
        if any(x != (row == column) for row, values in enumerate(frame) for column, x in enumerate(values)):
            z, origin = (", ".join(f"{values[column]:.6g}" for values in frame[:3]) for column in (2, 3))
            where = f"in a frame at ({origin}) mm in {base}, with its z axis along ({z})"
        console.print(escape(f"From a URDF: {base} to {summary['urdf']['tip']}; positions are {where}."))


def capture(summary: dict[str, Any]) -> None:
    """One capture."""
    console = new_console()
    others = sum(row["kind"] != "socket" for row in summary["observations"])
    sockets = len(summary["sockets"]) + len(summary["observations"]) - others  # of sessions with an own probe, too
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {pluralise(summary['poses'], 'pose')} of "
        f"{pluralise(summary['joints'], 'joint')} in "
        f"{observed_words(sockets, others, len(summary['lengths']))}" + (", simulated" if summary["simulated"] else "")
    )
    print_warnings(console, summary)
    if summary["sockets"]:
        table = new_table("", "socket", "poses")
        for row in summary["sockets"]:
            table.add_row(escape(row["socket"]), str(row["poses"]))
        print_table(console, table)
    if summary["observations"]:
        _observations_of_capture(console, summary["observations"])
    slides = any("lowest_mm" in row for row in summary["ranges"])
    table = new_table("\nReadings", "joint", *(["lowest", "highest"] if slides else ["lowest [deg]", "highest [deg]"]))
    for row in summary["ranges"]:
        if "lowest_mm" in row:
            table.add_row(str(row["joint"]), *(f"{row[key]:.3f} mm" for key in ("lowest_mm", "highest_mm")))
            continue
        unit = " deg" if slides else ""
        table.add_row(str(row["joint"]), *(f"{row[key] / DEG:.3f}{unit}" for key in ("lowest_rad", "highest_rad")))
    print_table(console, table)
    if summary["temperature_C"] is not None:
        low, high = summary["temperature_C"]
        console.print(f"Temperature: {low:.2f} to {high:.2f} C.")
    if summary["lengths"]:
        table = new_table("\nReference lengths", "from", "to", "value [mm]", "u [mm]")
        for row in summary["lengths"]:
            table.add_row(escape(row["from"]), escape(row["to"]), formatted(row["value_mm"]), formatted(row["u_mm"]))
        print_table(console, table)
    print_written(console, summary)


def _observations_of_capture(console: Console, rows: list[dict[str, Any]]) -> None:
    """Every observation, its unknown geometry, and what is certified or stated of it."""
    table = new_table("\nOther observations", "observation", "kind", "target", "poses", "unknown geometry")
    for row in rows:
        cells = [str(row[key]) for key in ("observation", "kind", "target", "poses")]
        table.add_row(*map(escape, cells), escape(", ".join(row["unknowns"])))
    print_table(console, table)
    for row in rows:
        words = [f"{one['quantity']} {quantity_words(one)}" for one in (*row["certified"], *row["stated"])]
        if words:
            console.print(f"{escape(row['observation'])}: {escape(shorten(words, _MOST_PARTS))}.")


def calibration(summary: dict[str, Any]) -> None:
    """One calibration: warnings first."""
    console = new_console()
    print_solve(console, summary)
    print_verdict(console, summary)
    if summary.get("lengths_tested"):
        console.print(lengths_sentence(summary["lengths_tested"]))
    anchor = f"scale anchor {summary['hold']}" if summary["hold"] else "no scale anchor"
    if summary["scale_k"] is not None:
        u = summary["scale_u"] or 0.0
        console.print(f"Scale of stage 1: k = {summary['scale_k']:.{decimals_for(u, 8)}f}, u(k) = {u:.1e} ({anchor})")
    print_warnings(console, summary)
    _validated(console, summary["cross_validation"])
    _sessions(console, summary.get("sessions"))
    _observed(console, summary)
    stages = ("nominal", "calibrated") if summary["method"] == "joint" else ("nominal", "stage1", "calibrated")
    title = "\nOn the poses it was identified from [mm]"
    if summary["nominal"]:
        print_stages(console, title, summary, stages, fitted=summary["fixed_by_one_length"])
    if "truth" in summary:
        _truth(console, summary["truth"])
    print_parameters(console, summary["parameters"])
    if summary["held"]:
        console.print(f"Fixed at their nominal values: {', '.join(summary['held'])}.")
    if summary.get("prior"):
        print_prior(console, summary["prior"])
    if summary["lengths"]:
        print_lengths(console, summary["lengths"], fitted=summary["fixed_by_one_length"])
    _uncertainty(console, summary)
    if summary.get("shared_errors"):
        from ..summaries.uncertainty_sentences import shared_sentence

        console.print(shared_sentence(summary["shared_errors"]))
    print_written(console, summary)


def print_solve(console: Console, summary: dict[str, Any]) -> None:
    """How the solve ended; a residual that no arm has is not called converged, whatever the solver says."""
    verdict = "[green]converged[/green]" if summary["converged"] else "[red]did not converge[/red]"
    if summary["converged"] and not summary["residual_plausible"]:
        verdict = "[red]ended with a residual that no arm has[/red],"
    rows = summary["observations"]  # with observations of other kinds, or a probe for each session: sockets too
    sockets = {*summary["sockets_used"], *(row["observation"] for row in rows if row["kind"] == "socket")}
    others = sum(row["kind"] != "socket" for row in rows)
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold], {summary['method']}: {verdict} in "
        f"{pluralise(summary['steps'], 'step')} on {pluralise(summary['poses'], 'pose')} in "
        f"{observed_words(len(sockets), others)}"
    )


def _observed(console: Console, summary: dict[str, Any]) -> None:
    """Observations, the geometry found, poses that lost weight, and poses that were left out at random."""
    if summary["observations"]:
        table = new_table(
            "\nObservations, RMS distance from their geometry",
            *("observation", "kind", "poses", "nominal [mm]", "calibrated [mm]", "in s.d."),
        )
        for row in summary["observations"]:
            numbers = (formatted(row["rms_before_mm"]), formatted(row["rms_after_mm"]), f"{row['reduced_chi']:.2f}")
            table.add_row(escape(row["observation"]), row["kind"], str(row["poses"]), *numbers)
        print_table(console, table)
        table = new_table("\nUnknown geometry", "part", "quantity", "found", "U (95 %)")
        factor = summary["uncertainty"]["coverage_factor_geometry_95"]
        parts = [row for row in summary["geometry"] if not row["part"].startswith("position of ")]
        for row in parts[:_MOST_PARTS]:
            for one in row["quantities"]:
                words = (quantity_words(one, coverage=factor), expanded_words(one, factor))
                table.add_row(*map(escape, (row["part"], one["quantity"], *words)))
        if parts:
            print_table(console, table)
        hidden = len(summary["geometry"]) - len(parts[:_MOST_PARTS])
        if hidden:
            console.print(f"{pluralise(hidden, 'more part')} of the geometry, positions of sockets too: --json.")
    _base(console, summary)
    if summary["robust"]:
        rows = summary["less_weight"]
        listed = f"; the {_MOST_PARTS} of least weight, all by --json" if len(rows) > _MOST_PARTS else ""
        console.print(
            f"Robust loss {summary['robust']}: {pluralise(len(rows), 'pose')} with half the weight or less{listed}."
        )
        if rows:
            table = new_table("", "observation", "pose", "weight", "residual [mm]", "[standard deviations]")
            for row in rows[:_MOST_PARTS]:
                numbers = f"{row['weight']:.3f}", formatted(row["residual_mm"]), f"{row['normalised']:.1f}"
                table.add_row(escape(row["observation"]), str(row["pose"]), *numbers)
            print_table(console, table)
    if "other_poses" in summary:
        found = summary["other_poses"]
        console.print(
            f"\n[bold]Other poses[/bold], drawn at random and not calibrated with: {found['poses']}, RMS "
            f"{formatted(found['rms_mm'])} mm."
        )
        angles = [row for row in found["observations"] if row["rms_angle_rad"] is not None]
        for row in angles:
            console.print(f"Orientation of {escape(row['observation'])}: RMS {row['rms_angle_rad'] / DEG:.4f} deg.")


def _base(console: Console, summary: dict[str, Any]) -> None:
    """Where the base is in each frame of known coordinates, with its expanded uncertainty."""
    rows = summary.get("base")
    if not rows:
        return
    factor = summary["uncertainty"]["coverage_factor_geometry_95"]
    table = new_table("\nBase frame as seen from frames with known coordinates, U (95 %)", "in", "", "x", "y", "z")
    table.columns[1].justify = "left"
    for row in rows[:_MOST_PARTS]:
        for what, key, of_u, unit in (
            ("position [mm]", "position_mm", "position_u_mm", 1.0),
            ("rotation vector [deg]", "rotation_rad", "rotation_u_rad", 1 / DEG),
        ):
            expanded = [None if u is None else factor * unit * u for u in row[of_u]]
            decimals = [decimals_for(u) for u in expanded]
            values = (f"{unit * x:.{digits}f}" for x, digits in zip(row[key], decimals, strict=True))
            table.add_row(escape(row["in"]) if key == "position_mm" else "", escape(what), *values)
            known = zip(expanded, decimals, strict=True)
            table.add_row("", "U", *("-" if u is None else f"{u:.{digits}f}" for u, digits in known))
    print_table(console, table)


def _sessions(console: Console, rows: list[dict[str, Any]] | None) -> None:
    """Each session in the calibration of all, next to what it reaches alone; files of earlier versions do not say."""
    if not rows:
        return
    title = "\nSessions, RMS distance of poses from their geometry [mm]"
    table = new_table(title, "session", "poses", "together", "alone")
    for row in rows:
        numbers = (formatted(row["rms_mm"]), formatted(row["rms_alone_mm"]))
        table.add_row(escape(row["session"]), str(row["poses"]), *numbers)
    print_table(console, table)


def _validated(console: Console, found: dict[str, Any] | None) -> None:
    """Cross-validation."""
    if found is None:
        return
    title = f"\nCross-validated: each of {found['groups']} groups held out once [mm]"
    table = new_table(title, "", "found", "predicted by u")
    table.add_row(
        "RMS distance of poses from their socket or geometry",
        formatted(found["rms_mm"]),
        formatted(found["rms_predicted_mm"]),
    )
    if found["length_error_rms_mm"] is not None:
        table.add_row(
            "RMS error of reference lengths", formatted(found["length_error_rms_mm"]), formatted(found["length_u_mm"])
        )
    print_table(console, table)
    if "left_out" in found:
        _left_out(console, found["left_out"])


def _left_out(console: Console, rows: list[dict[str, Any]]) -> None:
    """Every group that was left out, the most improbable first; those beyond chance are marked."""
    lengths = any(row["lengths"] for row in rows)
    headings = ("poses", "RMS", "predicted", *(("length error", "u") if lengths else ()))
    table = new_table("", "held out", *headings, "")
    keys = ("rms_mm", "rms_predicted_mm", *(("length_error_rms_mm", "length_u_mm") if lengths else ()))
    for row in rows:
        mark = "[red]disagrees[/red]" if row["disagrees"] else "" if row["converged"] else "[red]did not converge[/red]"
        cells = (formatted(row[key]) for key in keys)
        table.add_row(escape(row["group"]), str(row["poses"]), *cells, mark)
    print_table(console, table)


def _uncertainty(console: Console, summary: dict[str, Any]) -> None:
    """The expanded uncertainty (95 %) over the volume, the noise that it follows from, and what the data determine."""
    found = summary["uncertainty"]
    volume = found["volume"]
    factors = ", ".join(filter(None, ("95 %", factor_words(volume))))
    title = f"\nExpanded uncertainty U over the working volume ({factors}) [mm]"
    table = new_table(title, "", "median", "95th percentile", "largest")
    for text, values in volume_rows(volume):
        table.add_row(text, *("not determined" if value is None else two_digits(value) for value in values))
    print_table(console, table)
    console.print(
        "Propagated from u of the parameters to 400 positions that random poses within the joint limits reach."
    )
    if found.get("tried"):
        from ..summaries.uncertainty_sentences import tried_sentence

        console.print(tried_sentence(found["tried"]))
    noise = f"{encoders_in_words(found)}, {seat_in_words(summary)} {1e3 * found['seating_mm']:.3g} um"
    joints = ", ".join(str(row["joint"]) for row in found.get("noisy_encoders", ()))
    replaced = f", but for joint {joints}" if joints else ""
    source = {
        "given": f"Noise as given{replaced}: {noise}; residuals are {found['misfit'] or 0:.2f} times what it predicts.",
        "estimated": f"Noise estimated from the residuals: {noise} (their sum is better known than each).",
        "common": f"One variance for all poses: {1e3 * found['seating_mm']:.3g} um a coordinate.",
        "robust": "The variance of each pose is taken from its own residual (robust noise model).",
    }[found["form"]]
    pairs = [f"{row['one']} with {row['other']} ({row['r']:+.3f})" for row in found["correlated"][:6]]
    console.print(source + (f" Strongly correlated: {', '.join(pairs)}." if pairs else ""), soft_wrap=False)
    indices = found["indices"]
    rest = " (the priors determine the rest)" if summary.get("prior") and found["rank"] < found["parameters"] else ""
    console.print(
        f"Observability: rank {found['rank']} of {found['parameters']}{rest}, "
        f"condition {found['condition'] or math.inf:.3g}, "
        + ", ".join(f"{name} = {value:.3g}" for name, value in indices.items())
    )
    if summary["monte_carlo"]:
        console.print(f"Monte Carlo (JCGM 101): {summary['monte_carlo']}")


def demo(summary: dict[str, Any]) -> None:
    """The demonstration: nominal arm, stage 1 and calibrated arm against the truth."""
    console = new_console()
    console.print(
        f"The simulated arm of Cheng et al. 2018, off by up to {summary['deviation_mm']:g} mm and "
        f"{summary['deviation_deg']:g} deg, measured with {summary['encoder_arcsec']:g} arcsec and "
        f"{summary['seating_um']:g} um of noise:\n{summary['poses']} poses in one socket, {summary['more_poses']} in "
        f"another (stage 1), between them one length of {summary['length_mm']:.4f} mm with u = "
        f"{summary['length_u_um']:g} um (stage 2)."
    )
    table = new_table("", "against the truth", "nominal", "stage 1", "calibrated")
    for key, text, factor in (
        ("de_mm", "DE, mean distance from centroid [mm]", 1.0),
        ("deltam_mm", "Deltam, largest half range [mm]", 1.0),
        *_TRUTH,
        ("check_rms_mm", f"RMS error of {summary['checks']} lengths of {summary['check_length_mm']:g} mm [mm]", 1.0),
    ):
        table.add_row(
            escape(text), *(formatted(factor * summary[stage][key]) for stage in ("nominal", "stage1", "calibrated"))
        )
    print_table(console, table)
    console.print(
        f"k = {summary['scale_k']:.7f}, u(k) = {summary['scale_u']:.1e}: stage 1 sees repeatability only and leaves "
        "every length off by this one factor; stage 2 divides it out."
    )
    console.print(f"Files in {escape(summary['folder'])}: {', '.join(escape(name) for name in summary['files'])}")
    for reason in summary["left_out"].values():
        console.print(f"Not made: {escape(reason)}")


def print_stages(
    console: Console, title: str, metrics: dict[str, Any], stages: tuple[str, ...], *, fitted: bool = False
) -> None:
    """Repeatability and length errors by stage; ``fitted``: the scale makes the last length error zero."""
    names = {"nominal": "nominal", "stage1": "stage 1", "calibrated": "calibrated"}
    table = new_table(title, "", *(names[stage] for stage in stages))
    for key, text in METRICS:
        if key in metrics[stages[0]]:
            cells = [formatted(metrics[stage][key]) for stage in stages]
            table.add_row(
                escape(text), *cells[:-1], "fixed the scale" if fitted and key.startswith("length") else cells[-1]
            )
    print_table(console, table)


def _truth(console: Console, truth: dict[str, Any]) -> None:
    stages = ("nominal", "stage1", "calibrated")
    table = new_table("\nAgainst the true arm of the simulation", "", "nominal", "stage 1", "calibrated")
    for key, text, factor in _TRUTH:
        table.add_row(escape(text), *(formatted(factor * truth[stage][key]) for stage in stages))
    print_table(console, table)
