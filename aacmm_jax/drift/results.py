"""Results of comparing calibrations: `Drift` of two, `Trend` of any number, and the sentences that state them."""

import datetime
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ..core.text import f_text, shorten
from ..core.units import people_read_change
from ..uncertainty.coverage import in_percent
from .statistics import JointTest, LengthChange, ProbeTest


class Drift(NamedTuple):
    """Two calibrations compared, as NumPy arrays in the order of ``names``: mm, rad, or a coefficient's own unit.

    Example:
        >>> changed = aj.drift.compare(record, record_in_june, points=20)
        >>> at = changed.names.index("probe_z")
        >>> print(f"probe_z by {changed.change[at]:.3f} mm, U = {changed.expanded[at]:.3f} mm")
        probe_z by 0.100 mm, U = 0.005 mm
    """

    names: tuple[str, ...]  # free in either
    units: tuple[str, ...]
    old: Float[np.ndarray, " p"]
    new: Float[np.ndarray, " p"]
    u: Float[np.ndarray, " p"]  # standard uncertainty of the change; NaN if it has none
    degrees_of_freedom: Float[np.ndarray, " p"]  # effective ones of the change
    expanded: Float[np.ndarray, " p"]  # expanded uncertainty of the change
    reasons: tuple[str, ...]  # why a change has no uncertainty; empty if it has one
    level: float  # coverage of the expanded uncertainties
    joint_test: JointTest
    lengths: LengthChange
    warnings: tuple[str, ...]  # what makes the comparison doubtful

    @property
    def change(self) -> Float[np.ndarray, " p"]:
        """New less old."""
        return self.new - self.old

    @property
    def moved(self) -> Bool[np.ndarray, " p"]:
        """Which parameters changed beyond their expanded uncertainty; False for those without one."""
        return np.abs(self.change) > np.where(np.isnan(self.expanded), np.inf, self.expanded)

    @property
    def compared(self) -> int:
        """How many changes have an uncertainty."""
        return self.reasons.count("")

    @property
    def by_chance(self) -> float:
        """How many parameters would exceed their expanded uncertainty on average if nothing had changed."""
        return (1 - self.level) * self.compared

    def sentences(self) -> list[str]:
        """Warnings, the answer and findings."""
        return [*self.warnings, self.answer, *self.findings()]

    @property
    def answer(self) -> str:
        """Whether the arm has changed, in what and by how much; or from which size on a change would have been seen."""
        return f"Doubtful, see the warnings: {_answer(self)}" if self.warnings else _answer(self)

    def findings(self) -> list[str]:
        """What was found: of all parameters together, of each, of lengths, and of parameters without uncertainty."""
        probe = self.joint_test.probe
        together = _of_all(self), "" if probe is None else _of_probe(self, probe)
        together = together[::-1] if probe is not None and probe.remounted else together
        sentences = [*together, _of_each(self), *_of_lengths(self.lengths, self.level)]
        open_names: dict[str, list[str]] = {}
        for name, reason in zip(self.names, self.reasons, strict=True):
            if reason:
                open_names.setdefault(reason, []).append(name)
        groups = [f"{shorten(names)} ({reason})" for reason, names in open_names.items()]
        sentences += [f"Changes without an uncertainty: {'; '.join(groups)}."] if groups else []
        return list(filter(None, sentences))


