"""Tables on a terminal. Lengths are printed in mm and um, angles in degrees and arcseconds, each named in its heading."""

import math
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

_ARCSEC = 3600 * 180 / math.pi
_FIGURES = (
    ("de_mm", "DE, mean distance of poses from their socket's centroid"),
    ("deltam_mm", "Deltam, largest half range of a coordinate in a socket"),
    ("rms_mm", "RMS distance of poses from their socket's centroid"),
    ("length_error_mean_absolute_mm", "length error, mean absolute"),
    ("length_error_largest_mm", "length error, largest"),
)
_TRUTH = (
    ("length_error_largest_mm", "largest error of a length parameter [mm]", 1.0),
    ("angle_error_largest_rad", "largest error of an angle parameter [arcsec]", _ARCSEC),
)


def _console() -> Console:
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=110)


def _table(title: str, *columns: str) -> Table:
    table = Table(
        title=escape(title) or None, title_justify="left", title_style="bold", box=None, pad_edge=False, padding=(0, 2, 0, 0)
    )
    for number, column in enumerate(columns):
        table.add_column(escape(column), justify="left" if number == 0 else "right")
    return table


def _number(value: float | None, decimals: int = 4) -> str:
    if value is None:
        return "-"
    if abs(value) < 1e-9:  # mm: rounding
        value = 0.0
    small = value != 0 and abs(value) < 0.5 * 10**-decimals
    return f"{value:.1e}" if small else f"{value:.{decimals}f}"


def arm(summary: dict[str, Any]) -> None:
    """One arm: its table and what its file proposes."""
    console = _console()
    beta = any(row["beta_rad"] is not None for row in summary["joints"])
    table = _table(
        f"{summary['name']} (standard D-H)",
        "joint", "alpha [deg]", "a [mm]", "d [mm]", "theta [deg]", *(["beta [deg]"] if beta else []), "limits [deg]",
    )  # fmt: skip
    for row in summary["joints"]:
        limits = row["limits_rad"]
        angles = [math.degrees(row["alpha_rad"]), row["a_mm"], row["d_mm"], math.degrees(row["theta_rad"])]
        cells = [_number(value) for value in angles] + ([_number(math.degrees(row["beta_rad"] or 0.0))] if beta else [])
        cells.append("-" if limits is None else f"{math.degrees(limits[0]):.0f} to {math.degrees(limits[1]):.0f}")
        table.add_row(str(row["joint"]), *cells)
    console.print(table)
    console.print(
        f"Probe {', '.join(_number(x) for x in summary['probe_mm'])} mm. Not identified: {', '.join(summary['held'])}."
    )


def capture(summary: dict[str, Any]) -> None:
    """One capture."""
    console = _console()
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold]: {summary['poses']} poses of {summary['joints']} joints in "
        f"{len(summary['sockets'])} sockets, {len(summary['lengths'])} reference lengths"
        + (", simulated" if summary["simulated"] else "")
    )
    _warnings(console, summary)
    table = _table("", "socket", "poses")
    for row in summary["sockets"]:
        table.add_row(escape(row["socket"]), str(row["poses"]))
    console.print(table)
    table = _table("\nReadings", "joint", "lowest [deg]", "highest [deg]")
    for row in summary["ranges"]:
        table.add_row(str(row["joint"]), *(f"{math.degrees(row[key]):.3f}" for key in ("lowest_rad", "highest_rad")))
    console.print(table)
    if summary["lengths"]:
        table = _table("\nReference lengths", "from", "to", "value [mm]", "u [mm]")
        for row in summary["lengths"]:
            table.add_row(escape(row["from"]), escape(row["to"]), _number(row["value_mm"]), _number(row["u_mm"]))
        console.print(table)
    _written(console, summary)


