"""Draws the figures of the pages as SVG, whose text is dark on light pages and light on dark ones.

``python docs/figures.py [NAME ...]``; by default all of them.
"""

import io
import json
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import aacmm_jax as aj

DOCS = Path(__file__).resolve().parent
EXAMPLES = DOCS.parent / "examples"
GREY, BLUE, ORANGE = "#808080", "#3f88c5", "#e07a3f"  # each has a contrast of 3 and more on white and on Furo's dark
# What is drawn in grey, text above all, takes the colour that is read best on the page.
COLOURS = """<style>
:root { --text: #4a4d54 }
@media (prefers-color-scheme: dark) { :root { --text: #c9cbd0 } }
</style>
"""
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SOCKETS = {"A": (400, 200, 300), "B": (700, 500, 500)}
MODELS = ("dh", "gravity", "harmonics=1", "gravity,harmonics=1", "functions", "gravity,functions")
STYLE: dict[Any, Any] = {
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "text.color": GREY,
    "axes.labelcolor": GREY,
    "axes.edgecolor": GREY,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 11,
    "svg.hashsalt": "aacmm_jax",
}


def _axes(height: float = 3.0) -> Axes:
    return Figure(figsize=(7.2, height), layout="constrained").subplots()


def _save(axes: Axes, name: str) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    text = drawn.getvalue().replace(GREY, "var(--text)").replace(" <defs>", COLOURS + " <defs>", 1)
    (DOCS / f"{name}.svg").write_text(text, encoding="utf-8")


def _capture(true: aj.Arm, seed: int, poses: dict[str, int]) -> aj.Capture:
    return aj.simulate(true, SOCKETS, poses=poses, lengths=[("A", "B", 0.002)], noise=NOISE, seed=seed)


def _paper() -> tuple[aj.Arm, aj.Parameters, aj.Bounds]:
    arm = aj.load_arm("cheng2018-simulation")
    space = aj.Parameters.free_of(arm)
    return arm, space, aj.Bounds.around(arm, space, length=10.0, angle=0.0175)


def _seen(arm: aj.Arm, capture: aj.Capture, geometry: Any = None) -> Any:
    """How an arm agrees with what was observed, in the geometry given, or in that which fits it best."""
    observed = aj.evaluate(arm, capture, geometry=geometry).observed
    assert observed is not None
    return observed


def before_and_after() -> None:
    """A real Panda: tips of one held-out placement, and RMS errors of eight; D-H parameters alone are calibrated."""
    recording = aj.files.read_manifest(EXAMPLES / "mukca" / "capture.toml")
    arm, capture, bounds = recording.nominal.arm, recording.capture, recording.nominal.bounds()
    places = dict.fromkeys(name.partition("/")[0] for name in capture.names)
    calibrated = {
        place: aj.calibrate(arm, capture.select(without=f"{place}/*"), bounds, method="joint").arm for place in places
    }

    def distances(by: Any, place: str) -> np.ndarray:
        tips = [np.asarray(by.position(np.asarray(q))) for n, q in capture.sockets.items() if n.startswith(place + "/")]
        return np.concatenate([tip - tip.mean(axis=0) for tip in tips])

    figure = Figure(figsize=(7.2, 2.6), layout="constrained")
    cloud, bars = figure.subplots(1, 2, width_ratios=(1, 1.7))
    shown = "mid_left"
    for label, by, colour, size in (("nominal", arm, ORANGE, 16), ("calibrated", calibrated[shown], BLUE, 9)):
        at = distances(by, shown)
        cloud.scatter(at[:, 0], at[:, 2], s=size, color=colour, label=label, alpha=0.85, linewidths=0)
    cloud.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal", xlim=(-20, 10), ylim=(-15, 15))
    cloud.set_title("Tips in two fixed sockets [mm]", fontsize=10)
    cloud.legend(loc="lower center", handletextpad=0.1, borderpad=0, ncols=2, columnspacing=0.8, fontsize=9)
    rms = np.array(
        [
            [np.sqrt((distances(by, place) ** 2).sum(axis=1).mean()) for by in (arm, calibrated[place])]
            for place in places
        ]
    )
    print({place: tuple(row.round(3)) for place, row in zip(places, rms, strict=True)})
    for column, (offset, colour) in enumerate(((-0.2, ORANGE), (0.2, BLUE))):
        drawn = bars.bar(np.arange(len(places)) + offset, rms[:, column], 0.38, color=colour)
        bars.bar_label(drawn, [f"{value:.1f}" if value > 1 else f"{value:.2f}" for value in rms[:, column]], fontsize=8)
    bars.set_xticks(
        np.arange(len(places)), [place.replace("_", "\n").replace("-", "\n") for place in places], fontsize=9
    )
    bars.set(yscale="log", ylim=(0.1, 30))
    bars.set_title("RMS error in placements held out [mm]", fontsize=10)
    bars.set_yticks((0.1, 1, 10), ("0.1", "1", "10"))
    _save(cloud, "before_and_after")


