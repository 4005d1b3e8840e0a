"""A recording calibrated as ``aacmm calibrate`` does it: one call, whose options state their defaults once."""

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from ..calibration.record import CalibrationRecord, record_of
from ..calibration.results import Calibration, Identification
from ..calibration.sampling import monte_carlo
from ..core.arguments import checked_arguments, with_options
from ..core.blas_threads import one_blas_thread
from ..core.errors import IdentifiabilityWarning, InputError
from ..data.capture import join_sessions
from ..data.noise import Noise
from ..data.recording import Recording
from ..diagnostics.findings import case_of
from ..diagnostics.mistakes import mistake_in_data, single_mistake
from ..diagnostics.reading_fit import Explanation
from ..kinematics.corrected_arm import with_corrections
from ..kinematics.priors import Prior, default_prior
from ..model.loss_names import LossName
from .automatic import (
    Record,
    matches,
    with_best_model,
    with_full_couplings,
    with_wider_bounds,
    with_wrong_fixed_freed,
    without_contradicting,
    without_misplaced,
)
from .cross_validation import can_cross_validate, cross_validate
from .data_corrections import camera_fits, corrected_capture, with_corrected_readings, with_prior_of_few
from .hold_out import held_out_poses, tested, without_held_out
from .reading_sets import with_other_readings
from .single import CalibrationOptions, calibrate, identify

_SOLVE = CalibrationOptions()
_FEW_STEPS = 50  # of a calibration that does not converge at once


class CaptureOptions(NamedTuple):
    """How `calibrate_capture` calibrates: its keyword arguments, described there, and their defaults.

    Example:
        >>> options = aj.pipeline.CaptureOptions(noise=noise, cross_validate=False)
        >>> print(aj.calibrate_capture(aj.Recording(two_bars, nominal), **options._asdict()).method)
        two-stage
    """

    model: str | None = _SOLVE.model
    method: Literal["two-stage", "joint"] | None = _SOLVE.method
    robust: LossName | None = _SOLVE.robust
    prior: Prior | Literal["stated"] | None = "stated"
    scale: Literal["measured", "nominal"] = "measured"
    hold_out: float | str | None = None
    only_poses: int | None = None
    seed: int = 0
    hold: str | None = _SOLVE.hold
    noise: Noise | None = _SOLVE.noise
    replace_noise: bool = _SOLVE.replace_noise
    shared_errors: bool = _SOLVE.shared_errors
    cross_validate: bool | None = None
    leave_out: tuple[str, ...] = ()
    monte_carlo: bool = False
    strict: bool = False
    remove_contradicting: bool = False
    automatic: bool = True
    max_steps: int = _SOLVE.max_steps
    stage: Callable[[str, Callable[[], Any]], Any] = lambda what, work: work()


