"""How the parameters of a calibration follow errors of its tips and joints, at its solution."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import by_joint
from ..kinematics.parameters import Parameters
from ..model.measurement import Measurement
from ..model.rows import PriorRows
from ..uncertainty.covariance import covariance_of
from ..uncertainty.linearisation import Linearisation
from ..uncertainty.propagation import Propagated, in_units
from .observed_state import ObservedTask, state_at, whitening_at
from .results import Calibration


class Sensitivities(NamedTuple):
    """Derivatives of the parameters (mm and rad, in the order of ``space.names``) by errors of M poses, those of
    sockets first, and what lengths between sockets' means owe to them."""

    tips: Float[np.ndarray, "p 3 M"]  # by displacements of the tip, mm
    joints: Float[np.ndarray, "p n M"]  # by errors of the joints, rad (mm of prismatic ones)
    lengths: Float[np.ndarray, "l 3 M"]  # of measured lengths by the tips, where positions of sockets are means
    # What lengths that contradict each other have added to the covariance of the parameters: errors of places instead.
    surplus: Float[np.ndarray, "p p"]


def sensitivities_of_sockets(result: Calibration, measurement: Measurement, propagated: Propagated) -> Sensitivities:
    """Of a calibration from sockets and lengths, whose covariance was propagated so."""
    result, measurement, propagated = to_numpy((result, measurement, propagated))
    linear, sensitivity = propagated.linear, propagated.sensitivity
    without = in_units(covariance_of(sensitivity, linear, measurement, propagated.errors), result.space)
    tips = result.space.scale[:, None, None] * propagated.sensitivity.tips
    joints = tuple(f"{kind}_{i}" for i, kind in enumerate(by_joint(result.arm, "theta", "d"), start=1))
    by_joints = np.asarray(result.arm.jacobian(measurement.q, joints))
    return Sensitivities(
        np.asarray(tips),
        np.einsum("pcN,Ncj->pjN", tips, by_joints),
        np.asarray(linear.lengths_by_tips),
        np.asarray(propagated.parameter_covariance.matrix - without),
    )


def sensitivities_of_observations(task: ObservedTask, result: Calibration) -> Sensitivities:
    """Of a calibration from observations of all kinds: with the weights of its last solve."""
    task, result = to_numpy((task, result))
    metrics, prior = result.observed, result.prior
    assert metrics is not None
    names = task.bounds.space.names
    free = np.flatnonzero([name != task.anchor.hold for name in names])
    space = Parameters(result.arm, tuple(names[i] for i in free))
    p, observed = len(free), task.observed
    geometry = [np.asarray(metrics.geometry[part]) for part in observed.blocks]
    z = np.concatenate([np.asarray(result.parameters)[free], *geometry])
    state = state_at(task, space, z, metrics.sigma)
    rows = None if prior is None else PriorRows(prior.mean, prior.weight)
    whitening = whitening_at(task, state, rows)
    linear = Linearisation.of(observed, space, z, state.point, state.errors, whitening, task.loss)
    fixed = np.concatenate([np.asarray(result.active)[free] != 0, np.zeros(len(z) - p, dtype=bool)])
    influence = linear.influence(fixed)
    gain = -(np.asarray(space.scale)[:, None] * influence.inverse[:p])
    tips, joints = [], []
    for number, (part, error, root) in enumerate(zip(state.point.rows, state.errors, whitening.roots, strict=True)):
        by_row = influence.weighted_rows(number)
        each = (gain @ by_row.reshape(len(by_row), -1)).reshape(p, *by_row.shape[1:])
        each = np.einsum("pam,mab->pbm", each, root)
        tips.append(np.einsum("pbm,bcm->pcm", each, part.by_tip))
        joints.append(np.einsum("pbm,bnm->pnm", each, error.by_readings))
    tips, joints = observed.by_observation(tips), observed.by_observation(joints)
    found = [np.zeros((len(names), *parts[0].shape[1:2], observed.q.shape[0])) for parts in (tips, joints)]
    for whole, parts in zip(found, (tips, joints), strict=True):
        whole[free] = np.concatenate(parts, axis=2)
    none = np.zeros((0, 3, observed.q.shape[0]))
    return Sensitivities(found[0], found[1], none, np.zeros((len(names), len(names))))