def scale() -> None:
    """k after stage 1 of forty captures, with all lengths free and with a scale anchor."""
    arm, space, bounds = _paper()
    errors: dict[str | None, list[float]] = {None: [], "longest": []}
    for seed in range(40):
        true = aj.perturbed_arm(space, length=1.0, angle=np.radians(0.1), seed=seed)
        capture = _capture(true, seed, {"A": 70, "B": 10})
        for hold, values in errors.items():
            scale_found = aj.identify(arm, capture, bounds, hold=hold).scale
            assert scale_found is not None
            values.append(float(scale_found.value))
    axes = _axes(2.6)
    for height, (hold, colour) in enumerate((("longest", BLUE), (None, ORANGE))):
        jitter = np.random.default_rng(0).uniform(-0.22, 0.22, 40)
        axes.plot(errors[hold], height + jitter, "o", color=colour, markersize=5, alpha=0.8)
    axes.axvline(1.0, color=GREY, linewidth=1)
    axes.set_yticks((0, 1), ("scale anchor d_3", "all lengths free"))
    axes.set(xlabel="k after stage 1 (1 is right)", ylim=(-0.5, 1.5))
    _save(axes, "explanation/scale")
    print({hold: (np.mean(values), np.min(values), np.max(values)) for hold, values in errors.items()})


def method() -> None:
    """Distances of the tips from their socket's centroid, by the nominal and the calibrated arm."""
    arm, space, bounds = _paper()
    true = aj.perturbed_arm(space, length=1.0, angle=np.radians(0.1), seed=1)
    capture = _capture(true, 1, {"A": 70, "B": 10})
    result = aj.calibrate(arm, capture, bounds)
    axes = _axes()
    for label, shown, colour, marker in (("nominal arm", arm, ORANGE, "o"), ("calibrated arm", result.arm, BLUE, "s")):
        tips = np.asarray(shown.position(np.asarray(capture.sockets["A"])))
        distance = np.linalg.norm(tips - tips.mean(axis=0), axis=1)
        axes.plot(
            np.arange(1, 71),
            distance,
            marker,
            color=colour,
            markersize=4,
            label=f"{label}: DE {distance.mean():.3g} mm",
        )
    axes.set(xlabel="pose in socket A", ylabel="distance from centroid [mm]", yscale="log")
    axes.legend(loc="center right")
    _save(axes, "explanation/method")


