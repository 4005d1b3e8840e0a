"""Cameras in sentences and tables, made of the rows of a summary."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ..core.text import pluralise, shorten
from ..core.units import DEG
from ..uncertainty.coverage import U_AT_LEVEL
from .tables import Table, decimals_for, format_number, listed, number

_MOST_REFUSED = 6
_FACTOR = "coverage_factor_geometry_95"


def images_words(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """How many images of each observation are used, and why the others are not."""
    for row in rows:
        fewest, most = row["fewest_corners"], row["most_corners"]
        corners = f"{fewest} to {most}" if fewest < most else str(most)
        images = pluralise(row["images"], "image")
        yield f"{row['observation']}: {row['used']} of {images} used, with {corners} corners."
        refused = [f"{image['image']} ({image['reason']})" for image in row["refused"]]
        if refused:
            yield f"Images not used: {shorten(refused, _MOST_REFUSED)}."


def camera_view(summary: Mapping[str, Any]) -> Iterator[str | Table]:
    """What people look for in a calibration with a camera: mount, place of the target, reprojection, intrinsics."""
    rows, factor = summary.get("cameras") or [], summary["uncertainty"][_FACTOR]
    if not rows:
        return
    for row in rows:
        at_target = f", {row['reprojection_rms_mm']:.3g} mm at the target" if row["unit"] == "px" else ""
        yield (
            f"{row['camera']} sees {row['target']}: reprojection error {row['reprojection_rms']:.3g} {row['unit']} RMS"
            f"{at_target} ({pluralise(row['corners'], 'corner')} in {pluralise(row['images'], 'image')}, "
            f"{row['distance_mm']:.0f} mm away)."
        )
    yield mounts_table(rows, factor)
    yield from _definitions(rows)
    intrinsics = intrinsics_table(rows, factor)
    if intrinsics.rows:
        yield intrinsics


def _definitions(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """What mounts and places are relative to, where parameters that a camera cannot tell from them are held."""
    frames = {row[kind]["of"]: (kind, row[kind]) for row in rows for kind in ("place", "mount")}
    frames = {of: (kind, frame["defined_by"]) for of, (kind, frame) in frames.items() if frame["defined_by"]}
    if frames:
        held = [f"the {kind} of {of} from {' and '.join(names)}" for of, (kind, names) in frames.items()]
        yield (
            f"A camera cannot separate {' or '.join(held)}. These parameters are held at their nominal values, and U "
            "does not contain their errors."
        )
    if frames and not any(row["tip_seen"] for row in rows):
        yield (
            "No observation shows the tip. Its place in the last frame (probe) is nominal, and U does not contain the "
            "error of that; touch a socket in several poses to determine it."
        )


def shown_apart(summary: Mapping[str, Any]) -> list[Any]:
    """The parts of the geometry that the tables of cameras do not show."""
    names = {name for row in summary.get("cameras") or [] for name in (row["camera"], row["target"])}
    said = {
        f"{what} of {name}"
        for what in ("frame", "offset", "orientation", "intrinsics", "free intrinsics")
        for name in names
    }
    return [row for row in summary["geometry"] if row["part"] not in said]


def mounts_table(rows: Sequence[Mapping[str, Any]], factor: float) -> Table:
    """Where cameras and targets are, with U in the worst direction and about the worst axis."""
    places = {(kind, row[kind]["of"]): row[kind] for row in rows for kind in ("mount", "place")}

    def position(row: Mapping[str, Any]) -> str:
        decimals = decimals_for(_times(factor, row["position_u_mm"]))
        return ", ".join(format_number(x, decimals) for x in row["position_mm"])

    def rotation(row: Mapping[str, Any]) -> str:
        decimals = decimals_for(_times(factor / DEG, row["rotation_u_rad"]))
        return ", ".join(format_number(x / DEG, decimals) for x in row["roll_pitch_yaw_rad"])

    return listed("Cameras and targets (U in the worst direction and about the worst axis)", places.values(), {
        "frame": "of",
        "in": "in",
        "position [mm]": position,
        f"{U_AT_LEVEL} [mm]": lambda row: _u(factor, row["position_u_mm"]),
        "roll, pitch, yaw [deg]": rotation,
        f"{U_AT_LEVEL} [deg]": lambda row: _u(factor / DEG, row["rotation_u_rad"]),
    })  # fmt: skip


def intrinsics_table(rows: Sequence[Mapping[str, Any]], factor: float) -> Table:
    """Intrinsics of each camera with U."""
    cameras = {row["camera"]: row for row in rows}
    cells = [(name, number) for name, row in cameras.items() for number in row["intrinsics"]]
    return listed("Intrinsics", cells, {
        "camera": lambda cell: cell[0],
        "": lambda cell: cell[1]["name"],
        "value": lambda cell: number(cell[1]["value"], decimals_for(_times(factor, cell[1]["u"]), 4)),
        U_AT_LEVEL: lambda cell: _u(factor, cell[1]["u"]) if cell[1]["u"] != 0 else "exact",
        "unit": lambda cell: cell[1]["unit"] if cell[1]["unit"] != "1" else "",
    })  # fmt: skip


def _times(factor: float, u: float | None) -> float | None:
    return None if u is None else factor * u


def _u(factor: float, u: float | None) -> Any:
    expanded = _times(factor, u)
    return number(math.inf) if expanded is None else number(expanded, decimals_for(expanded))
