"""What happened to an arm between calibrations: parameters that moved beyond their uncertainty, and what that does to lengths."""

import datetime
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..calibration.checks import plausible
from ..calibration.record import CalibrationRecord
from ..core.errors import InputError
from ..core.units import ARCSEC
from ..kinematics.arm import Arm, is_length, parameter_names
from ..kinematics.parameters import Parameters
from ..uncertainty.volume import default_length, sample_lengths
from .statistics import Joint, LengthChange, coverage_factor, effective_freedom, length_change, tested

_NAMED = 6  # how many parameters a sentence names
_PAIR = ("the old calibration", "the new calibration")


class Drift(NamedTuple):
    """Two calibrations compared, as NumPy arrays in the order of ``names``: mm and rad."""

    names: tuple[str, ...]  # free in either
    old: Float[np.ndarray, " p"]
    new: Float[np.ndarray, " p"]
    u: Float[np.ndarray, " p"]  # standard uncertainty of the change; NaN where there is none
    degrees_of_freedom: Float[np.ndarray, " p"]  # its effective degrees of freedom
    expanded: Float[np.ndarray, " p"]
    without: tuple[str, ...]  # why a change has no uncertainty; empty where it has one
    level: float
    joint: Joint
    lengths: LengthChange
    cautions: tuple[str, ...]  # what should be read before any number

    @property
    def change(self) -> Float[np.ndarray, " p"]:
        """New less old."""
        return self.new - self.old

    @property
    def moved(self) -> Bool[np.ndarray, " p"]:
        """Which parameters moved beyond their expanded uncertainty; False where there is none."""
        return np.abs(self.change) > np.where(np.isnan(self.expanded), np.inf, self.expanded)

    @property
    def by_chance(self) -> float:
        """How many parameters would exceed their expanded uncertainty on average, had nothing moved."""
        return (1 - self.level) * self.without.count("")

    def sentences(self) -> list[str]:
        """What to say of it, the gravest first."""
        return [*self.cautions, *self.findings()]

    def findings(self) -> list[str]:
        """What came out, without the cautions."""
        told = [_of_all(self), _of_each(self), _of_lengths(self.lengths, self.level), _of_size(self.lengths)]
        told.append(_of_those_without(self))
        return [sentence for sentence in told if sentence]


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
    """Compare two calibrations of one arm: every parameter that is free in either, and lengths of ``length`` mm (default 300, or half
    the reach of a small arm) from ``points`` places of the volume. Sentences call the two by their ``labels``.

    The two are taken as independent, so variances add (JCGM 100, 5.1.2) and effective degrees of freedom follow Welch and
    Satterthwaite (annex G.4). What they share, such as the error of one artefact's certified length, cancels in the change,
    and makes its uncertainty too large rather than too small. k is no parameter of the arm but a correction of stage 1, so it
    is not compared. Raises `InputError` for arms of different numbers of joints, a level that is no share, and lengths that
    do not fit into the volume.
    """
    _check([old, new], level, labels)
    return _compared(old, new, _union([old, new]), level, _readings(old, points, length, seed), labels)