def uncertainty() -> None:
    """U of lengths over the volume for several numbers of poses."""
    arm, _, bounds = _paper()
    axes = _axes()
    for poses, style in ((15, ":"), (30, "-."), (60, "--"), (120, "-")):
        capture = _capture(arm, 3, {"A": poses // 2, "B": poses - poses // 2})
        result = aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE, shared_errors=False)
        of_result = aj.uncertainty_of(result)
        U = 1000 * np.sort(aj.volumetric_uncertainty(of_result, points=400).expanded_length)
        axes.plot(U, np.linspace(0, 100, len(U)), color=BLUE, linestyle=style, linewidth=2, label=f"{poses} poses")
    axes.set(xlabel="U (95 %) of a length of 300 mm [um]", ylabel="lengths below it [%]", xlim=(0, 80))
    axes.legend(loc="lower right")
    _save(axes, "explanation/uncertainty")


def random_splits() -> None:
    """RMS errors of the UR10's poses drawn at random, and of its other series, by model: means of three draws."""
    recording = aj.files.read_manifest(EXAMPLES / "ipa_ur10" / "positions.toml")
    (points,) = recording.capture.observations
    series_a = aj.files.read_manifest(EXAMPLES / "ipa_ur10" / "series_a.toml").capture
    nominal, bounds = recording.nominal.arm, recording.nominal.bounds()
    errors = np.zeros((len(MODELS), 2, 3))
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(points.q))
        taken, others = (aj.Capture({}, [], [points.select(rows)]) for rows in (order[:500], order[500:]))
        for i, model in enumerate(MODELS):
            result = aj.calibrate(nominal, taken, bounds, model=model)
            fitted = _seen(result.arm, taken).geometry
            errors[i, :, seed] = _seen(result.arm, others, fitted).rms[0], _seen(result.arm, series_a).rms[0]
    print(*zip(MODELS, errors.round(3).tolist(), strict=True), sep="\n")
    before = float(_seen(nominal, series_a).rms[0])
    axes, places = _axes(3.4), np.arange(len(MODELS))
    for part, (offset, colour, label) in enumerate(
        ((-0.2, BLUE, "other poses of C, drawn at random"), (0.2, ORANGE, "series A"))
    ):
        mean = errors[:, part].mean(axis=1)
        reached = np.stack([mean - errors[:, part].min(axis=1), errors[:, part].max(axis=1) - mean])
        axes.bar(places + offset, mean, 0.38, color=colour, label=label, yerr=reached, ecolor=GREY, capsize=3)
    axes.axhline(before, color=GREY, linestyle="--", linewidth=1)
    axes.set_xticks(places, [model.replace(",", ",\n") for model in MODELS])
    axes.set(ylabel="RMS error [mm]", ylim=(0, 1.35))
    axes.legend(loc="upper center", ncols=2)
    _save(axes, "explanation/random_splits")


def planned_poses() -> None:
    """What `benchmarks/planned_poses.py` has stored: U of a length against the number of poses."""
    stored = json.loads((DOCS.parent / "benchmarks" / "results" / "planned_poses.json").read_text(encoding="utf-8"))
    ((rows,),) = stored.values()
    axes = _axes(3.6)
    for name, colour, marker in (("random", ORANGE, "o"), ("planned", BLUE, "s")):
        for what, line in (("largest", "-"), ("median", "--")):
            values = [2e-3 * u for u in rows[f"{name}, {what}"]]  # U in mm, of u in um
            axes.plot(
                rows["poses"], values, line, color=colour, marker=marker, markersize=4, label=f"{name} poses, {what}"
            )
    axes.set(xlabel="poses", ylabel="U (k = 2) of a length of 300 mm [mm]", xscale="log", yscale="log")
    axes.set_xticks(rows["poses"], [str(poses) for poses in rows["poses"]])
    ticks = (0.008, 0.012, 0.02, 0.03, 0.04, 0.06, 0.1)
    axes.set_yticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.legend()
    _save(axes, "planned_poses")


def main() -> None:
    """Draw those that are named."""
    every = {
        draw.__name__: draw for draw in (before_and_after, method, scale, uncertainty, random_splits, planned_poses)
    }
    with matplotlib.rc_context(STYLE):
        for name in sys.argv[1:] or every:
            every[name]()


if __name__ == "__main__":
    main()