class Trend(NamedTuple):
    """Any number of calibrations of one arm, in the order of their dates, each compared with the first.

    Example:
        >>> trend = aj.drift.trend([record_in_june, record], ["2026-06-30", "2026-01-31"], points=20)
        >>> print(trend.order, [f"{date:%B}" for date in trend.dates])
        (1, 0) ['January', 'June']
    """

    dates: tuple[datetime.datetime, ...]
    order: tuple[int, ...]  # index of each among the calibrations given
    drifts: tuple[Drift, ...]  # of the second, third ... against the first; all with the same names
    dated_by_file: tuple[bool, ...] = ()  # whose date is when the file was made; of none if empty

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that are free in any of them."""
        return self.drifts[0].names

    @property
    def change(self) -> Float[np.ndarray, "c p"]:
        """Change of every parameter from the first calibration, in its unit; the first row is zero."""
        return np.stack([np.zeros(len(self.names)), *(drift.change for drift in self.drifts)])

    @property
    def expanded(self) -> Float[np.ndarray, "c p"]:
        """Expanded uncertainty of these changes; NaN if there is none, as in the first row."""
        return np.stack([np.full(len(self.names), np.nan), *(drift.expanded for drift in self.drifts)])

    @property
    def moved(self) -> Bool[np.ndarray, "c p"]:
        """Which changes are beyond their expanded uncertainty."""
        return np.stack([np.zeros(len(self.names), dtype=bool), *(drift.moved for drift in self.drifts)])

    @property
    def warnings(self) -> list[str]:
        """What makes the comparisons doubtful, each sentence once."""
        return list(dict.fromkeys(sentence for drift in self.drifts for sentence in drift.warnings))


def _answer(drift: Drift) -> str:
    test, probe, lengths = drift.joint_test, drift.joint_test.probe, drift.lengths
    if math.isnan(test.p):
        return "Whether the arm has changed cannot be said: too few parameters are determined in both calibrations."
    if test.p >= 1 - drift.level:
        return f"No change of the arm is seen.{_detectable(drift)}"
    if probe is not None and probe.remounted:
        change = ", ".join(f"{name} by {in_words('mm', value)}" for name, value in probe.change)
        rest = "has not changed" if not probe.p < 1 - drift.level else "may have changed slightly"
        return f"The probe was remounted ({change}); the arm {rest}."
    units = dict(zip(drift.names, drift.units, strict=True))
    causes = [f"{_quantity(name)} by {in_words(units[name], amount)}" for name, amount in test.causes]
    what = ", ".join(causes) or f"{int(drift.moved.sum())} of {drift.compared} parameters by more than their U"
    return f"The arm has changed: {what}; lengths of {lengths.length:g} mm by up to {abs(lengths.largest):.2g} mm."


def _quantity(name: str) -> str:
    """A parameter as people name it."""
    kind, _, joint = name.partition("_")
    return f"zero of joint {joint}" if kind == "theta" else name


def _detectable(drift: Drift) -> str:
    """From which size on a change of one zero, or of one length of the arm, would have been seen, in words."""
    test, units, ends = drift.joint_test, dict(zip(drift.names, drift.units, strict=True)), {}
    for what, unit, kinds in (("zero of a joint", "rad", ("theta",)), ("length of the arm", "mm", ("a", "d"))):
        sizes = [
            size
            for name, size in zip(test.names, test.detectable.tolist(), strict=True)
            if name.partition("_")[0] in kinds and units[name] == unit and math.isfinite(size)
        ]
        if sizes:
            ends[what] = [in_words(unit, end, "") for end in (min(sizes), max(sizes))]
    if not ends:
        return ""
    every = " or ".join(f"any {what} had changed by {largest}" for what, (_, largest) in ends.items())
    least = " or ".join(smallest for smallest, _ in ends.values())
    return (
        f" A change would have been seen in 95 of 100 cases if {every}; in the parameters that are known best, from "
        f"{least} on."
    )


def _of_all(drift: Drift) -> str:
    test = drift.joint_test
    if math.isnan(test.p):
        return (
            "The changes cannot be tested together: too few parameters are determined in both calibrations, or there "
            "are too few poses."
        )
    law = f"chi-squared {test.statistic:.1f} with {test.rank} degrees of freedom"
    if math.isfinite(test.degrees_of_freedom):
        ratio = test.statistic / test.rank
        law = f"F {f_text(ratio)} with {test.rank} and {test.degrees_of_freedom:.0f} degrees of freedom"
    probability = "p < 0.0001" if test.p < 1e-4 else f"p = {test.p:.2g}"
    start = f"Tested together, the changes of {len(test.names)} parameters are"
    if test.p >= 1 - drift.level:
        return f"{start} explained by their uncertainties ({law}, {probability})."
    units = dict(zip(drift.names, drift.units, strict=True))
    causes = [f"{name} by {in_words(units[name], amount)}" for name, amount in test.causes]
    arm = "the arm has changed" if test.probe is None or not test.probe.remounted else "its probe has been remounted"
    few = f" A change of these parameters alone would explain all changes: {', '.join(causes)}." if causes else ""
    return (
        f"{start} larger than their uncertainties explain ({law}, {probability}): {arm}, or there are "
        f"errors that the uncertainties do not include.{few}"
    )


def _of_probe(drift: Drift, probe: ProbeTest) -> str:
    share = 100 * (1 - probe.statistic / drift.joint_test.statistic)
    change = ", ".join(f"{name} by {in_words('mm', value)}" for name, value in probe.change)
    if not probe.remounted:
        return f"Not only the probe has changed: a remounted probe would explain only {share:.0f} % of the changes."
    start = f"Probe remounted: a change of the probe alone ({change}) explains {share:.0f} % of the changes"
    if not probe.p < 1 - drift.level:
        return f"{start}, and chance explains the rest, so the arm has not changed."
    return (
        f"{start}, but the rest (chi-squared {probe.statistic:.0f} with {probe.rank} degrees of freedom) is more than "
        "the uncertainties explain: either there are errors that the model does not describe, or the arm has changed "
        "slightly."
    )


def _of_each(drift: Drift) -> str:
    moved = np.flatnonzero(drift.moved)
    if not drift.compared:
        return ""
    chance = f"{drift.by_chance:.0f}" if drift.by_chance >= 0.95 else f"{drift.by_chance:.1g}"
    whose = "its" if len(moved) == 1 else "their"
    count = f"{len(moved) or 'None'} of {drift.compared} parameters changed by more than {whose} expanded uncertainty"
    changes = []
    for i in sorted(map(int, moved), key=lambda i: -abs(drift.change[i]) / drift.expanded[i]):
        name, unit, u = drift.names[i], drift.units[i], float(drift.expanded[i])
        changes.append(f"{name} by {in_words(unit, float(drift.change[i]))} (U = {in_words(unit, u, '')})")
    start = f"{count} ({in_percent(drift.level)}; {chance} expected by chance)"
    return f"{start}: {shorten(changes)}." if changes else f"{start}."


def _of_lengths(lengths: LengthChange, level: float) -> Iterator[str]:
    start = f"Lengths of {lengths.length:g} mm"
    if np.all(np.isfinite(lengths.u)):
        percent = 100 * float(np.mean(lengths.moved))
        yield (
            f"{start} over the volume changed by {lengths.rms:.4f} mm RMS, where the uncertainties alone would give "
            f"{lengths.rms_by_chance:.4f} mm, and by at most {lengths.largest:+.4f} mm; {percent:.0f} % of the lengths "
            f"changed by more than their expanded uncertainty ({100 * (1 - level):.2g} % expected by chance)."
        )
    else:
        yield (
            f"{start} over the volume changed by {lengths.rms:.4f} mm RMS and by at most {lengths.largest:+.4f} mm, "
            "but the data of one calibration do not determine all of these lengths, so this may not be drift."
        )
    if math.isfinite(lengths.u_scale_change):
        relation = "beyond" if abs(lengths.scale_change) > lengths.expanded_scale_change else "within"
        word = "longer" if lengths.scale_change > 0 else "shorter"
        expanded = 1e6 * lengths.expanded_scale_change
        decimals = 1 if expanded < 10 else 0  # no more than the uncertainty allows
        yield (
            f"On average, the new calibration measures these lengths {1e6 * abs(lengths.scale_change):.{decimals}f} "
            f"um/m {word} than the old one does (U = {expanded:.{decimals}f} um/m); this change is {relation} its "
            "uncertainty."
        )


def in_words(unit: str, value: float, sign: str = "+") -> str:
    """A change of a parameter of this unit, such as um of mm, to three digits."""
    factor, people_unit = people_read_change(unit)
    shown = factor * value
    decimals = max(2 - math.floor(math.log10(abs(shown))), 0) if shown else 0
    return f"{shown:{sign}.{min(decimals, 3)}f} {people_unit}"