def calibration(summary: dict[str, Any]) -> None:
    """One calibration: warnings first."""
    console = _console()
    verdict = "[green]converged[/green]" if summary["converged"] else "[red]did not converge[/red]"
    console.print(
        f"[bold]{escape(summary['arm'])}[/bold], {summary['method']}: {verdict} in {summary['steps']} steps on "
        f"{summary['poses']} poses in {len(summary['sockets_used'])} sockets"
    )
    held = f"{summary['hold']} held meanwhile" if summary["hold"] else "no length held"
    console.print(f"Scale of stage 1: k = {summary['scale_k']:.8f}, u(k) = {summary['scale_u']:.1e} ({held})")
    _warnings(console, summary)
    _validated(console, summary["cross_validation"])
    stages = ("nominal", "stage1", "calibrated")
    _stages(console, "\nOn the poses it was identified from [mm]", summary, stages, fitted=summary["fixed_by_one_length"])
    if "truth" in summary:
        _truth(console, summary["truth"])
    _parameters(console, summary["parameters"])
    if summary["lengths"]:
        _lengths(console, summary["lengths"], fitted=summary["fixed_by_one_length"])
    _uncertainty(console, summary)
    _written(console, summary)


def _validated(console: Console, found: dict[str, Any] | None) -> None:
    """Cross-validation, before everything that was fitted."""
    if found is None:
        return
    title = f"\nCross-validated: each of {found['groups']} placements left out once [mm]"
    table = _table(title, "", "found", "predicted by u")
    table.add_row(
        "RMS distance of poses from their socket's centroid", _number(found["rms_mm"]), _number(found["rms_predicted_mm"])
    )
    table.add_row("RMS error of reference lengths", _number(found["length_error_rms_mm"]), _number(found["length_u_mm"]))
    console.print(table)


def _uncertainty(console: Console, summary: dict[str, Any]) -> None:
    """What the uncertainties rest on, and what they come to over the volume, expanded to 95 %."""
    found = summary["uncertainty"]
    volume, factor = found["volume"], found["coverage_factor_95"]
    title = f"\nExpanded uncertainty U over the working volume (95 %, coverage factor {factor:.2f}) [mm]"
    table = _table(title, "", "median", "95th percentile", "largest")
    length = f"{volume['length_mm']:g} mm length"
    for key, text in (
        ("u_tip", "tip position, along its worst direction: from the calibration"),
        ("u_length", f"{length}: from the calibration"),
        ("u_length_reading", f"{length}: with the noise of both readings"),
    ):
        values = [volume[f"{key}_{which}_mm"] for which in ("median", "95", "largest")]
        table.add_row(text, *("not determined" if value is None else _number(factor * value) for value in values))
    console.print(table)
    console.print("At 400 places that random poses reach within the joint limits; u of the parameters carries over to them.")
    encoder = found["encoder_arcsec"]
    told = ", ".join(f"{x:.3g}" for x in encoder) if isinstance(encoder, list) else f"{encoder:.3g}"
    noise = f"encoders {told} arcsec, seat {1e3 * found['seating_mm']:.3g} um"
    source = {
        "given": f"Noise as given: {noise}; residuals are {found['misfit'] or 0:.2f} times what it predicts.",
        "estimated": f"Noise estimated from the residuals: {noise} (their sum is better known than each).",
        "common": f"One variance for all poses: {1e3 * found['seating_mm']:.3g} um a coordinate.",
        "robust": "Each pose's own residual stands for its error (robust form).",
    }[found["form"]]
    pairs = [f"{row['one']} with {row['other']} ({row['r']:+.3f})" for row in found["correlated"][:6]]
    console.print(source + (f" Strongly correlated: {', '.join(pairs)}." if pairs else ""), soft_wrap=False)
    o = found["indices"]
    console.print(
        f"Observability: rank {found['rank']} of {found['parameters']}, condition {found['condition'] or math.inf:.3g}, "
        + ", ".join(f"{name} = {o[name]:.3g}" for name in o)
    )
    if summary["monte_carlo"]:
        console.print(f"Monte Carlo (JCGM 101): {summary['monte_carlo']}")