class Trend(NamedTuple):
    """Any number of calibrations of one arm, in the order of their dates, each compared with the first."""

    dates: tuple[datetime.datetime, ...]
    order: tuple[int, ...]  # which of the calibrations given each is
    drifts: tuple[Drift, ...]  # of the second, third ... against the first; all have the same names

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that are free in any of them."""
        return self.drifts[0].names

    @property
    def change(self) -> Float[np.ndarray, "c p"]:
        """Change of every parameter from the first calibration, mm and rad; the first row is zero."""
        return np.stack([np.zeros(len(self.names)), *(drift.change for drift in self.drifts)])

    @property
    def expanded(self) -> Float[np.ndarray, "c p"]:
        """Expanded uncertainty of these changes; NaN where there is none, as in the first row."""
        return np.stack([np.full(len(self.names), np.nan), *(drift.expanded for drift in self.drifts)])

    @property
    def moved(self) -> Bool[np.ndarray, "c p"]:
        """Which changes are beyond their expanded uncertainty."""
        return np.stack([np.zeros(len(self.names), dtype=bool), *(drift.moved for drift in self.drifts)])

    @property
    def cautions(self) -> list[str]:
        """What should be read first, each said once."""
        return list(dict.fromkeys(sentence for drift in self.drifts for sentence in drift.cautions))


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
    """Every calibration against the first in time, by the same lengths; arguments as for `compare`.

    ``dates`` are datetimes or their ISO form, as the attribute ``created`` of a calibration's file; without a time zone they
    are UTC. All changes share the error of the first calibration: where every later one differs alike, it is the first that
    was off. Raises `InputError` as `compare` does, for fewer than two, and for a date that is none.
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
    readings = _readings(sorted_records[0], points, length, seed)
    drifts = [
        _compared(sorted_records[0], record, _union(sorted_records), level, readings, (names[0], name))
        for record, name in zip(sorted_records[1:], names[1:], strict=True)
    ]
    return Trend(tuple(moments[i] for i in order), tuple(order), tuple(drifts))


def _compared(
    old: CalibrationRecord,
    new: CalibrationRecord,
    names: tuple[str, ...],
    level: float,
    readings: tuple[float, np.ndarray, np.ndarray],
    labels: Sequence[str],
) -> Drift:
    before, after = (_values(record.calibrated.arm, names) for record in (old, new))
    without = _without(old, new, names)
    known = np.array([not reason for reason in without])
    u_old, u_new = (np.where(known, _standard_uncertainties(record, names), 0.0) for record in (old, new))
    degrees_of_freedom = effective_freedom(u_old, old.degrees_of_freedom, u_new, new.degrees_of_freedom)
    u = np.where(known, np.hypot(u_old, u_new), np.nan)
    return Drift(
        names=names,
        old=before,
        new=after,
        u=u,
        degrees_of_freedom=degrees_of_freedom,
        expanded=coverage_factor(level, degrees_of_freedom) * u,
        without=without,
        level=level,
        joint=tested(old, new, names, without, after - before, level),
        lengths=length_change(old, new, level, readings),
        cautions=tuple(_warnings(old, new, labels)),
    )


def _values(arm: Arm, names: tuple[str, ...]) -> np.ndarray:
    return np.asarray(Parameters(arm, names).vector())


def _union(records: Sequence[CalibrationRecord]) -> tuple[str, ...]:
    """Names that are free in any of them: those of the first in its order, then what others add."""
    return tuple(dict.fromkeys(name for record in records for name in record.names))


def _readings(record: CalibrationRecord, points: int, length: float | None, seed: int) -> tuple[float, np.ndarray, np.ndarray]:
    arm = record.calibrated.arm
    length = default_length(arm) if length is None else length
    return (length, *sample_lengths(arm, points, length=length, seed=seed))


def _without(old: CalibrationRecord, new: CalibrationRecord, names: tuple[str, ...]) -> tuple[str, ...]:
    """Why the change of each parameter has no uncertainty: held, on a bound, or left open by the data."""
    found = [[_reason(record, name) for name in names] for record in (old, new)]
    return tuple(
        "" if not (one or two) else f"{one} in both" if one == two else " and ".join(
            f"{reason} in the {which} one" for reason, which in ((one, "old"), (two, "new")) if reason
        )
        for one, two in zip(*found, strict=True)
    )  # fmt: skip


def _reason(record: CalibrationRecord, name: str) -> str:
    if name not in record.names:
        return "held"
    i = record.names.index(name)
    if record.active[i]:
        return "on a bound"
    known = record.determined[i] and record.open[i, i] < 1e-6 and np.isfinite(record.covariance[i, i])
    return "" if known else "left open by the data"


def _standard_uncertainties(record: CalibrationRecord, names: tuple[str, ...]) -> np.ndarray:
    """Standard uncertainties in the order of ``names``; 0 for what is held."""
    known = dict(zip(record.names, np.sqrt(np.diag(record.covariance)), strict=True))
    return np.array([known.get(name, 0.0) for name in names])


