"""Calibrations of one arm compared: parameters that changed beyond their uncertainty, and the effect on lengths."""

import datetime
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.arguments import Range, checked_arguments
from ..core.errors import InputError
from ..core.text import shorten
from ..kinematics.arm import DOWN, Arm, parameter_names, parameter_unit, value_of
from ..uncertainty.coverage import LEVEL
from ..uncertainty.degrees_of_freedom import coverage_factor, degrees_of_freedom
from ..uncertainty.volume import default_length, sample_lengths
from .results import Drift, Trend
from .statistics import FIXED, ON_BOUND, joint_test, length_change

_Level = Annotated[float, Range(above=0, below=1)]
_PAIR = ("the old calibration", "the new calibration")


@checked_arguments
def compare(
    old: CalibrationRecord,
    new: CalibrationRecord,
    *,
    level: _Level = LEVEL,
    points: int = 400,
    length: float | None = None,
    seed: int = 0,
    labels: Sequence[str] = _PAIR,
) -> Drift:
    """Compare two calibrations of one arm: every parameter that is free in either, and lengths over the volume.

    The two are taken as independent, so variances add (JCGM 100, 5.1.2) and effective degrees of freedom follow Welch
    and Satterthwaite (annex G.4). A common error, such as that of one artefact's certified length, cancels in the
    change, so the uncertainty is then too large rather than too small. A coefficient that the model of one of them
    lacks is 0 there, and its change has no uncertainty. k is not compared: it is a correction of stage 1, not a
    parameter of the arm. `InputError` for arms with different numbers of joints, and for lengths that do not fit into
    the volume.

    Args:
        old: The earlier calibration.
        new: The later calibration.
        level: Coverage of the expanded uncertainties, between 0 and 1.
        points: Number of lengths over the volume.
        length: Their length, mm (default: 300, or half the reach of a small arm).
        seed: Seed of their positions.
        labels: How sentences name the two.

    Example:
        >>> changed = aj.drift.compare(record, record_in_june, points=20)
        >>> print([name for name, moved in zip(changed.names, changed.moved) if moved])
        ['probe_z']
        >>> print(changed.sentences()[0][:60])
        The probe was remounted (probe_x by -0.905 um, probe_y by +0
    """
    return _compared([old, new], labels, level, (points, length, seed))[0]


@checked_arguments
def trend(
    records: Sequence[CalibrationRecord],
    dates: Sequence[datetime.datetime | str],
    *,
    level: _Level = LEVEL,
    points: int = 400,
    length: float | None = None,
    seed: int = 0,
    labels: Sequence[str] | None = None,
) -> Trend:
    """Compare every calibration with the first in time, by the same lengths, in the order of the dates.

    All changes share the error of the first calibration: if all later ones differ alike, the first was probably wrong.
    `InputError` as for `compare`, for fewer than two calibrations, and for what is no date.

    Args:
        records: Two or more calibrations of one arm, in any order.
        dates: Their dates: datetimes or ISO 8601 texts, such as the attribute ``created`` of a calibration's file; UTC
            without a time zone.
        level: As for `compare`, like all arguments that are not named here.
        labels: How sentences name the calibrations (default: number and date).

    Example:
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> print(trend.names[-1], trend.change[1, -1].round(3), "mm; U", trend.expanded[1, -1].round(3), "mm")
        probe_z 0.1 mm; U 0.005 mm
    """
    if len(records) < 2:
        raise InputError("a trend needs at least two calibrations; give more.")
    if len(dates) != len(records):
        raise InputError(
            f"there are {len(records)} calibrations and {len(dates)} dates; give one date per calibration."
        )
    moments = [moment(date) for date in dates]
    order = sorted(range(len(records)), key=lambda i: moments[i])
    names = [f"calibration {number} ({moments[i]:%Y-%m-%d})" for number, i in enumerate(order, start=1)]
    names = names if labels is None else [labels[i] for i in order]
    drifts = _compared([records[i] for i in order], names, level, (points, length, seed))
    return Trend(tuple(moments[i] for i in order), tuple(order), tuple(drifts))


def moment(date: datetime.datetime | str) -> datetime.datetime:
    """A date with its time zone, UTC by default. Raises `InputError` for a text that is not a date."""
    try:
        time = datetime.datetime.fromisoformat(date) if isinstance(date, str) else date
    except ValueError as error:
        raise InputError(
            f"'{date}' is not a date; give one such as 2026-03-01 or 2026-03-01T12:00:00+00:00."
        ) from error
    return time if time.tzinfo else time.replace(tzinfo=datetime.UTC)


def _compared(
    records: Sequence[CalibrationRecord],
    labels: Sequence[str],
    level: float,
    volume: tuple[int, float | None, int],
) -> list[Drift]:
    """Every calibration against the first, by the same parameters and lengths; ``volume``: number, length, and seed."""
    first, *others = records
    arms = [record.recording.nominal for record in records]
    for arm, label in zip(arms, labels, strict=True):
        if arm.arm.joints != arms[0].arm.joints:
            raise InputError(
                f"{labels[0]} is for the arm '{arms[0].name}' with {arms[0].arm.joints} joints, but {label} is for the "
                f"arm '{arm.name}' with {arm.arm.joints} joints; compare calibrations of the same arm."
            )
    points, length, seed = volume
    length = default_length(first.calibrated.arm) if length is None else length
    ends = sample_lengths(first.calibrated.arm, points, length=length, seed=seed)
    # Those of the first in its order, then those that others add. An arm may lack coefficients that others have.
    units = {name: parameter_unit(record.calibrated.arm, name) for record in records for name in record.names}
    return [
        _of_two(first, new, units, level, (length, *ends), (labels[0], label))
        for new, label in zip(others, labels[1:], strict=True)
    ]


