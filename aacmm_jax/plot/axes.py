"""Figures alone, for papers (matplotlib): each draws into the axes that it is given, or into new ones, and returns them.

None touches matplotlib's global state; save one with ``axes.figure.savefig("name.pdf")``. All are readable in grey.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..acceptance.metrics import AcceptanceTest
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..files.whole_file import whole_file
from ..kinematics.arm import Arm, is_length
from ..model.measurement import Measurement
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.identifiability import Observability
from ..uncertainty.volume import VolumetricUncertainty
from .drift import plot_changes as plot_changes
from .drift import trend as trend

if TYPE_CHECKING:
    from ..study.results import Results

_ARCSEC = 3600 * 180 / math.pi
_DARK, _WARM, _LIGHT = "#1b3a6b", "#d95f02", "0.65"
_STAGES: Mapping[str, Mapping[str, Any]] = {
    "nominal": {"label": "as found", "color": _LIGHT, "marker": "o"},
    "stage1": {"label": "after stage 1", "color": _WARM, "marker": "^"},
    "calibrated": {"label": "as left", "color": _DARK, "marker": "s"},
}


def distances(record: CalibrationRecord, axes: Any = None) -> Any:
    """Distance of every pose's tip from its socket's centroid, as found and as left, mm on a logarithmic axis."""
    axes = _axes(axes)
    measurement = Measurement.of(record.recording.capture)
    for stage, arm in (("nominal", record.recording.nominal.arm), ("calibrated", record.calibrated.arm)):
        tips = arm.position(measurement.q)
        away = np.linalg.norm(np.asarray(measurement.centred(tips)), axis=1)
        style = {**_STAGES[stage]} | {"label": f"{_STAGES[stage]['label']} (mean {away.mean():.3g} mm)"}
        axes.plot(np.arange(1, len(away) + 1), away, linestyle="none", markersize=3.5, **style)
    sizes = record.recording.capture.sizes
    for border in np.cumsum(sizes)[:-1] if len(sizes) <= 40 else ():
        axes.axvline(border + 0.5, color="0.3", linewidth=0.8, linestyle="--", zorder=0)
    axes.set_yscale("log")
    _titled(
        axes, "pose (dashed lines separate sockets)" if len(sizes) > 1 else "pose", "distance from the socket's centroid [mm]"
    )
    axes.legend(loc="center right", framealpha=1, edgecolor="none")
    return axes


def length_parameter_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Error of every length parameter against the true arm of a simulation, by stage, mm."""
    if record.recording.true is None:
        raise InputError("the calibration is not of a simulation, so no true arm is known to draw errors against.")
    axes = _axes(axes)
    vectors = record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name)]
    for stage, style in _STAGES.items():
        error = np.abs(vectors[stage] - vectors["true"])[chosen]
        axes.plot(np.arange(len(chosen)), np.maximum(error, 1e-5), linestyle="none", markersize=5, **style)
    axes.set_yscale("log")
    axes.set_xticks(np.arange(len(chosen)), [record.names[i] for i in chosen], rotation=60, ha="right")
    _titled(axes, "", "error against the true arm [mm]")
    axes.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return axes


def parameter_changes(record: CalibrationRecord, kind: str = "length", axes: Any = None) -> Any:
    """Change of the length (mm) or angle (arcsec) parameters from nominal, with expanded uncertainties (95 %)."""
    if kind not in ("length", "angle"):
        raise InputError(f"kind is '{kind}'; it must be length or angle.")
    axes = _axes(axes)
    uncertainty, vectors = uncertainty_of(record), record.vectors()
    chosen = [i for i, name in enumerate(record.names) if is_length(name) == (kind == "length")]
    scale = 1.0 if kind == "length" else _ARCSEC
    change = scale * (vectors["calibrated"] - vectors["nominal"])[chosen]
    expanded = scale * uncertainty.factor() * np.asarray(uncertainty.u)[chosen]
    known = np.isfinite(expanded)
    bars = np.where(known, expanded, 0.0)
    axes.axhline(0, color="0.4", linewidth=0.8)
    axes.errorbar(
        np.arange(len(chosen)), change, yerr=bars, fmt="o", color=_DARK, capsize=3, markersize=4, label="with U (95 %)"
    )
    if not np.all(known):
        axes.plot(np.flatnonzero(~known), change[~known], "x", color=_WARM, markersize=8, label="only determined with others")
    axes.set_xticks(np.arange(len(chosen)), [record.names[i] for i in chosen], rotation=60, ha="right")
    _titled(axes, "", f"as left - as found [{'mm' if kind == 'length' else 'arcsec'}]")
    axes.legend(frameon=False)
    return axes