def _check(records: Sequence[CalibrationRecord], level: float, labels: Sequence[str]) -> None:
    """Raise `InputError` for what cannot be compared at all."""
    if not 0 < level < 1:
        raise InputError(f"level is {level:g}; give a share between 0 and 1, for example 0.95.")
    for record in records:
        if not isinstance(record, CalibrationRecord):
            raise InputError(
                f"a {type(record).__name__} cannot be compared; give records, from aj.files.load_calibration or aj.calibration.record_of."
            )
    arms = [record.recording.nominal for record in records]
    for arm, label in zip(arms, labels, strict=True):
        if arm.arm.joints != arms[0].arm.joints:
            raise InputError(
                f"{labels[0]} is of '{arms[0].name}' with {arms[0].arm.joints} joints and {label} of '{arm.name}' with "
                f"{arm.arm.joints}, which are different arms; compare calibrations of one arm."
            )


def moment(date: datetime.datetime | str) -> datetime.datetime:
    """A date with its time zone; without one it is UTC. Raises `InputError` for what is no date."""
    try:
        found = datetime.datetime.fromisoformat(date) if isinstance(date, str) else date
    except ValueError as error:
        raise InputError(f"'{date}' is no date; give it like 2026-03-01 or 2026-03-01T12:00:00+00:00.") from error
    return found if found.tzinfo else found.replace(tzinfo=datetime.UTC)


