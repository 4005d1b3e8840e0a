"""Trials of captures with observations besides sockets: the poses of a recording, taken by other arms.

A true arm takes each pose of the recording with its tip, and what it carries, where the nominal arm has them as well as
it can; what it cannot is taken from the residuals (`calibration.redrawn`). So no kind says how it is drawn.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import erf

from ..calibration.evaluation import fit_geometry
from ..calibration.redrawn import ObservedTruth, shifted
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture
from ..kinematics.arm import Arm, by_joint
from ..kinematics.chain import reading_units
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..model.rows import rows_at
from .definition import Study
from .settings import CellValues, DrawnTrials, Setting

_ROUNDS = 4  # of the configurations' way to their tips, each of which leaves about a hundredth
_LONGEST_STEP = 0.1  # rad


class _Recorded(NamedTuple):
    """What all trials share."""

    truth: ObservedTruth  # by the nominal arm
    space: Parameters
    inverses: list[Float[np.ndarray, "m n r"]]  # least changes of the readings for each residual
    geometry: Float[np.ndarray, " g"]


@lru_cache(maxsize=4)
def _recorded(study: Study) -> _Recorded:
    assert study.capture is not None
    arm = study.space.base
    arm, space, observed = to_numpy((arm, study.space, Observed.of(study.capture, arm)))
    geometry = np.asarray(fit_geometry(arm, observed, {}, None).geometry)
    truth = ObservedTruth.at(study.capture, space, space.vector(), observed.split(geometry))
    units = reading_units(space.base.geometry)
    by_units = [np.moveaxis(np.asarray(part.by_readings) * units[:, None], -1, 0) for part in truth.parts]
    return _Recorded(truth, space, [np.linalg.pinv(matrix, rcond=1e-6) for matrix in by_units], geometry)


def draw_observed(
    study: Study, setting: Setting, cells: Int[np.ndarray, " t"], trials: Int[np.ndarray, " t"]
) -> tuple[DrawnTrials, Capture]:
    """Trials ``trials`` of cells ``cells``, and their captures as a batch. Each has random numbers of its own."""
    recorded = _recorded(study)
    seed = study.specification.seed
    rows = []
    for cell, trial in zip(cells.tolist(), trials.tolist(), strict=True):
        values = CellValues(*(column[cell] for column in study.cell_values))
        rows.append(_trial(study, setting, recorded, values, np.random.default_rng([seed, cell, trial])))
    true, start, q, shifts, certified, lengths = zip(*rows, strict=True)
    truth = recorded.truth
    readings, value = np.stack(q), np.stack(lengths)
    stacked = {name: np.stack([values[name] for values in certified]) for name in certified[0]}
    observations = [
        shifted(observation, readings[:, poses], np.stack([shift[i] for shift in shifts]), stacked)
        for i, (observation, poses) in enumerate(zip(truth.observed.observations, truth.observed.slices, strict=True))
    ]
    u = np.broadcast_to(np.asarray(truth.observed.u), value.shape)
    captures = truth.batch(observations, value)
    lower, upper = study.cell_values.lower[cells], study.cell_values.upper[cells]
    return DrawnTrials(readings, np.stack(true), lower, upper, np.stack(start), value, u), captures


def _trial(
    study: Study, setting: Setting, recorded: _Recorded, values: CellValues, random: np.random.Generator
) -> tuple[Any, ...]:
    """True parameters, start, readings, shifts of the residuals, certified values and reference lengths."""
    truth, nominal = recorded.truth, np.asarray(recorded.space.vector())
    normal = random.normal(size=len(nominal))
    true = nominal + values.width * np.where(values.normal, normal, erf(normal / np.sqrt(2)))
    start = nominal
    fraction = random.uniform(size=len(nominal))
    if setting.random_start:
        fixed = np.array([name == setting.hold for name in study.space.names])
        bounded = np.isfinite(values.lower) & np.isfinite(values.upper)  # coefficients of corrections are not
        lower, upper = (np.where(bounded, side, nominal) for side in (values.lower, values.upper))
        start = np.where(fixed, nominal, lower + fraction * (upper - lower))
    q, left = _taken(recorded, true)
    read = _read(recorded.space.base, q, truth.reading, values, random)
    errors = truth.errors_of_rows(1, float(values.seating), random)
    shifts = [error[0] - rows for error, rows in zip(errors, left, strict=True)]
    certified = {name: drawn[0] for name, drawn in truth.values(1, random).items()}
    return true, start, read, shifts, certified, truth.lengths(1, random)[0]


def _taken(
    recorded: _Recorded, true: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "M n"], list[Float[np.ndarray, "r m"]]]:
    """Configurations in which the true arm has the least residuals that it can have, and these."""
    observed, z = recorded.truth.observed, np.concatenate([true, recorded.geometry])
    q, units = np.asarray(observed.q).copy(), reading_units(recorded.space.base.geometry)
    for number in range(_ROUNDS + 1):
        now = observed.moved(recorded.space.base, q)
        values = [rows.values for rows in rows_at(recorded.space, now, z).rows]
        left = [np.asarray(rows) for rows in now.by_observation(values)]
        if number == _ROUNDS:
            break
        for rows, inverse, values in zip(observed.slices, recorded.inverses, left, strict=True):
            step = np.einsum("mnr,rm->mn", inverse, values)
            q[rows] -= units * np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        q = _agreeing(q, recorded.truth.reading)
    return q, left


def _agreeing(q: Float[np.ndarray, "M n"], reading: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M n"]:
    """With poses that were read at once still one configuration: their mean."""
    counts = np.bincount(reading)
    if len(counts) == len(reading):
        return q
    sums = np.stack([np.bincount(reading, weights=column) for column in q.T], axis=1)
    return (sums / counts[:, None])[reading]


def _read(
    arm: Arm,
    q: Float[np.ndarray, "M n"],
    reading: Int[np.ndarray, " M"],
    values: CellValues,
    random: np.random.Generator,
) -> Float[np.ndarray, "M n"]:
    """What the encoders show: eccentricity (a first harmonic of the angle), noise and rounding."""
    eccentricity, encoder, step = (
        np.array(by_joint(arm, *map(float, pair)))
        for pair in (
            (values.eccentricity, 0.0),
            (values.encoder, values.linear_encoder),
            (values.resolution, values.linear_resolution),
        )
    )
    harmonics = eccentricity * random.normal(size=(2, q.shape[1]))
    q = q + harmonics[0] * np.sin(q) + harmonics[1] * np.cos(q)
    q = q + encoder * random.normal(size=(reading.max() + 1, q.shape[1]))[reading]
    return np.where(step > 0, np.round(q / np.where(step > 0, step, 1.0)) * step, q)
