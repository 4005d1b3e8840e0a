"""A block of trials, from keys to results: drawn, identified by one call, compared with the truth."""

from functools import lru_cache
from typing import Any

import jax
import numpy as np

from ..calibration.batch import calibrate_many, identify_many
from ..calibration.redrawn import batch_of_captures
from ..core.arrays import Numbers
from ..core.errors import InputError
from ..data.capture import Capture, ReferenceLength
from ..kinematics.arm import correction_names
from ..kinematics.parameters import Parameters
from ..solver.reason import numbers_of
from .blocks import Block
from .definition import Study
from .observed_trials import draw_observed
from .settings import DrawnTrials, Setting
from .trial_simulation import draw, ends_of


def run_block(study: Study, block: Block, *, device: Any = None, workers: int | None = None) -> dict[str, np.ndarray]:
    """Results of a block: name -> array ``(cells, trials, ...)``; `VARIABLES` in `blocks` says what each is.

    They depend on the study and on which trials they are, and on nothing else: not on the block, the machine's load or
    the order; on the kind of processor to rounding.
    """
    count, trials_each = block.shape
    cells = np.repeat(np.arange(block.first_cell, block.last_cell), trials_each)
    trials = np.tile(np.arange(block.first_trial, block.last_trial), count)
    setting = study.settings[block.first_cell]
    devices = jax.local_devices() if device is None else [device]
    drawn, captures = _drawn(study, setting, cells, trials, devices[0])
    results = _identified(study, setting, drawn, captures, devices, workers)
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
        raise InputError(f"cell is {cell}, but the study has {len(study.settings)} cells; count them from 0.")
    setting, numbers = study.settings[cell], np.atleast_1d(np.asarray(trials))
    return _drawn(study, setting, np.full(len(numbers), cell), numbers, jax.local_devices()[0])


def _drawn(
    study: Study, setting: Setting, cells: np.ndarray, trials: np.ndarray, device: Any
) -> tuple[DrawnTrials, Capture]:
    """Trials, and their captures as a batch."""
    if study.observed:
        return draw_observed(study, setting, cells, trials)
    drawn = draw(study, setting, cells, trials, device)
    return drawn, batch_of_captures(_template(study, setting), drawn.q, drawn.value, drawn.u)


def _identified(
    study: Study, setting: Setting, drawn: DrawnTrials, capture: Capture, devices: list[Any], workers: int | None
) -> dict[str, np.ndarray]:
    space, prior = study.identified(setting)
    chosen = np.array([study.space.index(name) for name in space.names])
    fixed = np.asarray(Parameters(space.base, study.space.names).vector())
    # Coefficients that a model frees begin at 0, whatever the nominal arm's are.
    corrects = np.isin(study.space.names, correction_names(space.base)) & (setting.model is not None)
    start = np.where(corrects, fixed, drawn.start)[:, chosen]
    options = {
        "space": space,
        "prior": prior,
        "hold": setting.hold,
        "max_steps": study.specification.identification.max_steps,
        "devices": devices,
        "workers": workers,
    }
    problem = (space.base, capture, drawn.lower[:, chosen], drawn.upper[:, chosen], start)
    if setting.method == "stage1":
        many = stage1 = identify_many(*problem, **options)
    else:
        many = calibrate_many(*problem, method=setting.method, **options)  # pyright: ignore[reportArgumentType]
        stage1 = many.stage1
    identified = _identified_of_all(fixed, chosen, many.parameters)
    identified1 = _identified_of_all(fixed, chosen, stage1.parameters)
    k = np.full(len(many.de), np.nan) if many.k is None else many.k
    lengths = study.space.lengths
    angles = np.array([kind in ("alpha", "theta", "beta") for kind, _ in study.space.indices()])
    # Scale of the arm: the factor that best maps the true lengths onto the identified ones. Rows are contiguous, so
    # that each is summed in the same order however many there are.
    true = np.ascontiguousarray(np.where(lengths, drawn.true, 0.0))
    scale, scale_after = (
        np.ascontiguousarray(values * true).sum(axis=1) / np.maximum((true * true).sum(axis=1), 1e-300)
        for values in (identified1, identified)
    )
    scaled = setting.method != "stage1"
    return {
        "converged": np.asarray(many.converged, dtype=np.int8),
        "reason": np.asarray(numbers_of(many.result), dtype=np.int8),
        "steps": many.steps.astype(np.int32),
        "k": k,
        "scale": scale,
        "scale_error": scale_after - 1 if scaled else np.full(len(k), np.nan),
        "de_stage1": stage1.de,
        "deltam_stage1": stage1.deltam,
        "length_error_stage1": _largest(identified1 - drawn.true, lengths),
        "angle_error_stage1": _largest(identified1 - drawn.true, angles),
        "de": many.de if scaled else np.full(len(k), np.nan),
        "deltam": many.deltam if scaled else np.full(len(k), np.nan),
        "length_error": _largest(identified - drawn.true, lengths, scaled),
        "angle_error": _largest(identified - drawn.true, angles, scaled),
        "truth_inside": np.all((drawn.true >= drawn.lower) & (drawn.true <= drawn.upper), axis=1).astype(np.int8),
        "active": _identified_of_all(np.zeros(len(fixed), np.int8), chosen, many.active),
        "estimate": identified,
        "true": drawn.true,
    }


def _identified_of_all(fixed: np.ndarray, chosen: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values of all parameters of a study, of which a cell identifies some."""
    every = np.tile(fixed, (len(values), 1))
    every[:, chosen] = values
    return every


def _largest(error: np.ndarray, which: np.ndarray, present: bool = True) -> np.ndarray:
    return np.abs(error[:, which]).max(axis=1, initial=0.0) if present else np.full(len(error), np.nan)


@lru_cache(maxsize=64)
def _template(study: Study, setting: Setting) -> Capture:
    """One capture of the right shape; its numbers do not matter."""
    names = [f"{fixture.name}{end}" for fixture in setting.fixtures for end in ("a", "b")[: fixture.ends]]
    angles = np.random.default_rng(0).uniform(-1, 1, (sum(setting.sizes), study.nominal.arm.joints))
    rows = np.split(angles, np.cumsum(setting.sizes)[:-1])
    lengths = [ReferenceLength(names[a], names[b], 1.0) for a, b in ends_of(study, setting)]
    return Capture(dict(zip(names, rows, strict=True)), lengths)