def length_errors(record: CalibrationRecord, axes: Any = None) -> Any:
    """Errors of the reference lengths before and after the scale fix, mm, with expanded uncertainty (95 %)."""
    if not record.recording.capture.lengths:
        raise InputError("the calibration has no reference lengths, so there are no errors of lengths to draw.")
    axes = _axes(axes)
    evaluations = record.evaluations()
    names = [f"{length.start} - {length.end}" for length in record.recording.capture.lengths]
    places = np.arange(len(names))
    factor = uncertainty_of(record).factor()
    style = _STAGES["stage1"]
    axes.plot(places - 0.1, np.asarray(evaluations["stage1"].error), linestyle="none", **style)
    u = np.asarray(evaluations["calibrated"].u)
    left = _STAGES["calibrated"]
    axes.errorbar(
        places + 0.1, np.asarray(evaluations["calibrated"].error), yerr=np.where(np.isfinite(u), factor * u, 0.0),
        fmt=left["marker"], color=left["color"], capsize=3, markersize=4, label="as left, with U (95 %)",
    )  # fmt: skip
    axes.axhline(0, color="0.4", linewidth=0.8)
    axes.set_xticks(places, names if len(names) <= 20 else [str(i + 1) for i in places], rotation=60, ha="right")
    _titled(axes, "", "measured - value [mm]")
    axes.legend(frameon=False)
    return axes


def arm(arm: Arm, q: Numbers, axes: Any = None) -> Any:
    """The arm in poses ``(m, n)`` (rad) as lines in space, mm; the first is drawn dark. ``axes`` must be three-dimensional."""
    from ..kinematics.workspace import skeleton

    if axes is None:
        from matplotlib.figure import Figure

        axes = Figure(figsize=(6, 5.4), layout="constrained").add_subplot(projection="3d")
    elif getattr(axes, "name", "") != "3d":
        raise InputError("an arm is drawn in space; give axes made with projection='3d'.")
    poses = np.atleast_2d(np.asarray(arm._checked(q)))
    for number, line in reversed(list(enumerate(skeleton(arm, poses)))):
        style = (
            {"color": _DARK, "linewidth": 3, "marker": "o", "markersize": 4}
            if number == 0
            else {"color": _LIGHT, "linewidth": 0.8}
        )
        axes.plot(*line.T, **style)
    tips = np.asarray(arm.position(poses))
    axes.plot(*tips.T, linestyle="none", marker="+", color=_WARM, markersize=8)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", zlabel="z [mm]")
    axes.set_aspect("equal")
    return axes


def volume(volume: VolumetricUncertainty, factor: float = 2.0, axes: Any = None) -> Any:
    """Expanded uncertainty of lengths over the volume: larger and darker marks, at the height and distance from the first axis where each starts."""
    axes = _axes(axes)
    expanded = factor * volume.u_length
    known = np.isfinite(expanded)
    if not np.any(known):
        raise InputError("no length over the volume is determined, so there is no uncertainty to draw.")
    radius = np.hypot(volume.start[:, 0], volume.start[:, 1])
    share = expanded[known] / expanded[known].max()
    drawn = axes.scatter(
        radius[known],
        volume.start[known, 2],
        s=8 + 60 * share**2,
        c=expanded[known],
        cmap="Blues",
        vmin=0,
        edgecolors="0.4",
        linewidths=0.4,
    )
    axes.figure.colorbar(drawn, ax=axes, label=f"U of a {volume.length:g} mm length [mm]")
    _titled(axes, "distance from the first axis [mm]", "height [mm]")
    return axes