@checked_arguments
@with_options(CaptureOptions)
@one_blas_thread
def calibrate_capture(recording: Recording, **options: Any) -> CalibrationRecord:
    """Calibrate a recording: what ``aacmm calibrate`` does, with the same defaults.

    The nominal arm of the recording says which parameters are free, between which bounds, and their prior
    (``recording.nominal._replace(length=5.0, free=("beta_2",))`` for others). What the data leave undetermined is no
    warning, but part of the record (`warnings_of`).

    Args:
        recording: the capture and its nominal arm.
        model: what the joints do besides their readings, as for `calibrate`; "dh", nothing. By default the model of
            the nominal arm; where it has none, the model that predicts held-out regions best, if ``automatic``.
        method: "two-stage" or "joint", as for `calibrate`.
        robust: a robust loss, as for `identify`.
        prior: what is known of the parameters; "stated", that of the nominal arm; None, nothing.
        scale: "nominal" for stage 1 alone, with the scale of the nominal arm, where nothing observed fixes it.
        hold_out: test the result on poses that it was not calibrated with: a share of the poses of each observation,
            drawn at random (0.3), or the group of such a name or shell pattern (a socket, a placement, a session).
        only_poses: calibrate with so many poses drawn at random, and test the result on the others.
        seed: of these random numbers.
        hold: the scale anchor of stage 1, as for `identify`.
        noise: standard deviations of readings and seat, as for `identify`.
        replace_noise: estimate the noise of encoders that prove noisier, as for `identify`.
        shared_errors: add shared errors to the covariance, as for `calibrate`.
        cross_validate: calibrate without each group, as `cross_validate` does. By default where a real arm was recorded
            in several placements of the reference length, and there is neither a prior nor a robust loss.
        leave_out: groups that cross-validation leaves out, as names or shell patterns.
        monte_carlo: check the uncertainties by Monte Carlo.
        strict: raise `InputError` where such data could not determine free parameters even without noise.
        remove_contradicting: leave out groups that contradict all others.
        automatic: give too few data the prior and the noise of a real arm, leave out poses that were mixed up, correct
            readings that do not match the arm where one order, signs, zeros or unit explain them, find joints that move
            with others, widen default bounds that the fit reaches, free parameters whose fixed value the data
            contradict, leave out what contradicts the rest, and compare models of the joints unless a model, a prior,
            a method or a robust loss is stated. ``decisions`` of the record says what was done and why.
        max_steps: most evaluations of each solve.
        stage: called with what is done next, in words, and a function that does it, such as to show progress.

    Returns:
        The calibration with all that was found of it, to save (`files.save_calibration`), show or evaluate.

    Raises:
        InputError: as `calibrate` does, and where options do not go together.

    Example:
        >>> calibrated = aj.calibrate_capture(aj.Recording(two_bars, nominal), noise=noise)
        >>> print(calibrated.method, f"{calibrated.validation.rms:.3f} mm in unseen placements")
        two-stage 0.015 mm in unseen placements
    """
    chosen = CaptureOptions(**options)
    if chosen.leave_out and not chosen.cross_validate:
        raise InputError(
            "--leave-out (leave_out) names the groups that --cross-validate (cross_validate) leaves out; give both "
            "options."
        )
    capture = recording.capture
    masks = held_out_poses(capture, chosen.hold_out, chosen.only_poses, chosen.seed)
    recording = recording._replace(capture=without_held_out(capture, masks))
    nominal = recording.nominal
    if chosen.model is not None and nominal.arm.corrections is None:
        nominal = nominal._replace(arm=with_corrections(nominal.arm, chosen.model))
    if not isinstance(chosen.prior, str):
        nominal = nominal._replace(prior=chosen.prior)
    elif chosen.model is not None and nominal.prior is None and nominal.arm.corrections is not None:
        nominal = nominal._replace(prior=default_prior(nominal.arm))
    recording = recording._replace(nominal=nominal._replace(arm=nominal.bounds().space.base))
    automatic, decided = chosen.automatic and chosen.scale == "measured", ()
    if automatic:
        recording, chosen, decided = with_prior_of_few(recording, chosen)
    anchor = None if chosen.hold == _SOLVE.hold else (chosen.hold,)  # two stages, which no other model would have
    prior = chosen.prior is None or recording.nominal.prior is not None
    given = (chosen.model, chosen.robust, chosen.method, anchor, nominal.arm.corrections)
    stated = prior or any(value is not None for value in given)

    def recorded(result: Calibration | Identification, part: Recording) -> CalibrationRecord:
        record = record_of(result, part, robust=chosen.robust)
        case_of(record)  # takes over what the calibration has computed to test its noise, before others are tested
        return record

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)
        solved = partial(_solved, chosen)
        # Images that are not those of the poses end in hundreds of steps, before the mistake is looked for.
        brief = automatic and chosen.max_steps > _FEW_STEPS and not camera_fits(recording)
        first = partial(_solved, chosen._replace(max_steps=_FEW_STEPS)) if brief else solved
        record = chosen.stage("Calibrating", lambda: recorded(first(recording), recording))
        record = record._replace(decisions=decided)
        if automatic:
            further = chosen.model is None and nominal.arm.corrections is None
            record, explanation = _with_corrected_data(record, chosen, recorded, further)
            capture = capture if explanation is None else corrected_capture(capture, explanation) or capture
        # Where a mistake in the recording remains, every other remedy would only make up for it.
        mistake = None if not automatic or matches(record) else case_of(record).once(mistake_in_data)
        if brief and mistake is None and not record.converged:
            again = chosen.stage("Calibrating", lambda: recorded(solved(record.recording), record.recording))
            record = again._replace(removed=record.removed, decisions=record.decisions)
        if mistake is None or mistake.of_bounds:
            if automatic:
                record = chosen.stage("Checking bounds", lambda: with_wider_bounds(record, solved, recorded))
                freed = lambda: with_wrong_fixed_freed(record, solved, recorded)  # noqa: E731
                record = chosen.stage("Checking fixed parameters", freed)
            if chosen.remove_contradicting or (automatic and chosen.robust is None):  # which bad poses do not move
                record = chosen.stage("Comparing groups", lambda: without_contradicting(record, solved, recorded))
            if automatic and not stated:
                record = with_best_model(record, solved, recorded, chosen)
        if masks:
            record = chosen.stage("Testing held-out poses", lambda: tested(record, capture, masks))
        if _to_cross_validate(record, chosen):
            record = chosen.stage("Cross-validating", lambda: _cross_validated(record, chosen))
        if chosen.monte_carlo:
            result = solved(record.recording)
            if not isinstance(result, Calibration) or chosen.robust is not None:
                raise InputError(
                    "--monte-carlo cannot be combined with --robust or --scale nominal; omit --monte-carlo."
                )
            sampled = chosen.stage("Drawing trials", lambda: monte_carlo(result, record.recording.capture))
            record = record._replace(sampled=sampled.table(), sampled_says=" ".join(sampled.sentences()))
    return record


