"""What `calibrate_capture` decides where nothing is said: couplings, bounds, groups left out, the model of joints.

Each remedy is tried only where the calibration shows that it is needed, is kept only where it helps, and says in one
sentence what was done and why. What somebody stated is never overruled: stated bounds stay, and with a stated model,
prior, method or robust loss no models are compared.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..calibration.record import CalibrationRecord, Removed
from ..calibration.results import Calibration, Identification
from ..core.distributions import f_tail
from ..core.errors import InputError
from ..core.text import MODEL_CHOSEN, shorten
from ..core.units import DEG
from ..data.capture import Capture, part_of
from ..data.recording import Recording
from ..diagnostics.capture_check import search_couplings
from ..diagnostics.causes import term_text
from ..diagnostics.contradictions import POSE, POSES, remove_contradicting, with_removed
from ..diagnostics.culprits import culprits_of
from ..diagnostics.equations import EXACT
from ..diagnostics.findings import case_of
from ..diagnostics.misplaced_poses import Misplaced
from ..diagnostics.mistakes import beyond_bounds, fitted_roughly, misplaced
from ..diagnostics.pose_residuals import distances_of
from ..diagnostics.reading_check import coupling_words
from ..diagnostics.residual_tests import LEVEL
from ..diagnostics.scale import lengths_of
from ..diagnostics.usability import many_on_bounds, on_bounds
from ..kinematics.arm import correction_names, is_length, value_of, without_corrections
from ..kinematics.corrected_arm import with_further_corrections
from ..kinematics.corrections import all_sought
from ..kinematics.parameters import ArmSpecification
from ..kinematics.priors import default_prior
from ..kinematics.workspace import total_link_length
from .model_ladder import ComparedModels, compare_models, default_models

Solve = Callable[[Recording], Calibration | Identification]
Record = Callable[[Calibration | Identification, Recording], CalibrationRecord]

_WIDER, _ROUNDS = 5.0, 4  # factor by which bounds that were reached are widened, and how often
_AS_GOOD = 1.02  # factor of the residuals up to which a calibration without parameters on such bounds is taken
_WIDEST = np.pi / 2  # rad
_BEYOND = 1.5  # half-width of a bound, over the change of its parameter in a rough fit
_SIZE = 2.0  # factor within which the size of an arm stays that of the nominal one
_BY_CHANCE = 0.01  # probability of so much smaller residuals by chance, below which wider bounds are kept
_BETTER = 2.0  # the factor by which leaving out poses must reduce the residual
_MOST = 0.5  # part of the excess of the residuals that a cause explains, from which it explains most of them
_PLAIN = "dh"
_SOME, _FUNCTIONS = "harmonics=1-6", "functions"
_NOTICED = 1.03  # times the errors of the arm alone in held-out regions, from which a model is not taken
_WORTH = 10.0  # log evidence that a richer model must add for a still richer one to be tried


def with_full_couplings(record: CalibrationRecord, solve: Solve, recorded: Record, further: bool) -> CalibrationRecord:
    """The calibration with joints that move by the readings of others as well, where the readings do not fit the arm
    without (`search_couplings`); else as it is.

    Where a model is stated (not ``further``), only its own couplings are set, and none with a stated value. A coupling
    is a coefficient like any other, but its nominal value, which is the mean of its prior, is 1 or -1 instead of 0.
    """
    nominal, capture = record.recording.nominal, record.recording.capture
    try:
        couplings = search_couplings(without_corrections(nominal.arm), capture)
    except InputError:  # neither sockets nor points
        return record
    missing = [name for name in couplings if name not in correction_names(nominal.arm)]
    stated = any(value_of(nominal.arm, name) for name in couplings if name not in missing)
    if not couplings or stated or (missing and not further):
        return record
    arm = with_further_corrections(nominal.arm, missing).replace(**couplings)
    recording = record.recording._replace(nominal=nominal._replace(arm=arm))
    again = recorded(solve(recording), recording)
    if not again.observed.rms < record.observed.rms:
        return record
    says = (
        f"The readings fit an arm with coupled joints: {coupling_words(couplings)}. The residuals fell from "
        f"{record.observed.rms:.3g} to {again.observed.rms:.3g} mm RMS."
    )
    return again._replace(decisions=(*record.decisions, says))


def with_wider_bounds(record: CalibrationRecord, solve: Solve, recorded: Record) -> CalibrationRecord:
    """The calibration with wider bounds where parameters ended on one not stated, and the residuals are smaller
    by more than chance explains; else as it is."""
    first, nominal = on_bounds(record), record.recording.nominal
    if not first or "bounds" in nominal.stated:
        return record
    best, wider = record, record
    # What a robust fit within far wider bounds shows to be needed, where residuals are large.
    fit = None if matches(record) else case_of(record).once(fitted_roughly)
    needed = {} if fit is None else beyond_bounds(fit, nominal)
    needed = {name: change for name, change in needed.items() if name in record.names}
    for _ in range(_ROUNDS):
        reached = {*on_bounds(wider), *on_bounds(wider, final=True)}
        if not reached:
            break
        widths = {name: _WIDER * _half_width(wider.recording.nominal, name) for name in reached}
        if needed:
            widths, needed = {name: _BEYOND * abs(change) for name, change in needed.items()}, {}
            reached = set(widths)
        recording = wider.recording._replace(nominal=_widened(wider.recording.nominal, widths))
        try:
            result = solve(recording)
        except InputError:  # with such bounds the data do not determine the arm
            break
        wider = recorded(result, recording)
        size, usual = (total_link_length(arm) for arm in (wider.calibrated.arm, nominal.arm))
        # Points in a wrong unit fit an arm that shrinks, or grows, with its bounds.
        of_this_size = usual / _SIZE < size < usual * _SIZE
        # A bound that was set here is to hold no parameter, since U counts none that are on a bound.
        frees = best is not record and not on_bounds(wider) and wider.observed.rms < _AS_GOOD * best.observed.rms
        if wider.converged and of_this_size and (frees or _is_better(wider, best, len(reached))):
            best = wider
    if best is record:
        return record
    widths = {name: _half_width(best.recording.nominal, name) for name in best.names}
    texts = [
        f"{name} (to ±{width:.3g} mm)" if is_length(name) else f"{name} (to ±{width / DEG:.3g} deg)"
        for name, width in widths.items()
        if width > _half_width(nominal, name)
    ]
    says = (
        f"Default bounds were widened where the fit reached them: {shorten(texts, 4)}. The residuals fell from "
        f"{record.observed.rms:.3g} to {best.observed.rms:.3g} mm RMS."
    )
    return best._replace(decisions=(*record.decisions, says))


def _half_width(nominal: ArmSpecification, name: str) -> float:
    """Half-width of the bounds of a parameter, mm or rad."""
    return nominal.override.get(name, nominal.length if is_length(name) else nominal.angle)


def _widened(nominal: ArmSpecification, widths: dict[str, float]) -> ArmSpecification:
    widths = {name: width if is_length(name) else min(width, _WIDEST) for name, width in widths.items()}
    return nominal._replace(override={**nominal.override, **widths})


def _is_better(wider: CalibrationRecord, record: CalibrationRecord, widened: int) -> bool:
    """Whether residuals are smaller by more than chance explains, by the F test of so many further parameters."""
    before, after = record.observed.rms**2, max(wider.observed.rms**2, 1e-300)
    freedom = max(wider.degrees_of_freedom, 1.0)
    return f_tail(max(before - after, 0.0) * freedom / widened / after, widened, freedom) < _BY_CHANCE


def with_wrong_fixed_freed(record: CalibrationRecord, solve: Solve, recorded: Record) -> CalibrationRecord:
    """The calibration with further free parameters, where nobody stated which are free, a parameter that is fixed at
    a wrong value explains most of the residuals, and these are smaller by more than chance without that; else as it
    is."""
    nominal, case = record.recording.nominal, case_of(record)
    if "parameters" in nominal.stated or record.implausible_residual:
        return record
    # Of smaller parts, errors that the model lacks take as well, and other placements are then predicted no better.
    causes = [cause for cause in culprits_of(case) if cause.explains > _MOST]
    wrong = [cause.name for cause in causes if cause.kind == "fixed"]
    zeros = [cause.term.joint for cause in causes if cause.term is not None and cause.term.kind == "zero"]
    wrong += [case.equations.extra[joint - 1] for joint in zeros if joint is not None]
    if not wrong:
        return record
    held = tuple(name for name in nominal.space().held if name not in wrong)
    free = (*nominal.free, *(name for name in wrong if name.startswith("beta")))
    recording = record.recording._replace(nominal=nominal._replace(held=held, free=free))
    try:
        again = recorded(solve(recording), recording)
    except InputError:
        return record
    if not again.converged or not _is_better(again, record, len(wrong)):
        return record
    found = {name: float(value_of(again.calibrated.arm, name) - value_of(nominal.arm, name)) for name in wrong}
    texts = [
        f"{name} ({by:+.2g} mm)" if is_length(name) else f"{name} ({by / DEG:+.2g} deg)" for name, by in found.items()
    ]
    says = (
        f"Freed, since the data contradict the nominal value at which it was fixed: {shorten(texts, 4)}. The residuals "
        f"fell from {record.observed.rms:.3g} to {again.observed.rms:.3g} mm RMS."
    )
    return again._replace(decisions=(*record.decisions, says))


def without_misplaced(record: CalibrationRecord, solve: Solve, recorded: Record) -> CalibrationRecord:
    """The calibration without the poses that are wrong where most others agree with an arm (`misplaced_poses`), which
    were recorded under a wrong name, with the readings of another pose, or with a reading that is far off."""
    wrong = [] if matches(record) else case_of(record).once(misplaced)
    if not wrong:
        return record
    capture, numbers = record.recording.capture, [pose for mistake in wrong for pose in mistake.poses]
    kept = np.isin(np.arange(len(capture.readings)), numbers, invert=True)
    ends = np.cumsum([part.q.shape[0] for part in capture.parts])[:-1]
    rows = {part.name: np.flatnonzero(of) for part, of in zip(capture.parts, np.split(kept, ends), strict=True)}
    part = record.recording._replace(capture=part_of(capture, [name for name in rows if len(rows[name])], rows))
    try:
        again = recorded(solve(part), part)
    except InputError:  # the rest does not determine the arm
        return record
    if not again.converged or again.residual > min(record.residual / _BETTER, again.largest_plausible_residual):
        return record
    distances = np.concatenate(distances_of(capture, record.evaluations()["calibrated"]))
    left_out = [_removed(mistake, again, float(np.sqrt(np.mean(distances[kept] ** 2)))) for mistake in wrong]
    return with_removed(record, again, left_out)._replace(decisions=record.decisions)


def matches(record: CalibrationRecord) -> bool:
    """Whether data and arm belong together, as far as a solve within its bounds shows it."""
    return record.converged and record.residual <= record.largest_usual_residual and not many_on_bounds(record)


def _removed(mistake: Misplaced, again: CalibrationRecord, rms: float) -> Removed:
    """Poses that were left out, with the F test of their distances."""
    count, freedom = 3 * len(mistake.poses), max(int(again.degrees_of_freedom), 1)
    ratio = (mistake.distance / max(again.residual, 1e-300)) ** 2
    return Removed(
        kind=POSE if len(mistake.poses) == 1 else POSES,
        group=f"{shorten(mistake.names, 3)} ({mistake.says})",
        members=mistake.concerns,
        ratio=ratio,
        degrees_of_freedom=(count, freedom),
        probability=f_tail(ratio, count, freedom),
        rms_with=rms,
    )


def without_contradicting(record: CalibrationRecord, solve: Solve, recorded: Record) -> CalibrationRecord:
    """The calibration without groups that contradict all others, where the data show which groups these are."""

    def solved(capture: Capture) -> CalibrationRecord:
        part = record.recording._replace(capture=capture)
        return recorded(solve(part), part)

    kept = remove_contradicting(record, solved)
    return kept._replace(decisions=record.decisions)


def with_best_model(record: CalibrationRecord, solve: Solve, recorded: Record, options: Any) -> CalibrationRecord:
    """The calibration with the model of the joints that predicts held-out regions best; as it is where that is the arm
    alone, where there are too few poses to hold some out, or where a wrong certified value explains most of the
    residuals: a model would only describe what that does to the arm."""
    recording, nominal = record.recording, record.recording.nominal
    if record.observed.rms < EXACT or not record.names:  # simulated without noise, or only geometry was identified
        return record
    case = case_of(record)
    causes, lengths = culprits_of(case), case.once(lengths_of)
    if causes and causes[0].kind == "certified" and causes[0].explains > _MOST:
        return record
    if not causes and lengths is not None and lengths.odd and lengths.probability < LEVEL:
        return record
    ladder = _ladder(recording, options)
    if ladder is None:
        return record
    chosen, plain = ladder.recommended, ladder.models[0]
    if chosen.model == _PLAIN or plain.model != _PLAIN or not chosen.result.converged:
        return record
    # Few regions cannot tell such a model from the best, but whoever asked for none would be served worse.
    if chosen.rms_outside > _NOTICED * plain.rms_outside:
        return record
    better = chosen.rms_outside < plain.rms_outside
    found = [cause.term for cause in causes if cause.kind == "term" and cause.term is not None]
    terms = [term_text(term) for term in found if term.kind in all_sought() or term.term.correction is not None]
    follow = f" Without it, residuals follow {shorten(terms, 3)}." if terms else ""
    gain = f"{100 * (1 - chosen.rms_outside / plain.rms_outside):.2g} % smaller than " if better else ""
    difference, u = ladder.excess(_PLAIN, over=chosen.model)
    says = (
        f"{MODEL_CHOSEN}: {chosen.model}. It adds {chosen.parameters - plain.parameters} coefficients.{follow} In "
        f"held-out regions its errors are {chosen.rms_outside:.3g} mm RMS, {gain}those of Denavit-Hartenberg "
        f"parameters alone, {plain.rms_outside:.3g} mm ({len(ladder.models)} models compared, {len(chosen.regions)} "
        f"regions; difference {abs(difference):.2g} mm, standard error {u:.2g} mm)."
        + ("" if better else " As these hardly differ, the model that makes the measurements more probable was taken.")
    )
    corrected = chosen.result.space.base
    modelled = recording._replace(nominal=nominal._replace(arm=corrected, prior=default_prior(corrected)))
    again = recorded(chosen.result if options.shared_errors else solve(modelled), modelled)
    return again._replace(removed=record.removed, decisions=(*record.decisions, says))


def _ladder(recording: Recording, options: Any) -> ComparedModels | None:
    """The default models as far as the data can carry them; None where there are too few poses to hold some out."""
    nominal, capture = recording.nominal, recording.capture

    def compared(models: list[str]) -> ComparedModels:
        return compare_models(nominal, capture, models=models, noise=options.noise)

    models = [model for model in default_models(nominal.arm, capture) if _FUNCTIONS not in model]
    ladder: ComparedModels | None = None
    try:
        tried = ladder = options.stage("Comparing models", lambda: compared(models))
        # Models with more functions of each joint take longer, and the next is tried only where the last explains more.
        for functions in (_SOME, _FUNCTIONS):
            before = max(tried.models, key=lambda model: model.log_evidence)
            richer = _with_functions(before.model, functions)
            added = options.stage(f"Comparing models ({richer})", lambda model=richer: compared([model]))
            tried = ladder = tried._replace(models=(*tried.models, *added.models))
            if added.models[0].log_evidence < before.log_evidence + _WORTH:
                break
    except (InputError, np.linalg.LinAlgError):  # too few poses to hold some out, or to fit that many functions
        pass
    return ladder


def _with_functions(model: str, functions: str) -> str:
    """A model with these functions of each joint in place of its own."""
    kinds = [kind for kind in model.split(",") if kind != _PLAIN and not kind.startswith("harmonics")]
    return ",".join(
        [*kinds[:1], functions, *kinds[1:]] if kinds[:1] in (["gravity"], ["torque"]) else [functions, *kinds]
    )
