"""Errors that poses share, drawn anew for Monte Carlo trials: of the tip of every pose, and of what joints do."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import Arm
from ..kinematics.corrected_arm import function_values, with_further_corrections
from ..kinematics.corrections.kinds import term_of
from ..uncertainty.shared_errors import PLACES, SUCCESSIVE, VISITS, SharedErrors


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
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    tips = np.zeros((count, len(q), 3))
    for root in _roots(shared, capture, sizes):
        tips += np.einsum("Mc,tcd->tMd", root, random.normal(size=(count, root.shape[1], 3)))
    values, joints = functions_of(shared.names, arm, q)
    spread = _root(np.asarray(shared.moments))
    coefficients = random.normal(size=(count, len(shared.names))) @ spread.T
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
    terms = [term for name in names if (term := term_of(name, arm.joints)) is not None]
    values = function_values(wider.corrections.nominal, terms, q, np.asarray(wider.gravity)).T
    return values, np.array([term.joint - 1 for term in terms])


def places_of(capture: Capture) -> Float[np.ndarray, "M p"]:
    """1 for the poses of each socket or observation that a reference length starts or ends at, a column each."""
    sizes = [*capture.sizes, *(observation.q.shape[0] for observation in capture.observations)]
    names = [*capture.names, *(observation.name for observation in capture.observations)]
    ends = {end for length in capture.lengths for end in (length.start, length.end)}
    used = [i for i, name in enumerate(names) if name in ends]
    return (np.repeat(np.arange(len(sizes)), sizes)[:, None] == used).astype(float)


def _roots(shared: SharedErrors, capture: Capture, sizes: list[int]) -> list[Float[np.ndarray, "M c"]]:
    """Square roots of the covariances of a tip coordinate over the poses."""
    total, found = sum(sizes), []
    owner = np.repeat(np.arange(len(sizes)), sizes)
    for kind, sd in zip(shared.kinds, np.asarray(shared.sd), strict=True):
        if kind == PLACES:
            found.append(sd * places_of(capture))
        elif kind == VISITS and capture.visits is not None:
            visits = np.full(total, -1)
            visits[: len(capture.visits)] = capture.visits
            found.append(sd * (visits[:, None] == [number for number in np.unique(visits) if number >= 0]))
        elif kind == SUCCESSIVE:
            for i, size in enumerate(sizes):
                order, own = np.arange(size), np.zeros((total, size))
                kernel = np.exp(-np.abs(order[:, None] - order) / float(shared.correlation_length))
                own[owner == i] = sd * np.linalg.cholesky(kernel)
                found.append(own)
    return found


def _root(moments: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    values, vectors = np.linalg.eigh(moments)
    return vectors * np.sqrt(np.maximum(values, 0.0))