def _with_corrected_data(
    record: CalibrationRecord, chosen: CaptureOptions, recorded: Record, further: bool
) -> tuple[CalibrationRecord, Explanation | None]:
    """The calibration without poses that were mixed up, with couplings, and with the readings corrected, where the data
    do not match the arm; and how they were corrected. ``further``: whether couplings may be added to the model."""
    solved = partial(_solved, chosen)
    record = with_other_readings(record, solved)
    record = chosen.stage("Checking poses", lambda: without_misplaced(record, solved, recorded))
    mistake = None if matches(record) else case_of(record).once(single_mistake)
    if mistake is None:
        coupled = chosen.stage("Checking couplings", lambda: with_full_couplings(record, solved, recorded, further))
        return chosen.stage("Checking readings", lambda: with_corrected_readings(coupled, solved, recorded))
    if mistake.of_readings:  # a search of seconds
        return chosen.stage("Checking readings", lambda: with_corrected_readings(record, solved, recorded))
    return record, None


def _solving(chosen: CaptureOptions, prior: Prior | None) -> CalibrationOptions:
    """How `calibrate` is called; what the data do not determine is said by the record."""
    same = {name: value for name, value in chosen._asdict().items() if name in CalibrationOptions._fields}
    undetermined = "raise" if chosen.strict else "ignore"
    return CalibrationOptions(**same | {"model": None, "prior": prior, "undetermined": undetermined})


def _solved(chosen: CaptureOptions, recording: Recording) -> Calibration | Identification:
    """A recording calibrated with the parameters, bounds and prior of its nominal arm."""
    capture, bounds, solving = recording.capture, recording.nominal.bounds(), _solving(chosen, recording.nominal.prior)
    if chosen.scale == "measured":
        return calibrate(bounds.space.base, capture, bounds, **solving._asdict())
    if chosen.method is not None or chosen.strict:
        raise InputError("--scale nominal calibrates with stage 1 only; omit --method and --strict.")
    if any(observation.fixes_scale for observation in capture.observations):
        raise InputError(
            "--scale nominal is for captures that do not fix the scale, but these observations fix the scale; "
            "omit --scale nominal."
        )
    return identify(bounds.space.base, capture, bounds, **solving.solving._asdict())


def _cross_validated(record: CalibrationRecord, chosen: CaptureOptions) -> CalibrationRecord:
    """With the errors of each group of a calibration without it. Learned scales of the prior stay as all data have
    taught them: a few numbers, which one group hardly changes."""
    if chosen.scale != "measured":
        raise InputError("--cross-validate needs a calibrated scale; omit --scale nominal (scale).")
    bounds, prior = record.recording.nominal.bounds(), record.recording.nominal.prior
    if record.decisions and prior is not None and record.prior is not None:
        prior = Prior(dict(zip(record.prior.groups, record.prior.sd, strict=True)))
    solving = _solving(chosen, prior)._asdict()
    groups = chosen.leave_out or None
    validation = cross_validate(bounds.space.base, record.recording.capture, bounds, groups=groups, **solving)
    return record._replace(validation=validation)


def _to_cross_validate(record: CalibrationRecord, chosen: CaptureOptions) -> bool:
    """Whether groups are left out: where that was asked for; by default where a real arm measured the reference length
    in several placements, and leaving each of them out takes no longer than the calibration itself."""
    capture, nominal = record.recording.capture, record.recording.nominal
    if chosen.cross_validate is not None:
        return chosen.cross_validate
    if record.validation is not None:  # by the group that was held out
        return False
    plain = chosen.scale == "measured" and chosen.robust is None and (nominal.prior is None or record.decisions)
    if not plain or capture.observations or record.recording.true is not None or len(capture.lengths) < 2:
        return False
    return can_cross_validate(capture, len(nominal.space().names))


def join_recordings(recordings: Mapping[str, Recording], *, same_probe: bool = False) -> Recording:
    """Join the recordings of several sessions of one arm, as `join_sessions` joins their captures.

    Args:
        recordings: name of a session -> its recording.
        same_probe: whether the probe was not remounted between sessions.

    Returns:
        One recording; of a single session, the recording itself.

    Raises:
        InputError: the nominal arms differ, or as `join_sessions` does.

    Example:
        >>> drawn = [aj.simulate(true, {"A": (400, 200, 300)}, poses=5, seed=seed) for seed in (1, 2)]
        >>> monday, friday = (aj.Recording(part, nominal) for part in drawn)
        >>> print(aj.pipeline.join_recordings({"monday": monday, "friday": friday}).capture.sessions)
        ('monday', 'friday')
    """
    first, *rest = recordings.values()
    if not rest:
        return first
    for name, recording in list(recordings.items())[1:]:
        arms = [jax.tree.leaves(other.nominal.arm) for other in (first, recording)]
        same = jax.tree.structure(first.nominal.arm) == jax.tree.structure(recording.nominal.arm)
        if not same or not all(map(np.array_equal, *arms)):
            raise InputError(
                f"'{name}' has a different nominal arm from the first session; import both sessions with the same arm."
            )
    capture = join_sessions(
        {name: recording.capture for name, recording in recordings.items()}, own_probe=not same_probe
    )
    sources = tuple(source for recording in recordings.values() for source in recording.sources)
    stated = tuple(sorted({name for recording in recordings.values() for name in recording.stated}))
    same = all(recording.read_as == first.read_as for recording in rest)
    return first._replace(
        capture=capture,
        true=None,
        seed=None,
        spheres=(),
        sources=sources,
        stated=stated,
        read_as=first.read_as if same else None,
        recorded_as=None,
    )
