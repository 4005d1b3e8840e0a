"""Why data do not determine a coefficient of a joint correction.

In the poses of a capture its function is nearly 0, a constant (which is a zero offset) or a straight line (which is a
gear ratio).
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from ..core.text import listed, pluralise
from ..kinematics.arm import Arm
from ..kinematics.chain import forward_pass, joint_motion
from ..kinematics.corrected_arm import function_values
from ..kinematics.corrections.gears import GearRatio
from ..kinematics.corrections.gravity import Gravity
from ..kinematics.corrections.kind import Term

_ZERO = 1e-9  # of what the function is elsewhere
# Of the whole function: what is left of it beside a constant, or a straight line. A first harmonic leaves 5 % of itself
# over 20 deg, and 0.4 % beside a straight line over 60 deg.
_NEARLY = 0.06


def why_undetermined(
    arm: Arm, q: Float[np.ndarray, "N n"], groups: Iterable[tuple[tuple[str, ...], tuple[str, ...]]], sockets: int
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Reasons, one sentence for each joint and cause, and the names of coefficients without one.

    Args:
        arm: The arm with the corrections.
        q: The poses of the capture.
        groups: Names of parameters that the data do not, or hardly, tell apart, direction by direction: those that the
            direction is mostly of, and all.
        sockets: In how many sockets the poses are; 0 where they are seen in other ways.
    """
    if arm.corrections is None:
        return (), ()
    terms = {term.name: term for term in arm.corrections.functions.terms if isinstance(term, Term)}
    causes: dict[str, str] = {}
    for chief, names in groups:
        for name in chief:
            if name in terms and causes.get(name, "") != "line":  # which says more than that it is nearly constant
                causes[name] = _cause(arm, q, terms[name], names, sockets) or causes.get(name, "")
    names_by_cause: dict[tuple[str, int], list[str]] = {}
    for name, cause in causes.items():
        names_by_cause.setdefault((cause, terms[name].joint), []).append(name)
    sentences = tuple(
        _SENTENCES[cause].format(names=listed(names), joint=joint, travel=_travel(arm, q, joint), poses=_poses(q))
        for (cause, joint), names in names_by_cause.items()
        if cause
    )
    unexplained = [name for (cause, _), names in names_by_cause.items() if not cause for name in names]
    return sentences, tuple(dict.fromkeys(unexplained))


def by_more_sockets(names: Iterable[str]) -> str:
    """What poses in more sockets would determine."""
    return f"Poses in more sockets, over all of the workspace, would determine {listed(names)}."


_SENTENCES = {
    "vertical": "The axis of joint {joint} is vertical, so gravity has no moment about it: leave out {names}.",
    "lever": "What {names} would be loaded by lies on the axis of joint {joint}, so it has no moment: leave it out.",
    "zero": "{names}: the function is 0 in all {poses}; leave it out, or let other joints move.",
    "socket": "In one socket the moment of the tip about joint {joint} is nearly constant, so that {names} cannot be "
    "told from its zero offset: record poses in more sockets.",
    "constant": "Over the {travel} that joint {joint} moves, {names} cannot be told from its zero offset, as the "
    "function is nearly constant: let it move farther.",
    "moment": "In these poses the moment about joint {joint} is nearly constant, so that {names} cannot be told from "
    "its zero offset: let the arm move farther.",
    "line": "Over the {travel} that joint {joint} moves, {names} cannot be told apart, from its zero offset or from "
    "other parameters, as a straight line is nearly all of them: let it move farther.",
}


def _cause(arm: Arm, q: Float[np.ndarray, "N n"], term: Term, names: tuple[str, ...], sockets: int) -> str:
    """A key of `_SENTENCES`; empty where the function is none of these."""
    assert arm.corrections is not None
    nominal, gravity = arm.corrections.nominal, np.asarray(arm.gravity)
    elsewhere = q + np.random.default_rng(0).uniform(-np.pi, np.pi, q.shape)
    (everywhere,) = function_values(nominal, [term], elsewhere, gravity)
    (here,) = function_values(nominal, [term], q, gravity)
    by_gravity = isinstance(term.kind, Gravity)
    size = np.abs(everywhere).max()
    if by_gravity and is_vertical(arm, elsewhere, term.joint):
        return "vertical"
    if by_gravity and size < _ZERO:
        return "lever"
    if np.abs(here).max() < _ZERO * size:
        return "zero"
    offset = ("d" if term.joint in arm.prismatic else "theta") + f"_{term.joint}"
    gear = f"{GearRatio().words[0]}_{term.joint}"
    reading = q[:, term.joint - 1]
    constant, straight = [np.ones(len(q))], [np.ones(len(q)), reading]
    harmonics = [wave(reading) for word, wave in (("cos", np.cos), ("sin", np.sin)) if f"{word}1_{term.joint}" in names]
    lines = [here] if term.name != gear else harmonics
    if offset in names and _left(here, constant) < _NEARLY * size:
        return ("socket" if sockets == 1 else "moment") if by_gravity else "constant"
    is_line = any(_left(each, straight) < _NEARLY * np.abs(each).max() for each in lines)
    return "line" if is_line and not by_gravity else ""


def is_vertical(arm: Arm, q: Float[np.ndarray, "N n"], joint: int) -> bool:
    """Whether the axis of a joint is along gravity in all these poses."""
    assert arm.corrections is not None
    nominal = arm.corrections.nominal
    axis = np.asarray(forward_pass(nominal, joint_motion(nominal, q)).z_before[joint - 1])
    across = np.cross(np.moveaxis(axis, -2, -1), np.asarray(arm.gravity))
    return bool(np.abs(across).max() < _ZERO)


def _left(values: Float[np.ndarray, " N"], rows: list[np.ndarray]) -> float:
    """The largest part that no combination of rows explains."""
    basis = np.stack(rows, axis=1)
    return float(np.abs(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]).max())


def _travel(arm: Arm, q: Float[np.ndarray, "N n"], joint: int) -> str:
    travel = float(np.ptp(q[:, joint - 1]))
    return f"{travel:.3g} mm" if joint in arm.prismatic else f"{np.degrees(travel):.0f} deg"


def _poses(q: Float[np.ndarray, "N n"]) -> str:
    return pluralise(len(q), "pose")
