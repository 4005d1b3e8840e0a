"""Figures: the paper's 2, 3, 6 and 8 as far as its text defines them, its scale law, and others; legible in grey."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import paper_method
from paper import PUBLISHED, is_length, tips_of, vector
from table1 import many_of

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Table = list[dict[str, Any]]
STYLE = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "0.88",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}
DARK, MIDDLE, LIGHT = "0.05", "0.45", "0.72"
MARKS = (("o", DARK), ("^", MIDDLE), ("s", LIGHT), ("D", "0.3"), ("v", "0.6"))


def column(table: Table, key: str) -> np.ndarray:
    return np.array([line[key] for line in table])


def joined_points(
    axes: Any, part: Table, x: str, y: str, mark: tuple[str, str], label: str, factor: float = 1.0
) -> None:
    """One series of a table, its points joined by a thin line."""
    style = {"color": mark[1], "markeredgecolor": DARK, "linewidth": 0.9, "label": label}
    axes.plot(column(part, x), factor * column(part, y), mark[0] + "-", **style)


def simulation(number: int) -> Any:
    """Figures 2 and 3: distance of every pose's tip from the centroid, by the paper's method and by this toolkit."""
    runs = [line for line in paper_method.stored() if line["simulation"] == number]
    typical = sorted(runs, key=lambda line: line["de_mm"])[len(runs) // 2]
    q, lower, upper, start = paper_method.problem(number, int(typical["set"]))
    values, _ = paper_method.minimise(q, lower, upper, start)
    mine = many_of(q[None], lower, upper, start[None]).parameters[0]
    figure, axes = plt.subplots(figsize=(4.6, 3.0))
    pairs = (("paper's method, rerun", values, *MARKS[0]), ("this toolkit", mine, *MARKS[2]))
    for name, found, marker, colour in pairs:
        tips = tips_of(found[None], q[None])[0]
        distance = np.linalg.norm(tips - tips.mean(axis=0), axis=1)
        axes.plot(
            np.arange(1, len(q) + 1), distance, marker, color=colour, markeredgecolor=DARK, markersize=3.5, label=name
        )
    axes.axhline(
        PUBLISHED["simulation"][str(number)]["de"],
        color=DARK,
        linestyle="--",
        linewidth=0.9,
        label="mean printed in the paper",
    )
    axes.set(
        xlabel=f"pose of simulation {number}, the set whose DE is the median",
        ylabel="distance from the centroid [mm]",
        yscale="log",
    )
    axes.legend(loc="center right", fontsize=7.5)
    return figure


def scale_law() -> Any:
    """Identified over true length, for the five that are not zero: a constant, which is k."""
    truth = vector("simulation", "nominal")
    chosen = is_length() & (truth != 0)
    figure, axes = plt.subplots(figsize=(4.6, 3.0))
    for (marker, colour), number in zip(MARKS, (1, 2), strict=False):
        values = vector("simulation", str(number), "identified")
        k = values[is_length()] @ truth[is_length()] / (truth[is_length()] @ truth[is_length()])
        axes.axhline(k, color=colour, linewidth=0.9, linestyle=("-", "--")[number - 1])
        axes.plot(
            truth[chosen],
            (values / np.where(chosen, truth, 1))[chosen],
            marker,
            color=colour,
            label=f"eq. {15 + number}, k = {k:.5f}",
        )
    axes.set(xlabel="true length [mm]", ylabel="identified / true length", xscale="log")
    axes.legend(loc="center right")
    return figure


def distributions(runs: Table) -> Any:
    """DE, Deltam and k of both simulations over the sets of poses; the printed values as lines."""
    stored = paper_method.stored()
    figure, grid = plt.subplots(2, 3, figsize=(7.0, 4.0))
    truth = vector("simulation", "nominal")
    for number, line in zip((1, 2), grid, strict=True):
        printed = PUBLISHED["simulation"][str(number)]
        values = vector("simulation", str(number), "identified")
        k = values[is_length()] @ truth[is_length()] / (truth[is_length()] @ truth[is_length()])
        theirs = [row for row in stored if row["simulation"] == number]
        for axes, key, mark, label in zip(
            line,
            ("de_mm", "deltam_mm", "k"),
            (printed["de"], printed["deltam"], k),
            ("DE [mm]", "Deltam [mm]", "k"),
            strict=True,
        ):
            sample = column(theirs, key)
            bins: Any = np.geomspace(sample.min(), sample.max(), 40) if key != "k" else 40
            axes.hist(sample, bins=bins, color=LIGHT, label="paper's method")
            if key == "k":
                mine = [row["k"] for row in runs if row["simulation"] == number]
                axes.hist(mine, bins=40, histtype="step", color=DARK, linewidth=0.9, label="this toolkit")
                axes.set_yscale("log")
                axes.legend(fontsize=6.5, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, columnspacing=0.8)
            else:
                axes.set_xscale("log")
            axes.axvline(mark, color=DARK, linestyle="--", linewidth=1.2)
            axes.set(xlabel=f"{label}, simulation {number}", ylabel="runs")
    return figure


def box_and_scale(table: Table) -> Any:
    """k against the boxes of the lengths: this toolkit by the shift of their centres (left), the paper's method
    by their width (right)."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.2), sharey=True, width_ratios=(1.5, 1))
    widths = sorted({line["half_width_mm"] for line in table})
    for i, ((marker, colour), width) in enumerate(zip(MARKS, widths, strict=True)):
        part = [line for line in table if line["half_width_mm"] == width]
        low, middle, high = (column(part, key) for key in ("k_low", "k_median", "k_high"))
        inside = column(part, "truth_inside") > 0
        x = column(part, "centre_shift_mm") + 0.22 * (i - 2)
        left.errorbar(x, middle, [middle - low, high - middle], fmt="none", ecolor=colour, elinewidth=1, capsize=2)
        left.plot(x[inside], middle[inside], marker, color=colour, markeredgecolor=DARK, label=f"±{width:g} mm")
        left.plot(x[~inside], middle[~inside], marker, markerfacecolor="white", markeredgecolor=colour)
    for (marker, colour), shift in zip(
        MARKS, sorted({line["centre_shift_mm"] for line in table if line["k_median_method"] > 0}), strict=False
    ):
        part = [line for line in table if line["centre_shift_mm"] == shift and line["truth_inside"]]
        low, middle, high = (column(part, f"k_{key}_method") for key in ("lowest", "median", "highest"))
        x = column(part, "half_width_mm") * (1 + 0.03 * np.sign(shift))
        label = f"shifted by {shift:g} mm" if shift else "on the truth"
        right.errorbar(
            x,
            middle,
            [middle - low, high - middle],
            fmt=marker,
            color=colour,
            markeredgecolor=DARK,
            elinewidth=1,
            capsize=2,
            label=label,
        )
    for axes in (left, right):
        axes.axhline(1, color=DARK, linewidth=0.8)
    left.set(
        xlabel="shift of the boxes' centre [mm] (open: the truth is outside)", ylabel="k: median, and 95 % or extremes"
    )
    right.set(xlabel="half-width [mm]", xscale="log", xticks=widths)
    right.xaxis.set_major_formatter(matplotlib.ticker.ScalarFormatter())
    right.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    left.legend(fontsize=6.5, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    right.legend(fontsize=7, loc="lower left")
    return figure


def repeatability(points: Table) -> Any:
    """Figure 6: coordinates of the 70 tips about the middle of their range after stage 1, in a typical twin."""
    figure, axes = plt.subplots(figsize=(4.6, 3.0))
    for (marker, colour), key in zip(MARKS, ("x_mm", "y_mm", "z_mm"), strict=False):
        values = 1e3 * column(points, key)
        values = values - (values.max() + values.min()) / 2  # Deltam is a half range
        style = {"color": colour, "markersize": 3.5, "markeredgecolor": DARK, "label": key[0]}
        axes.plot(np.arange(1, len(points) + 1), values, marker, **style)
    for side in (-1, 1):
        axes.axhline(side * 1e3 * PUBLISHED["experiment"]["deltam"], color=DARK, linestyle="--", linewidth=0.9)
    axes.set(xlabel="pose of a typical twin (dashed: the printed Deltam)", ylabel="deviation from mid-range [µm]")
    axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return figure


def plate(deviations: Table) -> Any:
    """Figure 8: the plate in 30 placements, in a typical twin, with the printed extremes."""
    check = PUBLISHED["verification"]
    figure, axes = plt.subplots(figsize=(4.6, 3.0))
    values = 1e3 * column(deviations, "deviation_mm")
    axes.vlines(column(deviations, "placement"), 0, values, color=MIDDLE, linewidth=0.9)
    axes.plot(column(deviations, "placement"), values, "o", color=DARK, markersize=4)
    for key in ("maximum", "minimum"):
        axes.axhline(1e3 * (check[key] - check["nominal"]), color=DARK, linestyle="--", linewidth=0.9)
    axes.axhline(0, color=DARK, linewidth=0.8)
    axes.set(xlabel="placement of the plate (dashed: the printed extremes)", ylabel="deviation from 300.0005 mm [µm]")
    return figure


def twins(table: Table) -> Any:
    """Where the printed numbers of the experiment lie among the twins."""
    table3, check = PUBLISHED["table3"], PUBLISHED["verification"]
    panels = (
        ("deltam_Data1_mm", table3["Data1"], "Deltam, Data1 [mm]"),
        ("deltam_Data2_mm", table3["Data2"], "Deltam, Data2 [mm]"),
        ("deltam_Data3_mm", table3["Data3"], "Deltam, Data3 [mm]"),
        ("plate_largest_mm", check["max_deviation"], "largest deviation on the plate [mm]"),
        ("plate_range_mm", check["range"], "range on the plate [mm]"),
        ("plate_two_rms_mm", check["two_rms"], "two RMS on the plate [mm]"),
    )
    figure, grid = plt.subplots(2, 3, figsize=(7.0, 3.8))
    for axes, (key, printed, label) in zip(grid.ravel(), panels, strict=True):
        values = column(table, key)
        axes.hist(values, bins=np.linspace(values.min(), values.max(), 48), color=LIGHT)
        axes.axvline(printed, color=DARK, linestyle="--", linewidth=1.2)
        axes.set(xlabel=label, ylabel="twins")
    grid[0, 0].legend(["printed"], handlelength=1.4)
    return figure


def stages(table: Table) -> Any:
    """RMS on the plate by procedure."""
    names = [key for key in table[0] if key != "twin"]
    figure, axes = plt.subplots(figsize=(5.6, 2.6))
    boxes = [column(table, name) for name in names]
    axes.boxplot(
        boxes,
        orientation="horizontal",
        tick_labels=names,
        whis=(2.5, 97.5),
        showfliers=False,
        medianprops={"color": DARK, "linewidth": 1.6},
    )
    axes.set(xscale="log", xlabel="RMS deviation on the plate [mm]; whiskers: 95 %")
    axes.invert_yaxis()
    return figure


def noise_and_box(table: Table) -> Any:
    """k by noise, every length free, for several boxes; and with a scale anchor."""
    figure, axes = plt.subplots(figsize=(4.6, 3.2))
    widths = sorted({line["half_width_mm"] for line in table})
    for (marker, colour), width in zip(MARKS, widths, strict=True):
        part = [line for line in table if line["half_width_mm"] == width]
        joined_points(axes, part, "encoder_arcsec", "k_median_free", (marker, colour), f"all free, ±{width:g} mm")
    anchored = [line for line in table if line["half_width_mm"] == widths[-1]]
    axes.plot(
        column(anchored, "encoder_arcsec"),
        column(anchored, "k_median_held"),
        "k--",
        linewidth=1.4,
        label=f"scale anchor $d_3$, ±{widths[-1]:g} mm",
    )
    axes.set(xlabel="encoder noise [arcsec]", ylabel="k of stage 1, median")
    axes.set_xscale("symlog", linthresh=0.1)
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def sockets_poses_lengths(table: Table) -> Any:
    """RMS of 300 mm lengths by poses, sockets and reference lengths."""
    lengths = sorted({line["lengths"] for line in table})
    figure, grid = plt.subplots(1, len(lengths), figsize=(7.0, 2.7), sharey=True)
    for axes, count in zip(grid, lengths, strict=True):
        for (marker, colour), sockets in zip(MARKS, sorted({line["sockets"] for line in table}), strict=False):
            part = [line for line in table if line["sockets"] == sockets and line["lengths"] == count]
            joined_points(
                axes, part, "poses", "rms_mm", (marker, colour), f"{sockets} socket{'s' * (sockets > 1)}", factor=1e3
            )
        axes.set(
            xlabel=f"poses in all; {count} reference length{'s' * (count > 1)}", xscale="log", xticks=[16, 32, 70, 140]
        )
        axes.xaxis.set_major_formatter(matplotlib.ticker.ScalarFormatter())
        axes.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
    grid[0].set(ylabel="RMS error of 300 mm lengths [µm]", ylim=(0, None))
    grid[0].legend(fontsize=7)
    return figure


def reference_lengths(table: Table) -> Any:
    """u of k by the length, the position and the standard uncertainty of the reference."""
    figure, grid = plt.subplots(1, 2, figsize=(7.0, 2.9), sharey=True)
    exact = [line for line in table if line["u_mm"] == 0]
    for (marker, colour), place in zip(MARKS, dict.fromkeys(line["place"] for line in exact), strict=False):
        part = [line for line in exact if line["place"] == place]
        joined_points(grid[0], part, "length_mm", "u_k", (marker, colour), place)
    worst = [line for line in table if line["place"] == "far, tangential"]
    for (marker, colour), u in zip(MARKS, sorted({line["u_mm"] for line in worst}), strict=False):
        part = [line for line in worst if line["u_mm"] == u]
        joined_points(grid[1], part, "length_mm", "u_k", (marker, colour), f"u = {1e3 * u:g} µm")
    for axes, what in zip(grid, ("exact, by position", "far, tangential"), strict=True):
        axes.set(xscale="log", yscale="log", xlabel=f"reference length [mm] ({what})", xticks=[50, 100, 200, 400])
        axes.xaxis.set_major_formatter(matplotlib.ticker.ScalarFormatter())
        axes.xaxis.set_minor_locator(matplotlib.ticker.NullLocator())
        axes.legend(fontsize=7)
    grid[0].set(ylabel="standard deviation of k")
    return figure


def draw(tables: dict[str, Table], folder: Path) -> dict[str, str]:
    """Every figure as PNG into the folder; file name -> what it shows."""
    figures: dict[str, Callable[[], Any]] = {
        "figure2": lambda: simulation(1),
        "figure3": lambda: simulation(2),
        "scale_law": scale_law,
        "distributions": lambda: distributions(tables["toolkit_1000_sets"]),
        "k_against_box": lambda: box_and_scale(tables["k_against_box"]),
        "figure6": lambda: repeatability(tables["figure6"]),
        "figure8": lambda: plate(tables["figure8"]),
        "twins": lambda: twins(tables["twins"]),
        "stages": lambda: stages(tables["stages"]),
        "noise_and_box": lambda: noise_and_box(tables["noise_and_box"]),
        "sockets_poses_lengths": lambda: sockets_poses_lengths(tables["sockets_poses_lengths"]),
        "reference_lengths": lambda: reference_lengths(tables["reference_lengths"]),
    }
    about = {
        "figure2": simulation, "figure3": simulation, "scale_law": scale_law, "distributions": distributions,
        "k_against_box": box_and_scale,
        "figure6": repeatability, "figure8": plate, "twins": twins, "stages": stages, "noise_and_box": noise_and_box,
        "sockets_poses_lengths": sockets_poses_lengths, "reference_lengths": reference_lengths,
    }  # fmt: skip
    for name, make in figures.items():
        with plt.rc_context(STYLE):
            figure = make()
            figure.savefig(folder / f"{name}.png", metadata={"Software": None})
            plt.close(figure)
    return {name: " ".join((function.__doc__ or "").split()) for name, function in about.items()}
