"""Why data do not determine a coefficient of a joint correction: in the poses of a capture its function is nearly 0, a
constant (which is a zero offset) or a straight line (which is a gear ratio)."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from ..core.text import listed, pluralise
from ..kinematics.arm import Arm
from ..kinematics.corrected_arm import function_values
from ..kinematics.corrections import GearRatio, Gravity, Term

_ZERO = 1e-9  # of what the function is elsewhere
# Of the whole function: what is left of it beside a constant, or a straight line. A first harmonic leaves 5 % of itself
# over 20 deg, and 0.4 % beside a straight line over 60 deg.
_NEARLY = 0.06
_SENTENCES = {
    "zero": "{names}: the function is 0 in all {poses}, as the moment of gravity about a vertical axis is; leave it "
    "out, or let other joints move.",
    "constant": "Over the {travel} that joint {joint} moves, {names} cannot be told from its zero offset, as the "
    "function is nearly constant: let the arm move farther, and record poses in more sockets.",
    "line": "Over the {travel} that joint {joint} moves, {names} cannot be told apart, from its zero offset or from "
    "other parameters, as a straight line is nearly all of them: let it move farther.",
}


def why_undetermined(
    arm: Arm, q: Float[np.ndarray, "N n"], groups: Iterable[tuple[tuple[str, ...], tuple[str, ...]]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons, one sentence for each joint and cause, and the names of coefficients without one.

    ``q`` are the poses of the capture, ``groups`` the names of parameters that the data do not, or hardly, tell apart,
    direction by direction: those that the direction is mostly of, and all.
    """
    if arm.corrections is None:
        return (), ()
    terms = {term.name: term for term in arm.corrections.functions.terms if isinstance(term, Term)}
    causes: dict[str, str] = {}
    for chief, names in groups:
        for name in chief:
            if name in terms and causes.get(name, "") != "line":  # which says more than that it is nearly constant
                causes[name] = _cause(arm, q, terms[name], names) or causes.get(name, "")
    names_by_cause: dict[tuple[str, int], list[str]] = {}
    for name, cause in causes.items():
        names_by_cause.setdefault((cause, terms[name].joint), []).append(name)
    sentences = []
    for (cause, joint), names in names_by_cause.items():
        travel = float(np.ptp(q[:, joint - 1]))
        moves = f"{travel:.3g} mm" if joint in arm.prismatic else f"{np.degrees(travel):.0f} deg"
        if cause:
            sentences.append(
                _SENTENCES[cause].format(
                    names=listed(names), joint=joint, travel=moves, poses=pluralise(len(q), "pose")
                )
            )
    return tuple(sentences), tuple(name for name, cause in causes.items() if not cause)


def _cause(arm: Arm, q: Float[np.ndarray, "N n"], term: Term, names: tuple[str, ...]) -> str:
    """A key of `_SENTENCES`; empty where the function is none of these."""
    assert arm.corrections is not None
    elsewhere = q + np.random.default_rng(0).uniform(-np.pi, np.pi, q.shape)
    everywhere, here = (
        function_values(arm.corrections.nominal, [term], poses, np.asarray(arm.gravity))[0] for poses in (elsewhere, q)
    )
    size = np.abs(everywhere).max()
    if size < _ZERO or np.abs(here).max() < _ZERO * size:
        return "zero"
    offset = f"{'d' if term.joint in arm.prismatic else 'theta'}_{term.joint}"
    reading, one = q[:, term.joint - 1], np.ones(len(q))
    if offset in names and _left(here, [one]) < _NEARLY * size:
        return "constant"
    lines = [] if isinstance(term.kind, Gravity) else [here]
    if term.name == f"{GearRatio().words[0]}_{term.joint}":  # the line itself, which harmonics may imitate
        waves = {f"cos1_{term.joint}": np.cos(reading), f"sin1_{term.joint}": np.sin(reading)}
        lines = [values for name, values in waves.items() if name in names]
    return "line" if any(_left(line, [one, reading]) < _NEARLY * np.abs(line).max() for line in lines) else ""


def _left(values: Float[np.ndarray, " N"], rows: list[np.ndarray]) -> float:
    """The largest part that no combination of rows explains."""
    basis = np.stack(rows, axis=1)
    return float(np.abs(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]).max())
