"""The section that shows where in the volume, and in the travel of the joints, the calibration was never tried."""

import math

import numpy as np

from ..calibration.record import CalibrationRecord
from ..core.units import DEG
from ..diagnostics.tried_poses import TriedPoses, tried_poses
from ..kinematics.arm import joint_limits
from ..summaries.tables import two_digits
from ..summaries.uncertainty_sentences import tried_sentence
from ..uncertainty.volume import VolumetricUncertainty
from . import charts
from .elements import Chart, ReportTable, Section, number_cell, text_cell

_TIPS = 400  # most tips of the calibration that are drawn
_FULL_TURN = 360.0


def tried_sections(record: CalibrationRecord, volume: VolumetricUncertainty) -> list[Section]:
    """Where the calibration was never tried."""
    readings = np.asarray(record.recording.capture.readings)
    if len(readings) < 2:
        return []
    found = tried_poses(record.calibrated.arm, readings, volume.q)
    summary = {"poses": len(found.distance), "tried": int(found.tried.sum()), "spacing_rad": found.spacing}
    blocks = [tried_sentence(summary) + _u_within(volume, found), _section_view(record, volume, found)]
    return [Section("tried", "Where the calibration was never tried", [*blocks, _joints(record, readings)])]


def _u_within(volume: VolumetricUncertainty, found: TriedPoses) -> str:
    medians = [float(np.median(volume.expanded_tip[part])) for part in (found.tried, ~found.tried) if np.any(part)]
    if len(medians) < 2 or not all(map(math.isfinite, medians)):
        return ""
    near, far = map(two_digits, medians)
    return f" The median U of a tip is {near} mm where it was tried and {far} mm elsewhere."


def _section_view(record: CalibrationRecord, volume: VolumetricUncertainty, found: TriedPoses) -> Chart:
    """Half a section through the volume: random poses by their distance from the nearest calibrated one."""
    ratio = found.distance / max(found.spacing, 1e-12)
    shade, limits = shades(ratio)
    radius, height = np.hypot(volume.start[:, 0], volume.start[:, 1]), volume.start[:, 2]
    hover = [
        f"({', '.join(f'{x:.0f}' for x in point)}) mm: {distance / DEG:.0f} deg from the nearest pose, {times:.1f} "
        "times their spacing"
        for point, distance, times in zip(volume.start, found.distance, ratio, strict=True)
    ]
    order = np.argsort(shade, kind="stable")
    tips = np.asarray(record.calibrated.arm.position(np.asarray(record.recording.capture.readings)))
    tips = tips[np.linspace(0, len(tips) - 1, min(len(tips), _TIPS)).round().astype(int)]
    across = np.hypot(tips[:, 0], tips[:, 1])
    marks = (
        charts.Marks("", radius[order], height[order], hover=[hover[i] for i in order], shade=shade[order], size=5),
        charts.Marks("tips of the calibration", across, tips[:, 2], "square", "accent", size=4),
    )
    x = charts.linear("distance from the first axis [mm]", radius, across, [0.0])
    plot = charts.Plot(x, charts.linear("height [mm]", height, tips[:, 2]), marks, height=380)
    description = (
        "Random poses all over the volume by their distance in joint space from the nearest pose of the calibration, "
        "in multiples of the spacing of its own poses: up to 1 it was tried there; the larger the mark, the less."
    )
    return Chart("tried", "Where it was tried", description, (plot,), shade_limits=limits)


def shades(ratio: np.ndarray) -> tuple[np.ndarray, tuple[float, ...]]:
    """The shade of each multiple of the spacing: the first ends at 1, the others divide what is beyond."""
    beyond = ratio > 1.0
    if np.all(beyond) or not np.any(beyond):
        return charts.shades(ratio)
    shade, limits = charts.shades(ratio[beyond], charts.SHADES - 1)
    found = np.zeros(len(ratio), dtype=int)
    found[beyond] = shade + 1
    return found, (0.0, 1.0, *limits[1:])


def _joints(record: CalibrationRecord, readings: np.ndarray) -> Chart:
    """The readings of each joint within its limits."""
    arm = record.calibrated.arm
    slides = [joint + 1 in arm.prismatic for joint in range(arm.joints)]
    units = np.where(slides, 1.0, DEG)
    limits = np.asarray(joint_limits(arm, None)) / units[:, None]
    shown = readings[:, : arm.joints] / units
    chosen = np.linspace(0, len(shown) - 1, min(len(shown), _TIPS)).round().astype(int)
    used = np.array([_share(shown[:, i], limits[i], slides[i]) for i in range(arm.joints)])
    low, high = shown.min(axis=0), shown.max(axis=0)
    rows = [
        [
            number_cell(i + 1, 0),
            text_cell("mm" if slides[i] else "deg"),
            *(number_cell(float(x), 1) for x in (*limits[i], low[i], high[i])),
            number_cell(100 * float(used[i]), 0),
        ]
        for i in range(arm.joints)
    ]
    columns = (
        "joint",
        "unit",
        "lowest limit",
        "highest limit",
        "lowest reading",
        "highest reading",
        "travel tried [%]",
    )
    x = np.arange(arm.joints)
    marks = (
        charts.Marks("travel", x, limits.mean(axis=1), "bars", "soft", low=limits[:, 0], high=limits[:, 1], size=14),
        charts.Marks(
            "readings of the calibration", np.repeat(x, len(chosen)), shown[chosen].T.ravel(), "square", "main", size=3
        ),
    )
    title = "reading [deg]" + (" or [mm]" if any(slides) else "")
    axes = charts.names("", [f"joint {i + 1}" for i in range(arm.joints)]), charts.linear(title, limits, shown)
    description = "The travel of each joint within its limits, and the readings of the calibration in it."
    plot = charts.Plot(*axes, marks, height=260)
    return Chart("travel", "Travel of the joints", description, (plot,), ReportTable("Travel by joint", columns, rows))


def _share(readings: np.ndarray, limits: np.ndarray, slides: bool) -> float:
    """The part of a joint's travel, in twentieths, that has readings; the full turn of a joint without limits."""
    low, high = limits if slides else (limits[0], min(limits[1], limits[0] + _FULL_TURN))
    around = readings if slides else (readings - low) % _FULL_TURN + low
    counts, _ = np.histogram(around, 20, (low, high))
    return float(np.mean(counts > 0))
