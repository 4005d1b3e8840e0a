"""Errors that poses share: drawn anew for Monte Carlo trials, and what they do to lengths between sockets."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import Arm, by_joint
from ..kinematics.corrected_arm import function_values, with_further_corrections
from ..kinematics.corrections.kinds import term_of
from ..uncertainty.shared_errors import SharedErrors
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS


class DrawnErrors(NamedTuple):
    """Of some trials, of all M poses, those of sockets first."""

    tips: Float[np.ndarray, "t M 3"]  # mm
    joints: Float[np.ndarray, "t M n"]  # what the readings are too large by, rad or mm
    coefficients: Float[np.ndarray, "t k"]  # of the functions that the model lacks


def draw_shared(
    shared: SharedErrors | None, arm: Arm, capture: Capture, count: int, random: np.random.Generator
) -> DrawnErrors | None:
    """Errors of some trials; None where a calibration has none."""
    if shared is None:
        return None
    q = np.asarray(capture.readings)
    tips = np.zeros((count, len(q), 3))
    law = shared.law.in_numpy
    for i, root in enumerate(_roots(shared, capture)):
        # A variance that few places show is itself uncertain, so it is drawn too (JCGM 101, 6.4.9).
        sd = np.sqrt(random.choice(law.ratios[i], size=(count, 1, 1), p=law.weights[i] / law.weights[i].sum()))
        tips += np.einsum("Mc,tcd->tMd", root, sd * random.normal(size=(count, root.shape[1], 3)))
    values, joints = functions_of(shared.names, arm, q)
    factor = _root(np.asarray(shared.moments))
    coefficients = random.normal(size=(count, len(shared.names))) @ factor.T
    turned = np.zeros((count, *q.shape))
    for k, joint in enumerate(joints):
        turned[:, :, joint] += coefficients[:, k, None] * values[:, k]
    return DrawnErrors(tips, turned, coefficients)


def functions_of(
    names: tuple[str, ...], arm: Arm, q: Float[np.ndarray, "M n"]
) -> tuple[Float[np.ndarray, "M k"], np.ndarray]:
    """Values of functions by the names of their coefficients, and the joint (from 0) of each."""
    if not names:
        return np.zeros((len(q), 0)), np.zeros(0, dtype=int)
    wider: Arm = to_numpy(with_further_corrections(arm, names))
    assert wider.corrections is not None
    joints = arm.joints
    terms = [term for name in names if (term := term_of(name, joints)) is not None]
    values = function_values(wider.corrections.nominal, terms, q, np.asarray(wider.gravity)).T
    return values, np.array([term.joint - 1 for term in terms])


def places_of(capture: Capture) -> Float[np.ndarray, "M p"]:
    """1 for the poses of each socket or observation that a reference length starts or ends at, a column each."""
    ends = {end for length in capture.lengths for end in (length.start, length.end)}
    used = [i for i, name in enumerate(_names(capture)) if name in ends]
    return (_owner(capture)[:, None] == used).astype(float)


def covariance_of_lengths(
    shared: SharedErrors, arm: Arm, names: tuple[str, ...], capture: Capture
) -> Float[np.ndarray, "l l"]:
    """Covariance of the distances between ends of the reference lengths, as an arm measures them, by errors that poses
    share, mm^2. Errors of the tip move the mean of an end; how parameters follow these is left out, as it is small.

    Args:
        shared: The errors.
        arm: The calibrated arm.
        names: Its parameters that were free.
        capture: What it was calibrated from.
    """
    q, owner, of = np.asarray(capture.readings), _owner(capture), _names(capture)
    means = {name: (owner == of.index(name)) / np.sum(owner == of.index(name)) for name in of}
    between = np.array([means[length.end] - means[length.start] for length in capture.lengths])
    directions = between @ np.asarray(arm.position(q))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    found = np.zeros((len(between), len(between)))
    for root in _roots(shared, capture):
        moved = between @ root
        found = found + (directions @ directions.T) * (moved @ moved.T)
    if shared.names:
        values, joints = functions_of(shared.names, arm, q)
        angles = tuple(f"{kind}_{i}" for i, kind in enumerate(by_joint(arm, "theta", "d"), start=1))
        tips = np.asarray(arm.jacobian(q, angles))[:, :, joints] * values[:, None]
        tips = tips + np.asarray(arm.jacobian(q, names)) @ np.asarray(shared.follow)
        columns = np.einsum("lc,lN,Nck->lk", directions, between, tips)
        found = found + columns @ np.asarray(shared.moments) @ columns.T
    return found


def _names(capture: Capture) -> list[str]:
    return [*capture.names, *(observation.name for observation in capture.observations)]


def _owner(capture: Capture) -> np.ndarray:
    """Number of the socket or observation of each pose."""
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    return np.repeat(np.arange(len(sizes)), sizes)


def _roots(shared: SharedErrors, capture: Capture) -> list[Float[np.ndarray, "M c"]]:
    """Square roots of the covariances of a tip coordinate over the poses, one for each kind that moves tips."""
    found, owner = [], _owner(capture)
    total = len(owner)
    for kind, sd in zip(shared.kinds, np.asarray(shared.sd), strict=True):
        if kind == PLACES:
            found.append(sd * places_of(capture))
        elif kind == VISITS and capture.visits is not None:
            visits = np.full(total, -1)
            visits[: len(capture.visits)] = capture.visits
            found.append(sd * (visits[:, None] == [number for number in np.unique(visits) if number >= 0]))
        elif kind == SUCCESSIVE:
            root = np.zeros((total, total))
            for i, size in enumerate(np.bincount(owner)):
                order, own = np.arange(size), np.flatnonzero(owner == i)
                kernel = np.exp(-np.abs(order[:, None] - order) / float(shared.correlation_length))
                root[np.ix_(own, own)] = sd * np.linalg.cholesky(kernel)
            found.append(root)
    return found


def _root(moments: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    values, vectors = np.linalg.eigh(moments)
    return vectors * np.sqrt(np.maximum(values, 0.0))