def correlation(uncertainty: Uncertainty, axes: Any = None) -> Any:
    """Correlations of the parameters: darker is stronger, and the sign stands where it is at least 0.5."""
    axes = _axes(axes)
    table, names = np.asarray(uncertainty.correlation), uncertainty.names
    drawn = axes.imshow(np.abs(table), cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(np.arange(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(np.arange(len(names)), names, fontsize=7)
    for i, j in np.argwhere(np.abs(table) >= 0.5):
        if i != j:
            axes.text(
                j, i, "+" if table[i, j] > 0 else "-", ha="center", va="center", color="w" if abs(table[i, j]) > 0.7 else "k"
            )
    axes.figure.colorbar(drawn, ax=axes, label="|r|", shrink=0.8)
    return axes


def singular_values(seen: Observability, axes: Any = None) -> Any:
    """Singular values of what the data determine, natural steps (1 mm, 1 mrad); those that count as zero are crosses."""
    axes = _axes(axes)
    values = np.maximum(seen.singular, 1e-12 * seen.singular.max())
    places, rank = np.arange(1, len(values) + 1), seen.rank
    axes.plot(places[:rank], values[:rank], "o", color=_DARK, label="determined")
    if rank < len(values):
        axes.plot(places[rank:], values[rank:], "x", color=_WARM, label="not determined")
        axes.legend(frameon=False)
    axes.set_yscale("log")
    _titled(axes, "number", "singular value")
    return axes


def acceptance(tests: Sequence[AcceptanceTest], axes: Any = None) -> Any:
    """The worst value of every figure with a limit, as a share of it, with U: it conforms where the whole bar lies below 1."""
    figures = [figure for test in tests for figure in test.metrics if figure.worst.limit]
    if not figures:
        raise InputError("no figure has a limit to be drawn against; give limits to accept.")
    axes = _axes(axes)
    shares, bars = zip(
        *((abs(f.value) / (f.worst.limit or 1), f.worst.expanded / (f.worst.limit or 1)) for f in figures), strict=True
    )
    places = np.arange(len(figures))
    axes.errorbar(places, shares, yerr=bars, fmt="s", color=_DARK, capsize=4)
    axes.axhline(1, color="0.2", linewidth=1)
    axes.set_xticks(places, [f"{figure.name}\n{figure.decision}" for figure in figures])
    axes.set_xlim(-0.6, len(figures) - 0.4)
    axes.set_ylim(0, max(1.2, 1.1 * max(share + bar for share, bar in zip(shares, bars, strict=True))))
    _titled(axes, "", "|value| / MPE")
    return axes


def study(results: "Results", figure: str = "length_error", axes: Any = None) -> Any:
    """One figure of a study in every cell: median, and from the 5th to the 95th percentile of the converged trials."""
    from ..study.statistics import METRICS

    if figure not in METRICS:
        raise InputError(f"a study has no figure '{figure}'; choose one of {', '.join(METRICS)}.")
    axes = _axes(axes)
    cells = range(len(results.study.cells))
    scale, unit = (_ARCSEC, " [arcsec]") if figure.startswith("angle") else (1.0, "" if figure[0] in "ks" else " [mm]")
    for cell in cells:
        values = results.column(figure, cell)[results.column("converged", cell) == 1]
        values = scale * values[np.isfinite(values)]
        if len(values):
            low, middle, high = np.percentile(values, (5, 50, 95))
            axes.errorbar(cell + 1, middle, yerr=[[middle - low], [high - middle]], fmt="s", color=_DARK, capsize=4)
    axes.set_xticks([cell + 1 for cell in cells] if len(cells) <= 30 else axes.get_xticks())
    _titled(axes, "cell", METRICS[figure] + unit)
    return axes


def _axes(axes: Any) -> Any:
    if axes is not None:
        return axes
    from matplotlib.figure import Figure

    return Figure(figsize=(6.4, 4.2), layout="constrained").subplots()


def _titled(axes: Any, x: str, y: str) -> None:
    axes.set(xlabel=x, ylabel=y)
    axes.grid(True, which="major", alpha=0.3)


def calibration_figure(record: CalibrationRecord, path: Path) -> None:
    """Distances from the centroid pose by pose and, where the truth is known, errors of the length parameters; as PNG."""
    from matplotlib.figure import Figure

    panels = 2 if record.recording.true is not None else 1
    figure = Figure(figsize=(5.5 * panels, 3.9), layout="constrained")
    axes = figure.subplots(1, panels, squeeze=False)
    distances(record, axes[0, 0])
    if panels == 2:
        length_parameter_errors(record, axes[0, 1])
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=150)
