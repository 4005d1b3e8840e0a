"""Inconsistent groups of a calibration (sockets, stations, placements, sessions), and recalibration without them."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration.record import CalibrationRecord, Removed, record_of
from ..calibration.results import Calibration, Identification
from ..core.errors import InputError
from ..core.text import f_text
from ..core.units import DEG
from ..data.capture import Capture, names_in, part_of
from ..data.observations.held import Socket
from .culprits import culprits_of
from .equations import (
    EXACT,
    PROBE,
    Block,
    Equations,
    GroupTest,
    Rows,
    contradicting_groups,
    different_groups,
    fit_of,
    lengths_in_solve,
)
from .findings import Case, Finding, case_of, chance_text

ORDER, NEEDS = 30, "scale"
POSE, POSES = "pose", "poses"  # kinds of what was left out
LEFT_OUT = "left-out"  # code of the finding on a group that the calibration left out
# Mean square that a group adds over that of the others: errors outside the D-H model make it 7 on real arms, and it
# is 1 where there are none.
_LEAST_RATIO = 9.0
# The same for parameters of a session's or station's own, and for a probe of its own: on real arms 5 and 9 between
# halves of one session, 43 and 239 between sessions with a remounted probe.
_LEAST_DIFFERENCE, _LEAST_REMOUNTED = 16.0, 50.0
_LEVEL = 0.01
_EXPLAINS = 0.67  # share of a contradiction that a single cause must explain to be named
_AMID = 2  # poses of a group before and after a change, by which it lies within the group and not at its border
_LARGE = ("session", "station")  # kinds of groups with more poses than parameters
_NAMED_ALIKE = ("socket", "observation")  # kinds whose groups are chosen by their own names


class Cause(NamedTuple):
    """An error of one group alone that explains why it contradicts the others."""

    names: tuple[str, ...]  # the joint's zero, or the three coordinates of the probe
    values: Float[np.ndarray, " k"]  # what they are there, less what they are for the others, rad or mm
    share: float  # of the contradiction that this explains
    ratio: float  # F of these unknowns


class Suspect(NamedTuple):
    """A group without which the others agree."""

    group: str
    members: tuple[str, ...]  # sockets and observations
    test: GroupTest
    rms: tuple[float, float]  # mm: of its poses, in the calibration from all and in that from the others
    rms_others: tuple[float, float]
    cause: Cause | None


class Contradiction(NamedTuple):
    """A group that contradicts the others; where the data do not show which of several is wrong, all of these."""

    kind: str  # "socket", "observation", "placement", "station", "target", "index" or "session"
    suspects: tuple[Suspect, ...]


def test(case: Case) -> list[Finding]:
    """What the calibration left out, and groups that contradict the others; nearly always nothing."""
    removed = [removal(group) for group in case.record.removed]
    return removed + [_finding(contradiction) for contradiction in case.once(_contradictions)]


def removal(removed: Removed) -> Finding:
    """A group that the calibration left out."""
    first, second = removed.degrees_of_freedom
    these = "these poses" if removed.kind == POSES else f"this {removed.kind}"
    subject, contradict = f"{removed.kind} {removed.group}", "contradicts"
    if removed.kind in (POSE, POSES):
        subject, contradict = removed.group, "contradict" if removed.kind == POSES else "contradicts"
    return Finding(
        LEFT_OUT,
        f"Left out: {subject}, which {contradict} the other data (F {f_text(removed.ratio)} with "
        f"{first} and {second} degrees of freedom, {chance_text(removed.probability)}).",
        f"Without {these}, the other poses are {removed.rms_without:.3g} mm RMS from their geometry "
        f"instead of {removed.rms_with:.3g} mm. The parameter that changed most is {removed.changed_most}, by "
        f"{removed.change:.2g} standard uncertainties.",
        probability=removed.probability,
        concerns=removed.members,
        explains=1.0,  # of what it contradicted, all; it is read before causes of what remains
    )


def _finding(contradiction: Contradiction) -> Finding:
    kind, suspects = contradiction
    cause, seems = suspects[-1].cause, ""
    remounted = kind == "session" and cause is not None and cause.names == PROBE
    if cause is not None and cause.names == PROBE:
        offset = ", ".join(f"{value:+.3g}" for value in cause.values)
        seems = f" In {suspects[-1].group}, the probe seems displaced by {offset} mm (x, y, z of the last frame)."
    elif cause is not None:
        sort, joint = cause.names[0].split("_")
        more = f"{-cause.values[0]:+.3g} mm" if sort == "d" else f"{-cause.values[0] / DEG:+.3g} deg"
        seems = f" In {suspects[-1].group}, the readings of joint {joint} seem to have an offset of {more}."
    # Whichever session is the wrong one, the probe of each other one is displaced from it.
    suspects = suspects[-1:] if remounted else suspects
    changes = "; ".join(
        f"without {suspect.group}, the others scatter by {suspect.rms_others[1]:.2g} mm RMS instead of "
        f"{suspect.rms_others[0]:.2g} mm, and {suspect.group} scatters by {suspect.rms[1]:.2g} mm instead of "
        f"{suspect.rms[0]:.2g} mm"
        for suspect in suspects
    )
    patterns = []  # of a shell, which select the groups
    for suspect in suspects:
        inside, members = f"{suspect.group}/", suspect.members
        if kind in _NAMED_ALIKE or len(members) == 1:
            patterns.append(members[0])
        else:
            alike = all(name.startswith(inside) for name in members)
            patterns.append(f"{inside}*" if alike else "' '".join(members))
    options = " or ".join(f"--without '{pattern}'" for pattern in patterns)
    plural = "indices" if kind == "index" else f"{kind}s"
    says = (
        f"{kind.capitalize()} {suspects[0].group} contradicts the other {plural}"
        if len(suspects) == 1
        else f"Some {plural} contradict each other, and the data do not show which of them is wrong"
    )
    return Finding(
        "contradiction",
        f"{says}: {changes}.{seems}",
        advice="Calibrate with a separate probe for each session (omit --same-probe)."
        if remounted
        else f"Check the readings, and leave what is wrong out of the calibration ({options}).",
        probability=max(suspect.test.probability for suspect in suspects),
        concerns=tuple(name for suspect in suspects for name in suspect.members),
    )


def groupings(capture: Capture) -> dict[str, dict[str, str | None]]:
    """Kinds of groups, the largest ones first -> sockets and observations with their group of this kind."""
    names = names_in(capture)
    divisions: dict[str, dict[str, str | None]] = {}
    if capture.sessions:
        divisions["session"] = {name: capture.session_of(name) for name in names}
    sockets = {*capture.names, *(o.name for o in capture.observations if isinstance(o, Socket))}
    for kind in ("station", "target", "index"):
        divisions[kind] = dict.fromkeys(names) | {o.name: getattr(o, kind, None) for o in capture.observations}
    divisions["target"] = {name: label or None for name, label in divisions["target"].items()}
    placed = {o.name: getattr(o, "placement", None) for o in capture.observations}
    alone = len(sockets) == len(names)
    placed |= {name: name.rpartition("/")[0] or (name if alone else None) for name in sockets}
    single: dict[str, str | None] = {name: name for name in names}
    # Of equal divisions the first is kept, and it is named in the words of a user.
    divisions |= {"socket": single, "placement": placed} if alone else {"placement": placed, "observation": single}
    kinds: dict[frozenset[frozenset[str]], tuple[str, dict[str, str | None]]] = {}
    for kind, labels in divisions.items():
        groups = dict.fromkeys(labels.values())
        division = frozenset(frozenset(n for n, label in labels.items() if label == group) for group in groups)
        if len(division) > 1:
            kinds.setdefault(division, (kind, labels))
    return dict(kinds.values())


def contradictions_of(record: CalibrationRecord) -> list[Contradiction]:
    """The groups that contradict the others; nearly always none.

    Every group is tested by the poses of the others (`diagnostics.equations`), which takes milliseconds. Of all kinds
    of groups the one that shows the contradiction best is reported: an error of a whole placement shows less in one of
    its sockets, and that of one socket less in its placement.

    Args:
        record: a calibration from sockets, lengths and any other observations.

    Returns:
        One for each group to take out, one after the other.

    Example:
        >>> print(aj.diagnostics.contradictions_of(record))
        []
    """
    return case_of(record).once(_contradictions)


def _contradictions(case: Case) -> list[Contradiction]:
    if changed_within_a_group(case):
        return []
    record, best = case.record, []
    equations, kinds = without_bad_poses(case), groupings(record.recording.capture)
    # The lengths that alone fix the scale: these equations keep no length of the arm.
    alone = case.equations.anchor is None and lengths_in_solve(record) and record.prior is None
    alone = alone and not any(part.fixes_scale for part in record.recording.capture.observations)
    scaling = record.recording.capture.lengths if alone else ()
    kind, labels = "", {}
    for candidate, groups in kinds.items():
        blocks = equations.grouped(groups)
        scales = [frozenset((groups[length.start], groups[length.end])) for length in scaling]
        choices = [contradicting_groups(blocks, level=_LEVEL, least_ratio=_LEAST_RATIO, scales=scales)]
        # An unlikely error of a few poses does not hide one that all poses of a session share.
        if candidate in _LARGE:
            choices.append(_different(equations, blocks, groups))
        for tests in choices:
            # Kinds with the same group differ by rounding.
            if tests and (not best or tests[0][0].ratio > (1 + 1e-9) * best[0][0].ratio):
                best, kind, labels = tests, candidate, groups
    contradictions = [Contradiction(kind, tuple(_suspect(equations, labels, test) for test in group)) for group in best]
    negligible = contradictions and contradictions[0].suspects[0].rms_others[0] < EXACT
    return [] if negligible else contradictions


def changed_within_a_group(case: Case) -> bool:
    """Whether something changed at a pose amid a group, which explains why groups before and after it differ."""
    firsts = [
        culprit.term.term.first
        for culprit in culprits_of(case)
        if culprit.term is not None and culprit.term.term.first >= 0 and culprit.explains > _EXPLAINS
    ]
    amid = [part.poses[_AMID:-_AMID] for part in case.equations.rows]
    return any(first in poses for first in firsts for poses in amid)


def without_bad_poses(case: Case) -> Equations:
    """The equations without single poses that explain the residuals: no group is wrong because one of its poses is."""
    bad = [culprit.number for culprit in culprits_of(case) if culprit.kind == "pose"]
    if not bad:
        return case.equations
    rows = [part.at(~np.isin(part.poses, bad)) for part in case.equations.rows]
    return case.equations._replace(rows=[part for part in rows if len(part.poses)])


def _different(
    equations: Equations, blocks: Sequence[Block], labels: Mapping[str, str | None]
) -> list[list[GroupTest]]:
    """The group whose own parameters, or own probe, differ from those of the others, and those that do so as well."""
    tests, different = different_groups(blocks), []
    for test in tests:
        cause = _cause(equations, [name for name, label in labels.items() if label == test.group])
        remounted = cause is not None and cause.names == PROBE and cause.ratio > _LEAST_REMOUNTED
        significant = test.probability * len(tests) < _LEVEL
        if significant and (test.ratio > _LEAST_DIFFERENCE or remounted):
            different.append(test)
    return [[test for test in different if test.variance < 1.1 * different[0].variance]] if different else []


def _suspect(equations: Equations, labels: Mapping[str, str | None], test: GroupTest) -> Suspect:
    members = tuple(name for name, label in labels.items() if label == test.group)
    group = [rows for rows in equations.rows if rows.name in members]
    others = [rows for rows in equations.rows if rows.name not in members]
    # Geometry that only this group has is open in the least squares of the others, and follows its poses.
    loose = ~np.any([np.any(rows.shared, axis=(0, 1)) for rows in others], axis=0)
    step, following = np.where(loose, 0.0, test.step), []
    for block in (rows.block("") for rows in group):
        residual = block.residual + block.shared @ step
        following.append(block._replace(residual=residual, shared=block.shared[:, loose]))
    step[loose] = fit_of(following).step
    rms, rms_others = ((rms_of(rows, 0 * step), rms_of(rows, step)) for rows in (group, others))
    return Suspect(str(test.group), members, test, rms, rms_others, _cause(equations, members))


def rms_of(rows: Sequence[Rows], step: Float[np.ndarray, " s"]) -> float:
    """Root mean square distance of poses from their geometry, mm, after a step."""
    return float(np.sqrt(np.mean(np.concatenate([part.squares(step) for part in rows]))))


def _cause(equations: Equations, members: Sequence[str]) -> Cause | None:
    """The zero of a joint, or else the probe, that explains why some observations contradict the others."""
    blocks = [b._replace(group="members" if b.fixture in members else b.group) for b in equations.blocks()]
    whole = fit_of(blocks)
    apart = sum(fit_of([block for block in blocks if block.group in (group, None)]).cost for group in ("", "members"))
    contradicted = max(whole.cost - apart, 1e-300)
    best = None
    joints = equations.extra.index(PROBE[0])
    for names in (*((name,) for name in equations.extra[:joints]), PROBE):
        fitted = fit_of(equations.blocks(members, names))
        added = whole.degrees_of_freedom - fitted.degrees_of_freedom
        gain, variance = whole.cost - fitted.cost, max(fitted.cost / max(fitted.degrees_of_freedom, 1), 1e-300)
        if added == len(names) and gain > _EXPLAINS * contradicted and (best is None or gain > 1.05 * best[0]):
            indices = [equations.extra.index(name) for name in names]
            values = fitted.step[-added:] * equations.steps[indices]
            best = gain, Cause(names, values, gain / contradicted, gain / added / variance)
    return None if best is None else best[1]


def session_metrics(record: CalibrationRecord) -> dict[str, tuple[int, float, float]]:
    """Sessions -> number of poses, their RMS distance from the geometry, and that which the session would have alone
    (one Gauss-Newton step away), mm; nothing without sessions. A socket's single pose, whose distance is 0, does not
    count.

    Args:
        record: A calibration of captures that `join_sessions` joined.

    Example:
        >>> monday = aj.simulate(true, {"A": (400, 200, 300)}, poses=20, noise=noise, seed=1)
        >>> friday = aj.simulate(true, {"A": (500, 200, 300)}, poses=20, noise=noise, seed=2)
        >>> both = aj.join_sessions({"monday": monday, "friday": friday})
        >>> stage1 = aj.identify(arm, both, bounds)
        >>> of_both = aj.calibration.record_of(stage1, aj.Recording(both, nominal))
        >>> for session, (poses, rms, alone) in aj.diagnostics.session_metrics(of_both).items():
        ...     print(session, poses, f"{rms:.3f} mm")
        monday 20 0.011 mm
        friday 20 0.010 mm
    """
    capture = record.recording.capture
    if not capture.sessions:
        return {}
    equations, metrics = case_of(record).equations, {}
    for session in capture.sessions:
        of_session = [rows for rows in equations.rows if capture.session_of(rows.name) == session]
        if of_session:
            alone = fit_of([*(rows.block("") for rows in of_session), *equations.relations]).step
            poses = sum(len(rows.residual) for rows in of_session)
            metrics[session] = poses, rms_of(of_session, np.zeros_like(alone)), rms_of(of_session, alone)
    return metrics


def remove_contradicting(
    record: CalibrationRecord, solve: Callable[[Capture], Calibration | Identification | CalibrationRecord]
) -> CalibrationRecord:
    """A calibration without the groups that contradict the others, one after the other; as it is where none does.

    Where the data do not show which of several groups is wrong, none of them is taken out.

    Args:
        record: the calibration of everything.
        solve: calibrates another capture likewise.

    Returns:
        The calibration of what remains. ``removed`` says what was taken out, why, and what that changed.

    Example:
        >>> kept = aj.diagnostics.remove_contradicting(record, lambda other: aj.calibrate(arm, other, bounds))
        >>> print(kept.removed)
        ()
    """
    most = sum(len(set(labels.values())) for labels in groupings(record.recording.capture).values()) // 2
    for _ in range(most):
        clear = [contradiction for contradiction in contradictions_of(record) if len(contradiction.suspects) == 1]
        if not clear:
            break
        (suspect,) = clear[0].suspects
        capture = record.recording.capture
        kept = tuple(name for name in names_in(capture) if name not in suspect.members)
        try:
            rest = part_of(capture, kept)
            again = solve(rest)
        except InputError:  # what is left does not determine the arm, so nothing can be said without this group
            break
        if not isinstance(again, CalibrationRecord):
            again = record_of(again, record.recording._replace(capture=rest), robust=record.robust)
        removed = Removed(
            kind=clear[0].kind,
            group=suspect.group,
            members=suspect.members,
            ratio=suspect.test.ratio,
            degrees_of_freedom=suspect.test.degrees_of_freedom,
            probability=suspect.test.probability,
            rms_with=suspect.rms_others[0],
        )
        record = with_removed(record, again, [removed])
    return record


def with_removed(record: CalibrationRecord, again: CalibrationRecord, removed: Sequence[Removed]) -> CalibrationRecord:
    """The calibration without what was left out of another one, and what that changed."""
    changed = np.abs(again.vectors()["calibrated"] - record.vectors()["calibrated"])
    u = np.sqrt(np.diag(record.covariance))
    changes = np.where(u > 0, changed / np.where(u > 0, u, 1.0), 0.0)
    worst, rows = int(np.argmax(changes)), case_of(again).equations.rows
    after: dict[str, Any] = {"rms_without": rms_of(rows, np.zeros(rows[0].shared.shape[2]))}
    after |= {"changed_most": again.names[worst], "change": float(changes[worst])}
    return again._replace(removed=(*record.removed, *(part._replace(**after) for part in removed)))