def _of_two(
    old: CalibrationRecord,
    new: CalibrationRecord,
    units: Mapping[str, str],
    level: float,
    lengths: tuple[float, np.ndarray, np.ndarray],
    labels: tuple[str, str],
) -> Drift:
    """``units``: parameters to compare, with their units; ``lengths``: their length, and the configurations at both
    ends."""
    names = tuple(units)
    arms = old.calibrated.arm, new.calibrated.arm
    before, after = (_values(arm, names) for arm in arms)
    reasons = tuple(_why_open((old, new), name) for name in names)
    certain = np.array([not reason for reason in reasons])
    uncertainties = [uncertainty_of(record) for record in (old, new)]
    law = uncertainties[0].law.joined(uncertainties[1].law)
    # Variances part by part; 0 of parameters that are fixed.
    slopes = [np.array([[float(name == other) for other in u.names] for name in names]) for u in uncertainties]
    pairs = zip(uncertainties, slopes, strict=True)
    parts = np.concatenate([np.asarray(u.parts(slope.reshape(len(names), -1))) for u, slope in pairs], axis=1)
    parts = np.where(certain[:, None], parts, 0.0)
    u = np.where(certain, np.sqrt(parts.sum(axis=1)), np.nan)
    return Drift(
        names=names,
        units=tuple(units.values()),
        old=before,
        new=after,
        u=u,
        degrees_of_freedom=degrees_of_freedom(parts, law),
        expanded=coverage_factor(level, parts, law) * u,
        reasons=reasons,
        level=level,
        joint_test=joint_test(old, new, names, reasons, after - before, level),
        lengths=length_change(old, new, level, lengths),
        warnings=tuple(_warnings(old, new, labels)),
    )


def _values(arm: Arm, names: tuple[str, ...]) -> Float[np.ndarray, " p"]:
    """Values of parameters; coefficients of corrections that the arm lacks are 0."""
    down: dict[str, float] = dict(zip(("gravity_x", "gravity_y", "gravity_z"), DOWN, strict=True))
    present = parameter_names(arm)
    return np.array([float(value_of(arm, name)) if name in present else down.get(name, 0.0) for name in names])


def _why_open(records: Sequence[CalibrationRecord], name: str) -> str:
    """Why the change of a parameter has no uncertainty; empty if it has one."""
    reasons = []
    for record in records:
        i = record.names.index(name) if name in record.names else None
        if i is None:
            arm = record.calibrated.arm
            lacking = name not in parameter_names(arm)
            reasons.append(f"{FIXED} at {_values(arm, (name,))[0]:g} by the model" if lacking else FIXED)
        elif record.active[i]:
            reasons.append(ON_BOUND)
        else:
            closed = record.determined[i] and record.open[i, i] < 1e-6 and np.isfinite(record.covariance[i, i])
            reasons.append("" if closed else "not determined by the data")
    if reasons[0] == reasons[1]:
        return f"{reasons[0]} in both calibrations" if reasons[0] else ""
    places = zip(reasons, ("old", "new"), strict=True)
    return " and ".join(f"{reason} in the {which} calibration" for reason, which in places if reason)


def _warnings(old: CalibrationRecord, new: CalibrationRecord, labels: tuple[str, str]) -> Iterator[str]:
    """What makes a comparison doubtful, the most serious first."""
    for record, label in zip((old, new), labels, strict=True):
        if not record.converged:
            yield f"Failed: {label}. {record.reason} Changes computed from this calibration are meaningless."
        elif not record.plausible_scale:
            yield (
                f"Implausible scale: k = {record.k:.6g} in {label}. Check the units, sockets, lengths and arm of this "
                "calibration."
            )
    poses = [{row.tobytes() for row in np.asarray(record.recording.capture.readings)} for record in (old, new)]
    if poses[0] == poses[1]:
        values = [_values(record.calibrated.arm, old.names) for record in (old, new)]
        same = old.names == new.names and np.array_equal(values[0], values[1])
        what = "are the same calibration" if same else "were computed from the same capture"
        yield f"Not independent: {labels[0]} and {labels[1]} {what}, so drift cannot be seen."
    elif common := len(poses[0] & poses[1]):
        yield (
            f"Not independent: {labels[0]} and {labels[1]} share {common} of {len(poses[1])} poses, so the "
            "uncertainties of the changes are wrong."
        )
    nominal = [record.recording.nominal for record in (old, new)]
    names = tuple(dict.fromkeys(name for specification in nominal for name in parameter_names(specification.arm)))
    values = zip(names, *(_values(specification.arm, names) for specification in nominal), strict=True)
    differing = [name for name, before, after in values if before != after]
    if differing:
        arms = [f"'{specification.name}' of {label}" for specification, label in zip(nominal, labels, strict=True)]
        yield (
            f"The nominal arms differ in {shorten(differing)} ({', '.join(arms)}); check that the arm is the same. "
            "Differences between fixed parameters count as drift."
        )
    if old.final_method != new.final_method:
        yield (
            f"Different methods: {labels[0]} is {old.final_method}, {labels[1]} is {new.final_method}; "
            "the changes include the effect of the method."
        )
    for record, other, label in ((old, new, labels[0]), (new, old, labels[1])):
        if alone := [name for name in record.names if name not in other.names]:
            yield (
                f"Parameters free only in {label}: {shorten(alone)}. These parameters are fixed in the other "
                "calibration, so its other parameters may differ for this reason; compare lengths instead."
            )
