"""Calibrations of one arm compared: parameters that changed beyond their uncertainty, and the effect on lengths."""

import datetime
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.errors import InputError
from ..core.text import shorten
from ..kinematics.arm import DOWN, Arm, correction_names, parameter_names, parameter_unit, value_of
from ..uncertainty.arm_uncertainty import Uncertainty
from ..uncertainty.degrees_of_freedom import coverage_factor, degrees_of_freedom
from ..uncertainty.volume import default_length, sample_lengths
from .results import Drift, Trend
from .statistics import FIXED, ON_BOUND, joint_test, length_change

_PAIR = ("the old calibration", "the new calibration")


def compare(
    old: CalibrationRecord,
    new: CalibrationRecord,
    *,
    level: float = 0.95,
    points: int = 400,
    length: float | None = None,
    seed: int = 0,
    labels: Sequence[str] = _PAIR,
) -> Drift:
    """Compare two calibrations of one arm: every parameter that is free in either, and lengths over the volume.

    The two are taken as independent, so variances add (JCGM 100, 5.1.2) and effective degrees of freedom follow Welch
    and Satterthwaite (annex G.4). A common error, such as that of one artefact's certified length, cancels in the
    change, so the uncertainty is then too large rather than too small. k is not compared: it is a correction of
    stage 1, not a parameter of the arm.

    Args:
        old: The earlier calibration.
        new: The later calibration.
        level: Coverage of the expanded uncertainties, between 0 and 1.
        points: Number of lengths over the volume.
        length: Their length, mm (default: 300, or half the reach of a small arm).
        seed: Seed of their positions.
        labels: How sentences name the two.

    Returns:
        Changes with their uncertainties, a test of all together, the change of lengths, and warnings.

    Raises:
        InputError: The arms have different numbers of joints, ``level`` is out of range, or the lengths do not fit into
            the volume.

    Example:
        >>> changed = aj.drift.compare(record, record_in_june, points=20)
        >>> print([name for name, moved in zip(changed.names, changed.moved) if moved])
        ['probe_z']
        >>> print(changed.sentences()[0][:60])
        Probe remounted: a change of the probe alone (probe_x by -0.
    """
    _check([old, new], level, labels)
    return _compared(old, new, _names([old, new]), level, _lengths(old, points, length, seed), labels)


def trend(
    records: Sequence[CalibrationRecord],
    dates: Sequence[datetime.datetime | str],
    *,
    level: float = 0.95,
    points: int = 400,
    length: float | None = None,
    seed: int = 0,
    labels: Sequence[str] | None = None,
) -> Trend:
    """Compare every calibration with the first in time, by the same lengths.

    All changes share the error of the first calibration: if all later ones differ alike, the first was probably wrong.

    Args:
        records: Two or more calibrations of one arm, in any order.
        dates: Their dates: datetimes or ISO 8601 texts, such as the attribute ``created`` of a calibration's file; UTC
            without a time zone.
        level: As for `compare`.
        points: As for `compare`.
        length: As for `compare`.
        seed: As for `compare`.
        labels: How sentences name the calibrations (default: number and date).

    Returns:
        The comparisons in the order of the dates.

    Raises:
        InputError: As for `compare`; or there are fewer than two calibrations, or a date is not one.

    Example:
        >>> trend = aj.drift.trend([record, record_in_june], ["2026-01-31", "2026-06-30"], points=20)
        >>> print(trend.names[-1], trend.change[1, -1].round(3), "mm; U", trend.expanded[1, -1].round(3), "mm")
        probe_z 0.1 mm; U 0.005 mm
    """
    if len(records) < 2:
        raise InputError("a trend needs at least two calibrations; give more.")
    if len(dates) != len(records):
        raise InputError(f"there are {len(records)} calibrations and {len(dates)} dates; give one date each.")
    moments = [moment(date) for date in dates]
    order = sorted(range(len(records)), key=lambda i: moments[i])
    sorted_records = [records[i] for i in order]
    names = [f"calibration {number} ({moments[i]:%Y-%m-%d})" for number, i in enumerate(order, start=1)]
    names = names if labels is None else [labels[i] for i in order]
    _check(sorted_records, level, names)
    lengths = _lengths(sorted_records[0], points, length, seed)
    drifts = [
        _compared(sorted_records[0], record, _names(sorted_records), level, lengths, (names[0], name))
        for record, name in zip(sorted_records[1:], names[1:], strict=True)
    ]
    return Trend(tuple(moments[i] for i in order), tuple(order), tuple(drifts))