def _warnings(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> list[str]:
    """What makes a comparison doubtful, the gravest first."""
    found = []
    for record, label in zip((old, new), labels, strict=True):
        if not record.converged:
            found.append(f"Failed: {label}. {record.reason} Its changes mean nothing.")
        elif not plausible(record.k):
            found.append(f"Implausible: {label}, with k = {record.k:.6g}. Check its units, sockets, lengths and arm.")
    found += [sentence for sentence in (_shared(old, new, labels), _other_arm(old, new, labels)) if sentence]
    if old.method != new.method:
        found.append(
            f"Of different methods: {labels[0]} is {old.method}, {labels[1]} {new.method}; some of the change is the method's."
        )
    for one, other, label in ((old, new, labels[0]), (new, old, labels[1])):
        alone = [name for name in one.names if name not in other.names]
        if alone:
            found.append(
                f"Free in {label} only: {_some(alone)}. What they hold there, other parameters may hold in the other one; "
                "lengths can be compared all the same."
            )
    return found


def _shared(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> str:
    """A sentence on readings that both calibrations are of: then they are not independent."""
    rows = [{row.tobytes() for row in np.asarray(record.recording.capture.q)} for record in (old, new)]
    common = len(rows[0] & rows[1])
    if not common:
        return ""
    if rows[0] == rows[1]:
        both = [_values(record.calibrated.arm, old.names) for record in (old, new)]
        same = old.names == new.names and np.array_equal(both[0], both[1])
        what = "are one and the same calibration" if same else "are of the same capture"
        return f"Not independent: {labels[0]} and {labels[1]} {what}, so this says nothing about drift."
    return f"Not independent: {labels[0]} and {labels[1]} share {common} of {len(rows[1])} poses, so the uncertainties of the changes are wrong."


def _other_arm(old: CalibrationRecord, new: CalibrationRecord, labels: Sequence[str]) -> str:
    """A sentence where the two started from different nominal arms."""
    nominal = [record.recording.nominal for record in (old, new)]
    names = tuple(dict.fromkeys(name for specification in nominal for name in parameter_names(specification.arm)))
    values = [_values(specification.arm, names) for specification in nominal]
    other = [name for name, one, two in zip(names, *values, strict=True) if one != two]
    if not other:
        return ""
    return (
        f"The nominal arms differ in {_some(other)} ('{nominal[0].name}' of {labels[0]}, '{nominal[1].name}' of {labels[1]}): is it the same "
        "arm? Of what was held, the difference counts as drift."
    )


def _of_all(drift: Drift) -> str:
    joint = drift.joint
    if math.isnan(joint.p):
        return "Together the changes cannot be tested: too few parameters or poses determine them in both calibrations."
    law = f"chi-square {joint.statistic:.1f} with {joint.rank} degrees of freedom"
    if math.isfinite(joint.degrees_of_freedom):
        law = f"F {joint.statistic / joint.rank:.2f} with {joint.rank} and {joint.degrees_of_freedom:.0f} degrees of freedom"
    chance = "p < 0.0001" if joint.p < 1e-4 else f"p = {joint.p:.2g}"
    start = f"Together, the changes of {len(joint.names)} parameters are"
    if joint.p >= 1 - drift.level:
        return f"{start} no more than their uncertainties explain ({law}, {chance})."
    causes = [f"{name} by {in_words(name, amount)}" for name, amount in joint.causes]
    few = f" A change of these alone would explain all of it: {', '.join(causes)}." if causes else ""
    return (
        f"{start} more than their uncertainties explain ({law}, {chance}): the arm has changed, or errors are at work that the "
        f"uncertainties leave out.{few}"
    )


def _of_each(drift: Drift) -> str:
    compared, moved = drift.without.count(""), np.flatnonzero(drift.moved)
    if not compared:
        return ""
    chance = f"{drift.by_chance:.0f}" if drift.by_chance >= 0.95 else f"{drift.by_chance:.1g}"
    count = f"{len(moved) or 'None'} of {compared} parameters moved beyond {'their' if len(moved) != 1 else 'its'} uncertainty"
    start = f"{count} ({100 * drift.level:g} %; {chance} would by chance)"
    if not len(moved):
        return f"{start}."
    worst = sorted(moved, key=lambda i: -abs(drift.change[i]) / drift.expanded[i])
    each = [_moved(drift, int(i)) for i in worst]
    return f"{start}: {_some(each)}."


def _moved(drift: Drift, i: int) -> str:
    name = drift.names[i]
    return f"{name} by {in_words(name, drift.change[i])} (U = {in_words(name, drift.expanded[i], '')})"


def _of_lengths(lengths: LengthChange, level: float) -> str:
    if not np.all(np.isfinite(lengths.u)):
        return (
            f"Lengths of {lengths.length:g} mm changed by {lengths.rms:.4f} mm RMS, at most {lengths.largest:+.4f} mm, but the data of one "
            "calibration leave them open, so nothing says whether that is drift."
        )
    share = 100 * float(np.mean(lengths.moved))
    return (
        f"Lengths of {lengths.length:g} mm over the volume changed by {lengths.rms:.4f} mm RMS, where the uncertainties alone would give "
        f"{lengths.rms_by_chance:.4f} mm, and at most by {lengths.largest:+.4f} mm; {share:.0f} % of them moved beyond their uncertainty "
        f"({100 * (1 - level):.2g} % would by chance)."
    )


def _of_size(lengths: LengthChange) -> str:
    if not math.isfinite(lengths.u_size):
        return ""
    relation = "beyond" if abs(lengths.size) > lengths.expanded_size else "within"
    word = "longer" if lengths.size > 0 else "shorter"
    return (
        f"On average the same lengths measure {1e6 * abs(lengths.size):.1f} um/m {word} than before (U = {1e6 * lengths.expanded_size:.1f} um/m), "
        f"which is {relation} the uncertainty."
    )


def _of_those_without(drift: Drift) -> str:
    reasons = {}
    for name, reason in zip(drift.names, drift.without, strict=True):
        if reason:
            reasons.setdefault(reason, []).append(name)
    told = [f"{_some(names)} ({reason})" for reason, names in reasons.items()]
    return f"Without an uncertainty of change: {'; '.join(told)}." if told else ""


def in_words(name: str, value: float, sign: str = "+") -> str:
    """A change of a parameter in um or arcsec, to three digits."""
    shown, unit = (1e3 * value, "um") if is_length(name) else (value / ARCSEC, "arcsec")
    decimals = max(2 - math.floor(math.log10(abs(shown))), 0) if shown else 0
    return f"{shown:{sign}.{min(decimals, 3)}f} {unit}"


def _some(items: list[str]) -> str:
    return ", ".join(items[:_NAMED]) + (f" and {len(items) - _NAMED} more" if len(items) > _NAMED else "")
