"""Sockets, placements, stations and sessions that contradict the others of a calibration, in sentences."""

from ..calibration.record import CalibrationRecord, Removed
from ..core.units import DEG
from ..diagnostics.contradictions import Cause, Contradiction, Suspect, contradictions_of
from ..diagnostics.equations import PROBE

_NAMED_ALIKE = ("socket", "observation")  # kinds whose groups are chosen by their own names


def contradictions(record: CalibrationRecord) -> list[str]:
    """Which groups contradict the others, and what to do; nearly always none."""
    return [_sentence(found, len(record.recording.capture.sessions)) for found in contradictions_of(record)]


def removals(record: CalibrationRecord) -> list[str]:
    """What the calibration left out, why, and what that changed."""
    return [_removal(removed) for removed in record.removed]


def _removal(removed: Removed) -> str:
    probability = "< 0.0001" if removed.probability < 1e-4 else f"= {removed.probability:.2g}"
    first, second = removed.degrees_of_freedom
    return (
        f"Left out: {removed.kind} {removed.group}, which contradicts the rest (F = {removed.ratio:.3g} with {first} "
        f"and {second} degrees of freedom, p {probability}). Without it, the rest is {removed.rms_without:.3g} mm RMS "
        f"from its geometry instead of {removed.rms_with:.3g} mm, and {removed.changed_most} changed most, by "
        f"{removed.change:.2g} standard uncertainties."
    )


def _sentence(found: Contradiction, sessions: int) -> str:
    kind, suspects = found.kind, found.suspects
    remounted = [suspect for suspect in suspects if suspect.cause is not None and suspect.cause.names == PROBE]
    if kind == "session" and remounted and len(suspects) in (1, sessions):
        return _remounted(remounted[-1])
    changes = "; ".join(_change(suspect) for suspect in suspects)
    options = " or ".join(f"--without '{pattern}'" for pattern in (_pattern(kind, suspect) for suspect in suspects))
    if len(suspects) == 1:
        return (
            f"{kind.capitalize()} {suspects[0].group} contradicts the other {_plural(kind)}: {changes}. "
            f"{_as_if(suspects[0].cause)}Check its readings, and calibrate without it ({options})."
        )
    return (
        f"Some {_plural(kind)} contradict each other, and the data do not show which of these is wrong: {changes}. "
        f"{_as_if(suspects[-1].cause, suspects[-1].group)}Check their readings, and calibrate without the wrong one "
        f"({options})."
    )


def _plural(kind: str) -> str:
    return "indices" if kind == "index" else f"{kind}s"


def _pattern(kind: str, suspect: Suspect) -> str:
    """A shell pattern that selects the group."""
    if kind in _NAMED_ALIKE or len(suspect.members) == 1:
        return suspect.members[0]
    inside = f"{suspect.group}/"
    return f"{inside}*" if all(name.startswith(inside) for name in suspect.members) else "' '".join(suspect.members)


def _change(suspect: Suspect) -> str:
    others, own = suspect.rms_others, suspect.rms
    return (
        f"without {suspect.group}, the others scatter by {others[1]:.2g} mm RMS instead of {others[0]:.2g} mm, and it "
        f"by {own[1]:.2g} mm instead of {own[0]:.2g} mm"
    )


def _as_if(cause: Cause | None, group: str = "it") -> str:
    if cause is None:
        return ""
    if cause.names == PROBE:
        return f"In {group}, the probe seems to be elsewhere by {_offset(cause)}. "
    kind, joint = cause.names[0].split("_")
    if kind == "d":
        return f"In {group}, joint {joint} seems to read {-cause.values[0]:+.3g} mm more. "
    return f"In {group}, joint {joint} seems to read {-cause.values[0] / DEG:+.3g} deg more. "


def _offset(cause: Cause) -> str:
    return f"{', '.join(f'{value:+.3g}' for value in cause.values)} mm (x, y, z of the last frame)"


def _remounted(suspect: Suspect) -> str:
    assert suspect.cause is not None
    return (
        f"Session {suspect.group} contradicts the other sessions, and a probe of its own explains "
        f"{100 * suspect.cause.share:.0f} % of that: the probe seems remounted, elsewhere by {_offset(suspect.cause)}. "
        "Calibrate with a probe for each session (without --same-probe)."
    )