def _compared(
    old: CalibrationRecord,
    new: CalibrationRecord,
    names: tuple[str, ...],
    level: float,
    lengths: tuple[float, np.ndarray, np.ndarray],
    labels: Sequence[str],
) -> Drift:
    """``lengths``: their length, and the configurations at both ends."""
    arms = old.calibrated.arm, new.calibrated.arm
    before, after = (_values(arm, names) for arm in arms)
    reasons = _reasons(old, new, names)
    known = np.array([not reason for reason in reasons])
    both = [uncertainty_of(record) for record in (old, new)]
    law = both[0].law.joined(both[1].law)
    parts = np.concatenate([_parts(uncertainty, names) for uncertainty in both], axis=1)
    parts = np.where(known[:, None], parts, 0.0)
    u = np.where(known, np.sqrt(parts.sum(axis=1)), np.nan)
    return Drift(
        names=names,
        units=tuple(_unit(arms, name) for name in names),
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
    known = {*parameter_names(arm), *(f"beta_{i}" for i in range(1, arm.joints + 1) if arm.beta is not None)}
    return np.array([float(value_of(arm, name)) if name in known else down.get(name, 0.0) for name in names])


def _unit(arms: tuple[Arm, Arm], name: str) -> str:
    """The unit of a parameter that one of two arms may lack."""
    return parameter_unit(next((arm for arm in arms if name in correction_names(arm)), arms[0]), name)


def _names(records: Sequence[CalibrationRecord]) -> tuple[str, ...]:
    """Parameters that are free in any calibration: those of the first in its order, then those that others add."""
    return tuple(dict.fromkeys(name for record in records for name in record.names))


def _lengths(
    record: CalibrationRecord, points: int, length: float | None, seed: int
) -> tuple[float, np.ndarray, np.ndarray]:
    arm = record.calibrated.arm
    length = default_length(arm) if length is None else length
    return (length, *sample_lengths(arm, points, length=length, seed=seed))


def _reasons(old: CalibrationRecord, new: CalibrationRecord, names: tuple[str, ...]) -> tuple[str, ...]:
    """Why the change of each parameter has no uncertainty; empty if it has one."""
    found = []
    for one, two in ((_reason(old, name), _reason(new, name)) for name in names):
        parts = [f"{one} in both"] if one == two else [f"{one} in the old one", f"{two} in the new one"]
        found.append(" and ".join(part for part, reason in zip(parts, (one, two), strict=False) if reason))
    return tuple(found)


def _reason(record: CalibrationRecord, name: str) -> str:
    if name not in record.names:
        return FIXED
    i = record.names.index(name)
    if record.active[i]:
        return ON_BOUND
    known = record.determined[i] and record.open[i, i] < 1e-6 and np.isfinite(record.covariance[i, i])
    return "" if known else "left open by the data"


def _parts(uncertainty: Uncertainty, names: tuple[str, ...]) -> Float[np.ndarray, "p c"]:
    """Variances of parameters in the order of ``names``, part by part; 0 for fixed ones."""
    index = {name: i for i, name in enumerate(uncertainty.names)}
    slopes = np.zeros((len(names), len(uncertainty.names)))
    for row, name in zip(slopes, names, strict=True):
        if name in index:
            row[index[name]] = 1.0
    return np.asarray(uncertainty.parts(slopes))


def _check(records: Sequence[Any], level: float, labels: Sequence[str]) -> None:
    """Raise `InputError` for what cannot be compared."""
    if not 0 < level < 1:
        raise InputError(f"level is {level:g}; give a number between 0 and 1, for example 0.95.")
    for record in records:
        if not isinstance(record, CalibrationRecord):
            raise InputError(
                f"a {type(record).__name__} cannot be compared; give records, from aj.files.load_calibration or "
                "aj.calibration.record_of."
            )
    arms = [record.recording.nominal for record in records]
    for arm, label in zip(arms, labels, strict=True):
        if arm.arm.joints != arms[0].arm.joints:
            raise InputError(
                f"{labels[0]} is of '{arms[0].name}' with {arms[0].arm.joints} joints and {label} of '{arm.name}' with "
                f"{arm.arm.joints}, which are different arms; compare calibrations of one arm."
            )


def moment(date: datetime.datetime | str) -> datetime.datetime:
    """A date with its time zone, UTC by default. Raises `InputError` for a text that is not a date."""
    try:
        found = datetime.datetime.fromisoformat(date) if isinstance(date, str) else date
    except ValueError as error:
        raise InputError(f"'{date}' is not a date; give it like 2026-03-01 or 2026-03-01T12:00:00+00:00.") from error
    return found if found.tzinfo else found.replace(tzinfo=datetime.UTC)


def _warnings(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> list[str]:
    """What makes a comparison doubtful, the most serious first."""
    found = []
    for record, label in zip((old, new), labels, strict=True):
        if not record.converged:
            found.append(f"Failed: {label}. {record.reason} Its changes mean nothing.")
        elif not record.plausible_scale:
            found.append(f"Implausible: {label}, with k = {record.k:.6g}. Check its units, sockets, lengths and arm.")
    found += [sentence for sentence in (_common_poses(old, new, labels), _other_arm(old, new, labels)) if sentence]
    if old.final_method != new.final_method:
        found.append(
            f"Different methods: {labels[0]} is {old.final_method}, {labels[1]} {new.final_method}; "
            "this is part of the change."
        )
    for one, other, label in ((old, new, labels[0]), (new, old, labels[1])):
        alone = [name for name in one.names if name not in other.names]
        if alone:
            found.append(
                f"Free in {label} only: {shorten(alone)}. Other parameters may compensate for them in the other one; "
                "lengths can still be compared."
            )
    return found


def _common_poses(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> str:
    """A sentence on poses that both calibrations use, which makes them dependent; empty if there are none."""
    rows = [{row.tobytes() for row in np.asarray(record.recording.capture.readings)} for record in (old, new)]
    common = len(rows[0] & rows[1])
    if not common:
        return ""
    if rows[0] == rows[1]:
        both = [_values(record.calibrated.arm, old.names) for record in (old, new)]
        same = old.names == new.names and np.array_equal(both[0], both[1])
        what = "are one and the same calibration" if same else "are of the same capture"
        return f"Not independent: {labels[0]} and {labels[1]} {what}, so this says nothing about drift."
    return (
        f"Not independent: {labels[0]} and {labels[1]} share {common} of {len(rows[1])} poses, so the uncertainties of "
        "the changes are wrong."
    )


def _other_arm(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> str:
    """A sentence on different nominal arms; empty if they are equal."""
    nominal = [record.recording.nominal for record in (old, new)]
    names = tuple(dict.fromkeys(name for specification in nominal for name in parameter_names(specification.arm)))
    values = [_values(specification.arm, names) for specification in nominal]
    other = [name for name, one, two in zip(names, *values, strict=True) if one != two]
    if not other:
        return ""
    one, two = (f"'{specification.name}' of {label}" for specification, label in zip(nominal, labels, strict=True))
    return (
        f"The nominal arms differ in {shorten(other)} ({one}, {two}): is it the same arm? Differences of fixed "
        "parameters count as drift."
    )