def demo(summary: dict[str, Any]) -> None:
    """The demonstration: before, stage 1 and stage 2 against the truth."""
    console = _console()
    console.print(
        f"The simulated arm of Cheng et al. 2018, off by up to {summary['deviation_mm']:g} mm and {summary['deviation_deg']:g} deg, "
        f"measured with {summary['encoder_arcsec']:g} arcsec and {summary['seating_um']:g} um of noise:\n{summary['poses']} poses in one "
        f"socket, {summary['more_poses']} in another (stage 1), between them one length of {summary['length_mm']:.4f} mm with u = {summary['length_u_um']:g} um (stage 2)."
    )
    table = _table("", "against the truth", "before", "stage 1", "stage 2")
    for key, text, factor in (
        ("de_mm", "DE, mean distance from centroid [mm]", 1.0),
        ("deltam_mm", "Deltam, largest half range [mm]", 1.0),
        *_TRUTH,
        ("check_rms_mm", f"RMS error of {summary['checks']} lengths of {summary['check_length_mm']:g} mm [mm]", 1.0),
    ):
        table.add_row(escape(text), *(_number(factor * summary[stage][key]) for stage in ("nominal", "stage1", "calibrated")))
    console.print(table)
    console.print(
        f"k = {summary['scale_k']:.7f}, u(k) = {summary['scale_u']:.1e}: stage 1 sees repeatability only and leaves every length "
        "off by this one factor; stage 2 divides it out."
    )
    console.print(f"Files in {escape(summary['folder'])}: {', '.join(escape(name) for name in summary['files'])}")


def _stages(console: Console, title: str, figures: dict[str, Any], stages: tuple[str, ...], *, fitted: bool = False) -> None:
    names = {"nominal": "nominal", "stage1": "stage 1", "calibrated": "calibrated"}
    table = _table(title, "", *(names[stage] for stage in stages))
    for key, text in _FIGURES:
        if key in figures[stages[0]]:
            cells = [_number(figures[stage][key]) for stage in stages]
            table.add_row(escape(text), *cells[:-1], "by fit" if fitted and key.startswith("length") else cells[-1])
    console.print(table)


def _truth(console: Console, truth: dict[str, Any]) -> None:
    stages = ("nominal", "stage1", "calibrated")
    table = _table("\nAgainst the true arm of the simulation", "", "nominal", "stage 1", "calibrated")
    for key, text, factor in _TRUTH:
        table.add_row(escape(text), *(_number(factor * truth[stage][key]) for stage in stages))
    console.print(table)


def _warnings(console: Console, summary: dict[str, Any]) -> None:
    for warning in summary["warnings"]:
        console.print(f"[yellow]Warning:[/yellow] {escape(warning)}")


def _parameters(console: Console, rows: list[dict[str, Any]]) -> None:
    """Every parameter in its own unit, to the digits that its standard uncertainty allows (two of the uncertainty's)."""
    table = _table(
        "\nParameters, with standard uncertainty u", "parameter", "unit", "nominal", "calibrated", "change", "u", "bound"
    )
    for row in rows:
        factor, unit = (1.0, "mm") if row["unit"] == "mm" else (180 / math.pi, "deg")
        nominal, value = factor * row["nominal"], factor * row["calibrated"]
        u = None if row["u"] is None else factor * row["u"]
        decimals = 4 if u is None else min(max(1 - math.floor(math.log10(u)), 0), 9) if u > 0 else 9
        numbers = (
            f"{nominal:.4f}",
            f"{value:.{decimals}f}",
            f"{value - nominal:+.{decimals}f}",
            "-" if u is None else f"{u:.{decimals}f}",
        )
        table.add_row(row["parameter"], unit, *numbers, row["bound"] or "")
    console.print(table)


def _lengths(console: Console, rows: list[dict[str, Any]], *, fitted: bool = False) -> None:
    """Reference lengths; the error of a single one that fixed the scale is not shown, since it is zero by construction."""
    table = _table("\nReference lengths", "between", "value [mm]", "measured [mm]", "error [mm]", "u of error [mm]")
    for row in rows:
        error = "fixed the scale" if fitted else _number(row["error_mm"])
        table.add_row(
            escape(f"{row['from']} - {row['to']}"),
            _number(row["value_mm"]),
            _number(row["measured_mm"]),
            error,
            _number(row["error_u_mm"]),
        )
    console.print(table)


def _verdicts(console: Console, summary: dict[str, Any]) -> None:
    """Limits kept, and limits exceeded."""
    for sentence in summary["kept"]:
        console.print(f"[green]Passed:[/green] {escape(sentence)}")
    for sentence in summary["failed"]:
        console.print(f"[red]Failed:[/red] {escape(sentence)}")


def _written(console: Console, summary: dict[str, Any]) -> None:
    if "written" in summary:
        console.print(f"\nWritten: {escape(summary['written'])}")
