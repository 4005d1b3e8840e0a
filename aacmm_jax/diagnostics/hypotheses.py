"""What single mistakes and faults do to the rows of the poses, besides functions of the readings (`missing_terms`).

Each is a `MissingTerm`: columns in the linear equations of a calibration. A zero that slips, a base, instrument or
probe that is moved, a load that is put on, and a seat that is shifted have a function that is 0 before some pose and 1
from it on. A joint that follows another one has the reading of that joint. A parameter that is fixed at a wrong value
has the column that it would have if it were free.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import Arm, by_joint, is_length
from ..kinematics.chain import forward_pass, joint_motion
from .missing_terms import MissingTerm

_STEPS = 16  # poses at which something may change, evenly chosen: between two of these, little of the gain is lost
_LOADS = 2  # of these, every so many for the load, which has many functions
_STEPS_OF_GROUP = 6
_FEWEST = 6  # poses on each side of a step
_FEWEST_OF_GROUP = 3
_BASE, _PROBE = "a base, artefact or instrument that was moved", "a probe or target that was displaced"
_MOST_GROUPS = 40  # sockets and holes of artefacts, beyond which no steps within single ones are looked for


def pose_names(capture: Capture) -> tuple[list[str], list[str], list[str]]:
    """Of each pose, in the order of the readings: its name, its socket or observation, and that with its hole."""
    names, owners, places = [], [], []
    sockets = [(name, len(q), ()) for name, q in capture.sockets.items()]
    measured = [(o.name, o.q.shape[0], getattr(o, "point", ())) for o in capture.observations]
    for name, count, points in (*sockets, *measured):
        names += [f"{name} pose {i + 1}" for i in range(count)]
        owners += [name] * count
        places += [f"{name}, {point}" for point in points] if len(points) == count else [name] * count
    return names, owners, places


def steps(
    arm: Arm, capture: Capture, gravity: Sequence[MissingTerm], near: MissingTerm | None = None
) -> list[MissingTerm]:
    """What may change from one pose to the next: zeros, the base or an instrument, the probe, and the load; ``gravity``
    are the functions of the load. Steps at poses that are evenly chosen, or at all poses ``near`` that of another."""
    arm, q = to_numpy(arm), np.asarray(capture.readings)
    forward, (names, _, _) = forward_pass(arm.geometry, joint_motion(arm.geometry, q)), pose_names(capture)
    turned = np.stack([np.moveaxis(np.asarray(axis), 0, -1).reshape(-1, 3) for axis in forward.frame], axis=2)
    always, changes = np.ones((len(q), 1)), []  # what each would be if it were so at all poses
    for joint in range(1, arm.joints + 1):
        follows, cause = f"a step of the zero of joint {joint}", "a zero offset that slips"
        changes.append(MissingTerm("slipped zero", joint, always, False, follows, cause, f"joint {joint}"))
    base, probe = "a displacement of the base, artefact or instrument", "a displacement of the probe on the arm"
    changes.append(MissingTerm("moved base", None, always[:, :, None] * np.eye(3), False, base, _BASE))
    changes.append(MissingTerm("moved probe", None, turned, False, probe, _PROBE))
    for load in gravity:
        follows, cause = f"a change of the load on joint {load.joint}", "a payload that was put on or taken off"
        changes.append(load._replace(kind="payload", follows=follows, cause=cause))
    places = np.unique(np.linspace(_FEWEST, len(q) - _FEWEST, _STEPS).astype(int))
    if near is not None:
        between = (_LOADS if near.kind == "payload" else 1) * (len(q) // _STEPS + 1)
        places = np.arange(near.first - between, near.first + between + 1)
        changes = [change for change in changes if (change.kind, change.concerns) == (near.kind, near.concerns)]
    terms = []
    for number, first in enumerate(int(place) for place in places if 0 < place < len(q)):
        for change in changes:
            if near is None and change.kind == "payload" and number % _LOADS:
                continue
            values = np.array(change.values)
            values[:first] = 0.0
            follows = f"{change.follows} from {names[first]} on"
            terms.append(change._replace(values=values, follows=follows, first=first))
    return terms


def shifted_seats(capture: Capture, near: MissingTerm | None = None) -> list[MissingTerm]:
    """A step of the tip within one socket, or within one hole or other place of an artefact: at some of its poses, or
    at every pose of the place of another one that is ``near``."""
    names, owners, places = pose_names(capture)
    terms, labels = [], np.array(places)
    distinct = list(dict.fromkeys(places))
    if not 1 < len(distinct) <= _MOST_GROUPS:
        return []
    for place in distinct:
        poses = np.flatnonzero(labels == place)
        last, number = len(poses) - _FEWEST_OF_GROUP, _STEPS_OF_GROUP if near is None else len(poses)
        if last < _FEWEST_OF_GROUP or (near is not None and near.first not in poses):
            continue
        for first in np.unique(np.linspace(_FEWEST_OF_GROUP, last, number).astype(int)):
            later = np.isin(np.arange(len(labels)), poses[first:]).astype(float)
            follows = f"a displacement of {place} from {names[poses[first]]} on"
            term = MissingTerm("shifted seat", None, later[:, None, None] * np.eye(3), follows=follows)
            term = term._replace(first=int(poses[first]))
            cause = f"a {'seat' if capture.sizes else 'target, station'} or artefact that shifts"
            terms.append(term._replace(cause=cause, concerns=owners[poses[0]]))
    return terms


def couplings(arm: Arm, q: Float[np.ndarray, "N n"]) -> list[MissingTerm]:
    """Each joint by the reading of each other one."""
    terms, slides = [], np.array(by_joint(arm, False, True))
    for joint in range(1, arm.joints + 1):
        for other in range(1, arm.joints + 1):
            if other == joint or slides[joint - 1] or slides[other - 1]:
                continue
            term = MissingTerm("coupling", joint, q[:, [other - 1]], relative=True, cause="a coupling of joints")
            follows = f"a coupling of joint {joint} with the reading of joint {other}"
            correction = ("coupled", f"{other}-{joint}")
            terms.append(term._replace(follows=follows, concerns=f"joint {joint}", correction=correction))
    return terms


def fixed_parameters(names: Sequence[str], free: Sequence[str], joints: int, poses: int) -> list[MissingTerm]:
    """Each parameter that is fixed; ``names`` are those of `Rows.extra`, of which the first are zeros of joints."""
    always = np.ones((poses, 1))
    return [
        MissingTerm("fixed", None, always, relative=True, follows=name, concerns=name, column=column)
        for column, name in enumerate(names)
        if column >= joints and name not in free
    ]


def fixed_text(term: MissingTerm, coefficient: float) -> str:
    """By how much a fixed parameter is off: mm, or deg."""
    size = abs(coefficient)
    return f"{size:.2g} mm" if is_length(term.concerns) else f"{np.degrees(1e-3 * size):.2g} deg"
