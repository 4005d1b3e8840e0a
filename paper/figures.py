"""Draws the figure of the paper: `python paper/figures.py` writes paper/held_out.png.

Each placement of two public captures of robots is held out once, and the arm is calibrated from the others:
repeatability of its sockets and errors of its certified lengths, with the nominal and with the calibrated arm.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import aacmm_jax as aj

HERE = Path(__file__).resolve().parent
CAPTURES = {"Franka Panda, 8 placements": "capture.toml", "KUKA iiwa 14, 3 placements": "kuka_14.toml"}
SERIES = {"nominal": "#808080", "calibrated": "#e07a3f"}


def held_out(manifest: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For both arms: the RMS distance from the centroid in each placement, and the error of its length, mm."""
    recording = aj.files.read_manifest(HERE.parent / "examples" / "mukca" / manifest)
    arm, capture = recording.nominal.arm, recording.capture
    tested = aj.cross_validate(arm, capture, recording.nominal.bounds(), undetermined="ignore")
    nominal = [aj.evaluate(arm, capture.select(f"{label.partition('/')[0]}/*")) for label in tested.labels]
    return {
        "nominal": (
            np.array([float(each.repeatability.rms) for each in nominal]),
            np.concatenate([np.abs(each.error) for each in nominal]),
        ),
        "calibrated": (
            np.array([float(group.rms) for group in tested.groups]),
            np.concatenate([np.abs(group.length_error) for group in tested.groups]),
        ),
    }


def main() -> None:
    """Both captures side by side; logarithmic, since calibration changes the errors tenfold and more."""
    figure = Figure(figsize=(7.2, 2.9), layout="constrained")
    for axes, (title, manifest) in zip(figure.subplots(1, 2, sharey=True), CAPTURES.items(), strict=True):
        for name, (rms, lengths) in held_out(manifest).items():
            place = np.arange(1, len(rms) + 1)
            axes.plot(place, rms, "o", color=SERIES[name], label=f"{name}: repeatability (RMS)")
            axes.plot(place, lengths, "x", color=SERIES[name], label=f"{name}: error of 50 mm")
            print(f"{title}, {name}: {np.sqrt(np.mean(rms**2)):.2f} mm RMS, {lengths.mean():.3f} mm on 50 mm")
        axes.set(title=title, xlabel="placement held out", yscale="log", xticks=place)
    figure.axes[0].set_ylabel("error [mm]")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(HERE / "held_out.png", dpi=150)


if __name__ == "__main__":
    main()
