"""A block of trials, from keys to results: drawn, identified by one call, compared with the truth.

Trials of sockets and lengths are drawn by `trial_simulation`. Those of captures with other observations are drawn here:
a true arm takes each pose of the recording with its tip, and what it carries, where the nominal arm has them as well as
it can; what it cannot is taken from the residuals (`calibration.redrawn`). So no kind says how it is drawn.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.special import erf

from ..calibration.batch import calibrate_many, identify_many
from ..calibration.evaluation import fit_geometry
from ..calibration.redrawn import ObservedTruth, batch_of_captures, shifted
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, ReferenceLength
from ..kinematics.arm import Arm, by_joint, correction_names
from ..kinematics.chain import reading_units
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..model.rows import rows_at
from ..solver.reason import numbers_of
from .blocks import Block
from .definition import CellValues, Setting, Study
from .trial_simulation import DrawnTrials, draw, ends_of

_ROUNDS = 4  # of the configurations' way to their tips, each of which leaves about a hundredth
_LONGEST_STEP = 0.1  # rad


def run_block(study: Study, block: Block, *, device: Any = None) -> dict[str, np.ndarray]:
    """Results of a block: name -> array ``(cells, trials, ...)``; `VARIABLES` in `blocks` says what each is.

    They depend on the study and on which trials they are, and on nothing else: not on the block, the machine's load or
    the order; on the kind of processor to rounding. On one ``device`` it takes one core, else all that there are.
    """
    count, trials_each = block.shape
    cells = np.repeat(np.arange(block.first_cell, block.last_cell), trials_each)
    trials = np.tile(np.arange(block.first_trial, block.last_trial), count)
    setting = study.settings[block.first_cell]
    devices = jax.local_devices() if device is None else [device]
    drawn, captures = _drawn(study, setting, cells, trials, devices[0])
    options = {"devices": devices, "workers": None if device is None else 1}
    results = _identified(study, setting, drawn, captures, options)
    return {name: values.reshape(*block.shape, *values.shape[1:]) for name, values in results.items()}


def draw_trials(study: Study, cell: int, trials: Numbers) -> tuple[DrawnTrials, Capture]:
    """The problems of some trials of a cell, as the study solves them: to look into one, or to solve it otherwise.

    Args:
        study: The study.
        cell: Number of the cell, from 0.
        trials: Numbers of the trials ``(t,)``, from 0.

    Returns:
        Readings, true parameters, bounds and starts, mm and rad, and the captures as a batch that `identify_many`
        takes.

    Raises:
        InputError: The study has no such cell.

    Example:
        >>> drawn, captures = aj.study.draw_trials(study, 0, [0, 1])
        >>> many = aj.identify_many(arm, captures, drawn.lower, drawn.upper, drawn.start)
        >>> print(many.de.shape)
        (2,)
    """
    if not 0 <= cell < len(study.settings):
        raise InputError(f"cell is {cell}, but the study has {len(study.settings)} cells, numbered from 0.")
    setting, numbers = study.settings[cell], np.atleast_1d(np.asarray(trials))
    return _drawn(study, setting, np.full(len(numbers), cell), numbers, jax.local_devices()[0])


def _drawn(
    study: Study, setting: Setting, cells: np.ndarray, trials: np.ndarray, device: Any
) -> tuple[DrawnTrials, Capture]:
    """Trials, and their captures as a batch."""
    if study.observed:
        return _draw_observed(study, setting, cells, trials)
    drawn = draw(study, setting, cells, trials, device)
    return drawn, batch_of_captures(_template(study, setting), drawn.q, drawn.value, drawn.u)


@lru_cache(maxsize=64)
def _template(study: Study, setting: Setting) -> Capture:
    """One capture of the right shape; its numbers do not matter."""
    names = [f"{fixture.name}{end}" for fixture in setting.fixtures for end in ("a", "b")[: fixture.ends]]
    angles = np.random.default_rng(0).uniform(-1, 1, (sum(setting.sizes), study.nominal.arm.joints))
    rows = np.split(angles, np.cumsum(setting.sizes)[:-1])
    lengths = [ReferenceLength(names[a], names[b], 1.0) for a, b in ends_of(study, setting)]
    return Capture(dict(zip(names, rows, strict=True)), lengths)


def _identified(
    study: Study, setting: Setting, drawn: DrawnTrials, capture: Capture, options: dict[str, Any]
) -> dict[str, np.ndarray]:
    space, prior = study.identified(setting)
    chosen = np.array([study.space.index(name) for name in space.names])
    fixed = np.asarray(Parameters(space.base, study.space.names).vector())
    # Coefficients that a model frees begin at 0, whatever the nominal arm's are.
    corrects = np.isin(study.space.names, correction_names(space.base)) & (setting.model is not None)
    start = np.where(corrects, fixed, drawn.start)[:, chosen]
    problem = (space.base, capture, drawn.lower[:, chosen], drawn.upper[:, chosen], start)
    max_steps, scaled = study.specification.identification.max_steps, setting.method != "stage1"
    options = options | {"space": space, "prior": prior, "hold": setting.hold, "max_steps": max_steps}
    if scaled:
        many = calibrate_many(*problem, method=setting.method, **options)  # pyright: ignore[reportArgumentType]
        stage1 = many.stage1
    else:
        many = stage1 = identify_many(*problem, **options)

    def of_all(values: np.ndarray, others: np.ndarray = fixed) -> np.ndarray:
        """Values of all parameters of the study, of which the cell identifies some."""
        every = np.tile(others, (len(values), 1))
        every[:, chosen] = values
        return every

    lengths = study.space.lengths
    angles = np.array([kind in ("alpha", "theta", "beta") for kind, _ in study.space.indices()])
    true, none = np.where(lengths, drawn.true, 0.0), np.full(len(drawn.true), np.nan)
    identified, identified1 = of_all(many.parameters), of_all(stage1.parameters)

    def scale_of(values: np.ndarray) -> np.ndarray:
        """The factor that best maps the true lengths onto those identified. Rows are contiguous, so that each is summed
        in the same order however many there are."""
        square = np.ascontiguousarray(true * true).sum(axis=1)
        return np.ascontiguousarray(values * true).sum(axis=1) / np.maximum(square, 1e-300)

    results = {
        "converged": np.asarray(many.converged, dtype=np.int8),
        "reason": np.asarray(numbers_of(many.result), dtype=np.int8),
        "steps": many.steps.astype(np.int32),
        "k": none if many.k is None else many.k,
        "scale": scale_of(identified1),
        "scale_error": scale_of(identified) - 1,
        "truth_inside": np.all((drawn.true >= drawn.lower) & (drawn.true <= drawn.upper), axis=1).astype(np.int8),
        "active": of_all(many.active, np.zeros(len(fixed), np.int8)),
        "estimate": identified,
        "true": drawn.true,
    }
    for suffix, stage, values in (("_stage1", stage1, identified1), ("", many, identified)):
        error = np.abs(values - drawn.true)
        results[f"de{suffix}"], results[f"deltam{suffix}"] = stage.de, stage.deltam
        results[f"length_error{suffix}"] = error[:, lengths].max(axis=1, initial=0.0)
        results[f"angle_error{suffix}"] = error[:, angles].max(axis=1, initial=0.0)
    if not scaled:
        results |= dict.fromkeys(("scale_error", "de", "deltam", "length_error", "angle_error"), none)
    return results


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
    inverses = [np.linalg.pinv(matrix, rcond=1e-6) for matrix in by_units]
    if (counted := truth.observed.counted) is not None:  # not by rounding either
        inverses = [
            matrix * counted[:, part.poses].T[..., None] for matrix, part in zip(inverses, truth.parts, strict=True)
        ]
    return _Recorded(truth, space, inverses, geometry)


def _draw_observed(
    study: Study, setting: Setting, cells: Int[np.ndarray, " t"], trials: Int[np.ndarray, " t"]
) -> tuple[DrawnTrials, Capture]:
    """Trials ``trials`` of cells ``cells``, and their captures as a batch. Each has random numbers of its own."""
    recorded = _recorded(study)
    truth, nominal = recorded.truth, np.asarray(recorded.space.vector())
    fixed = np.array([name == setting.hold for name in study.space.names])
    true, start, q, shifts, certified, lengths = [], [], [], [], [], []
    for cell, trial in zip(cells.tolist(), trials.tolist(), strict=True):
        values = CellValues(*(column[cell] for column in study.cell_values))
        random = np.random.default_rng([study.specification.seed, cell, trial])
        normal, fraction = random.normal(size=len(nominal)), random.uniform(size=len(nominal))
        true.append(nominal + values.width * np.where(values.normal, normal, erf(normal / np.sqrt(2))))
        bounded = np.isfinite(values.lower) & np.isfinite(values.upper)  # coefficients of corrections are not
        lower, upper = (np.where(bounded, side, nominal) for side in (values.lower, values.upper))
        at_random = setting.random_start & ~fixed
        start.append(np.where(at_random, lower + fraction * (upper - lower), nominal))
        taken, left = _taken(recorded, true[-1])
        q.append(_read(recorded.space.base, taken, truth, values, random))
        errors = truth.errors_of_rows(1, float(values.seating), random)
        shifts.append([error[0] - rows for error, rows in zip(errors, left, strict=True)])
        certified.append({name: drawn[0] for name, drawn in truth.values(1, random).items()})
        lengths.append(truth.lengths(1, random)[0])
    readings, value = np.stack(q), np.stack(lengths)
    stacked = {name: np.stack([values[name] for values in certified]) for name in certified[0]}
    observations = [
        shifted(observation, readings[:, poses], np.stack([shift[i] for shift in shifts]), stacked)
        for i, (observation, poses) in enumerate(zip(truth.observed.observations, truth.observed.slices, strict=True))
    ]
    u = np.broadcast_to(np.asarray(truth.observed.u), value.shape)
    captures = truth.batch(observations, value)
    bounds = study.cell_values.lower[cells], study.cell_values.upper[cells]
    return DrawnTrials(readings, np.stack(true), *bounds, np.stack(start), value, u), captures


def _taken(
    recorded: _Recorded, true: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "M n"], list[Float[np.ndarray, "r m"]]]:
    """Configurations in which the true arm has the least residuals that it can have, and these."""
    observed, z = recorded.truth.observed, np.concatenate([true, recorded.geometry])
    q, units = np.asarray(observed.q).copy(), reading_units(recorded.space.base.geometry)
    reading = recorded.truth.reading
    counts = np.bincount(reading)
    for number in range(_ROUNDS + 1):
        now = observed.moved(recorded.space.base, q)
        values = [rows.values for rows in rows_at(recorded.space, now, z).rows]
        left = [np.asarray(rows) for rows in now.by_observation(values)]
        if number == _ROUNDS:
            break
        for rows, inverse, values in zip(observed.slices, recorded.inverses, left, strict=True):
            step = np.einsum("mnr,rm->mn", inverse, values)
            q[rows, : len(units)] -= units * np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)
        # Poses that were read at once are still one configuration: their mean.
        sums = np.stack([np.bincount(reading, weights=column) for column in q.T], axis=1)
        q = (sums / counts[:, None])[reading] if len(counts) < len(reading) else q
    return q, left


def _read(
    arm: Arm,
    q: Float[np.ndarray, "M columns"],
    truth: ObservedTruth,
    values: CellValues,
    random: np.random.Generator,
) -> Float[np.ndarray, "M columns"]:
    """What the encoders show: eccentricity (a first harmonic of the angle), noise and rounding. What is recorded beside
    the joints is exact."""
    reading, exact = truth.reading, np.zeros(q.shape[1] - arm.joints)
    eccentricity, encoder, step = (
        np.append(by_joint(arm, *map(float, pair)), exact)
        for pair in (
            (values.eccentricity, 0.0),
            (values.encoder, values.linear_encoder),
            (values.resolution, values.linear_resolution),
        )
    )
    harmonics = eccentricity * random.normal(size=(2, q.shape[1]))
    q = q + harmonics[0] * np.sin(q) + harmonics[1] * np.cos(q)
    noise = encoder * random.normal(size=(reading.max() + 1, q.shape[1]))[reading]
    if truth.observed.counted is not None:
        noise[:, : arm.joints] *= truth.observed.counted.T
    q = q + noise
    return np.where(step > 0, np.round(q / np.where(step > 0, step, 1.0)) * step, q)
