"""What a calibration file holds of observations: how they agree, the geometry found, and poses that lost weight."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, OtherPoses, Removed
from ..calibration.results import ObservedMetrics
from ..data.capture import Capture
from ..model.observed import Observed
from .hdf5 import Stored, Table, Variable, check_sense, columns, need, numbering


def observed_tables(record: CalibrationRecord) -> dict[str, Table]:
    """The tables ``observed``, ``geometry`` and ``pose_weights``; and ``other_poses`` and ``removed``, where there is
    anything in them."""
    found = _tables_of(record.observed, Observed.of(record.recording.capture, None).blocks)
    others = record.others
    if others is not None:
        found["other_poses"] = Table(
            columns(
                "observation",
                observation=(list(others.names), "", "observation"),
                poses=(others.poses, "1", "number of poses that the arm was not calibrated with"),
                rms=(others.rms, "mm", "their root mean square distance from the geometry found"),
                rms_angle=(others.rms_angle, "rad", "their root mean square angle"),
            )
        )
    if record.removed:
        found["removed"] = _removed_table(record.removed)
    return found


def _removed_table(removed: tuple[Removed, ...]) -> Table:
    members = [(i, name) for i, one in enumerate(removed) for name in one.members]
    by_group = columns(
        "removed_group",
        removed_group=([one.group for one in removed], "", "group left out, because it contradicts the rest"),
        kind=([one.kind for one in removed], "", "kind of group"),
        ratio=([one.ratio for one in removed], "1", "F: mean square that it added, over that of the rest"),
        numerator=([one.degrees_of_freedom[0] for one in removed], "1", "degrees of freedom of the numerator"),
        denominator=([one.degrees_of_freedom[1] for one in removed], "1", "degrees of freedom of the denominator"),
        probability=([one.probability for one in removed], "1", "probability of this F where nothing is wrong"),
        rms_with=([one.rms_with for one in removed], "mm", "RMS distance of the rest from its geometry"),
        rms_without=([one.rms_without for one in removed], "mm", "the same without the group"),
        changed_most=([one.changed_most for one in removed], "", "parameter that changed most"),
        change=([one.change for one in removed], "1", "its change in standard uncertainties"),
    )
    by_member = columns(
        "removed_member",
        removed_member=([name for _, name in members], "", "socket or observation left out"),
        group_number=([i for i, _ in members], "1", "which group it is of, from 0"),
    )
    return Table(by_group | by_member)


def removed_of(stored: Stored) -> tuple[Removed, ...]:
    """What a calibration left out because it contradicts the rest."""
    table = stored.tables.get("removed")
    if table is None:
        return ()
    return tuple(
        Removed(
            kind=str(table["kind"][i]),
            group=str(group),
            members=tuple(map(str, table["removed_member"][table["group_number"] == i])),
            ratio=float(table["ratio"][i]),
            degrees_of_freedom=(int(table["numerator"][i]), int(table["denominator"][i])),
            probability=float(table["probability"][i]),
            rms_with=float(table["rms_with"][i]),
            rms_without=float(table["rms_without"][i]),
            changed_most=str(table["changed_most"][i]),
            change=float(table["change"][i]),
        )
        for i, group in enumerate(table["removed_group"])
    )


def _tables_of(observed: ObservedMetrics, units: dict[str, tuple[str, ...]]) -> dict[str, Table]:
    numbers = [(name, i, value) for name, values in observed.geometry.items() for i, value in enumerate(values)]
    weights = [(name, weight) for name, of in zip(observed.names, observed.weights, strict=True) for weight in of]
    return {
        "observed": Table(
            columns(
                "observation",
                observation=(list(observed.names), "", "observation"),
                kind=(list(observed.kinds), "", "its kind"),
                poses=([len(weights) for weights in observed.weights], "1", "number of poses"),
                rms_before=(
                    np.asarray(observed.rms_before),
                    "mm",
                    "root mean square distance from the geometry, nominal arm",
                ),
                rms_after=(np.asarray(observed.rms_after), "mm", "the same by the calibrated arm"),
                reduced_chi=(
                    np.asarray(observed.reduced_chi),
                    "1",
                    "root mean square in standard deviations of a residual",
                ),
            ),
            {"sigma_mm": float(observed.sigma), "reduced_chi_of_all": float(observed.reduced_chi_of_all)},
        ),
        "geometry": Table(
            numbering("number", len(numbers))
            | columns(
                "number",
                part=([name for name, *_ in numbers], "", "part of the unknown geometry"),
                unit=([units[name][i] for name, i, _ in numbers], "", "unit"),
                value=([float(value) for *_, value in numbers], "mm or rad, see unit", "value"),
            )
            | numbering("entry", len(_flat(observed)))
            | {"covariance": Variable(("entry",), _flat(observed), "products of units", "of each part, row by row")}
        ),
        "pose_weights": Table(
            numbering("pose", len(weights))
            | columns(
                "pose",
                observation=([name for name, _ in weights], "", "observation"),
                weight=([float(weight) for _, weight in weights], "1", "weight; below 1 by a robust loss"),
            )
        ),
    }


def _flat(observed: ObservedMetrics) -> np.ndarray:
    """The covariances of all parts, one after the other."""
    found = [np.asarray(matrix).ravel() for matrix in observed.geometry_covariance.values()]
    return np.concatenate(found) if found else np.zeros(0)


def _covariances(geometry: Mapping[str, np.ndarray], flat: np.ndarray) -> dict[str, Any]:
    """Of each part, from all of them."""
    ends = np.cumsum([len(values) ** 2 for values in geometry.values()], dtype=int)
    pieces = np.split(flat, ends[:-1]) if len(ends) else []
    return {
        name: piece.reshape(len(values), -1) for (name, values), piece in zip(geometry.items(), pieces, strict=True)
    }


def observed_of(path: str | os.PathLike, stored: Stored, capture: Capture) -> ObservedMetrics:
    """How sockets and other observations of a file agree with its arm."""
    table = stored.tables["observed"]
    need(path, stored.tables, "geometry", "pose_weights")
    need(path, table, "observation", "kind", "poses", "rms_before", "rms_after", "reduced_chi", of="entry")
    geometry, weights = stored.tables["geometry"], stored.tables["pose_weights"]
    parts = geometry["part"].astype(str)
    attributes = stored.table_attributes["observed"]
    blocks = Observed.of(capture, None).blocks
    ends = np.cumsum(table["poses"])
    names: list[str] = list(dict.fromkeys(parts.tolist()))
    values: dict[str, Any] = {name: geometry["value"][parts == name] for name in names}
    size = sum(len(part) ** 2 for part in values.values())
    # Files of earlier development versions have none.
    flat = geometry.get("covariance", np.full(size, np.nan))
    check_sense(path, {"the covariance of its geometry has another size": len(flat) != size})
    found = ObservedMetrics(
        names=tuple(map(str, table["observation"])),
        kinds=tuple(map(str, table["kind"])),
        rms_before=table["rms_before"],
        rms_after=table["rms_after"],
        reduced_chi=table["reduced_chi"],
        reduced_chi_of_all=np.asarray(attributes["reduced_chi_of_all"]),
        sigma=np.asarray(attributes["sigma_mm"]),
        geometry=values,
        geometry_covariance=_covariances(values, flat),
        weights=tuple(np.split(weights["weight"], ends[:-1])),
    )
    expected = (*capture.names, *(observation.name for observation in capture.observations))
    check_sense(
        path,
        {
            "its results are of other observations": found.names != expected,
            "its geometry is that of other observations": {k: len(v) for k, v in found.geometry.items()}
            != {name: len(units) for name, units in blocks.items()},
            "a weight is not between 0 and 1": not np.all((weights["weight"] >= 0) & (weights["weight"] <= 1)),
            "a root mean square is negative": bool(np.any(table["rms_after"] < 0) or np.any(table["rms_before"] < 0)),
        },
    )
    return found


def other_poses_of(stored: Stored) -> OtherPoses | None:
    """How the arm of a file agrees with poses that it was not calibrated with."""
    table = stored.tables.get("other_poses")
    if table is None:
        return None
    return OtherPoses(tuple(map(str, table["observation"])), table["poses"], table["rms"], table["rms_angle"])
