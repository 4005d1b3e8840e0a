"""What was done wrong in a recording whose data do not match the arm: one search for all who ask.

If most poses agree with an arm near the nominal one (`rough_fit`), the mistake is in the others, in the reference
lengths, or in a parameter that is far from what was stated. Else single mistakes in the readings and in what was
measured are tried on the nominal arm (`corrections`), and last all orders, signs and zeros (`capture_check`).
"""

import itertools
from collections.abc import Mapping

import numpy as np

from ..core.errors import InputError
from ..core.text import shorten
from ..core.units import DEG
from ..data.capture import Capture, draw_poses
from ..data.observations.held import position_of
from ..data.observations.pixels import Pixels
from ..kinematics.arm import is_length, value_of
from ..kinematics.parameters import ArmSpecification
from ..kinematics.workspace import total_link_length
from .camera_points import with_points_of_cameras
from .capture_check import check_capture
from .corrections import UNITS, Mistake, likely_cause
from .equations import PROBE
from .findings import Case, by_equations
from .misplaced_poses import Misplaced, misplaced_poses
from .reading_check import ReadingCheck, coupling_words, explanation_words
from .rough_fit import RoughFit, rough_fit

TRY_ALL = "aacmm arm ARM --check MANIFEST tries every order and sign of the columns, and zero offsets of the joints."
_CHECKED = 150  # poses, drawn at random: more only take longer
_BETTER = 2.0  # the factor by which other readings must reduce the residual to be believed
_MAINLY = 3.0  # the factor by which the offset of the tip must exceed changes of other lengths to be the cause
_FAR_OFF = 0.01  # of the arm's size: what is left of images that are not those of the poses
_CLOSE = 0.02  # of a length: what the parameters of a real arm can change it by


@by_equations
def fitted_roughly(case: Case) -> RoughFit | None:
    """The robust fit of the capture of a calibration."""
    return rough_fit(case.record.recording.nominal, with_points_of_cameras(case.record.recording.capture))


@by_equations
def misplaced(case: Case) -> list[Misplaced]:
    """The poses that are wrong where most others agree with an arm."""
    fit = case.once(fitted_roughly)
    return [] if fit is None else misplaced_poses(fit, with_points_of_cameras(case.record.recording.capture))


@by_equations
def single_mistake(case: Case) -> Mistake | None:
    """The one mistake that explains why data do not match the arm, where it is found without a long search."""
    record, fit, wrong = case.record, case.once(fitted_roughly), case.once(misplaced)
    nominal, capture = record.recording.nominal, with_points_of_cameras(record.recording.capture)
    if fit is None:
        # An offset that somebody stated is right; the zero is then wrong in the arm.
        return likely_cause(nominal.arm, capture, nominal.space().names if "offset" in record.recording.stated else ())
    if wrong:
        first, *others = wrong
        also = f"; {shorten([f'{shorten(w.names, 3)}: {w.says}' for w in others], 2)}" if others else ""
        concerns = dict.fromkeys(name for mistake in wrong for name in mistake.concerns)
        return Mistake(f"Likely cause: {shorten(first.names, 3)}: {first.says}{also}.", tuple(concerns))
    far = _far_from_stated(fit, nominal) if fit.rms * _BETTER < record.residual else None
    return _of_lengths(fit, capture) or far


@by_equations
def mistake_in_data(case: Case) -> Mistake | None:
    """The same, also by the search of all orders, signs and zeros."""
    if case.once(fitted_roughly) is not None:
        return case.once(single_mistake)
    return case.once(single_mistake) or _of_check(case)


def _of_check(case: Case) -> Mistake | None:
    check = case.once(checked_readings)
    if check is None:
        return None
    if check.couplings:
        return Mistake(f"Likely cause: {coupling_words(check.couplings)}. {TRY_ALL}", of_readings=True)
    given, best = check.given.rms_fitted, check.best.rms_fitted
    record = case.record.recording
    cameras = shorten([part.name for part in record.capture.observations if isinstance(part, Pixels)], 3)
    if cameras and not check.explained and given > _FAR_OFF * total_link_length(record.nominal.arm):
        return Mistake(
            f"Likely cause: the images of {cameras} do not belong to the rows of the readings or are of several "
            "cameras, on_arm in the manifest is wrong, or the camera or target was moved: no order, signs and zeros of "
            "the joints explain what was seen."
        )
    if not check.explained or check.best == check.given or best * _BETTER > given:
        return None
    return Mistake(f"Likely cause: {explanation_words(check.best)}. {TRY_ALL}", of_readings=True)


@by_equations
def checked_readings(case: Case) -> ReadingCheck | None:
    """The order, signs and zeros with which the readings of a calibration fit; None where nothing can be compared."""
    recording = case.record.recording
    capture = recording.capture
    if len(capture.readings) > _CHECKED:
        capture = draw_poses(capture, _CHECKED)
    try:
        return check_capture(recording.nominal.arm, capture, recording.usual)
    except InputError:  # neither two poses in a socket nor measured points
        return None


def _of_lengths(fit: RoughFit, capture: Capture) -> Mistake | None:
    """Two sockets under each other's name, or lengths in another unit."""
    if not capture.lengths:
        return None
    places = {name: fit.parts[position_of(name)] for x in capture.lengths for name in (x.start, x.end)}
    stated = np.array([float(length.value) for length in capture.lengths])

    def measured(names: Mapping[str, str]) -> np.ndarray:
        ends = [(names.get(x.start, x.start), names.get(x.end, x.end)) for x in capture.lengths]
        return np.array([np.linalg.norm(places[a] - places[b]) for a, b in ends])

    def agree(sizes: np.ndarray) -> bool:
        return bool(np.all(np.abs(measured({}) - sizes) < _CLOSE * measured({})))

    if agree(stated):
        return None
    for cause, size in UNITS.items():
        if agree(size * stated):
            return Mistake(f"Likely cause: {cause} (reference lengths).")
    for a, b in itertools.combinations(places, 2):
        if np.all(np.abs(measured({a: b, b: a}) - stated) < _CLOSE * stated):
            return Mistake(f"Likely cause: the names of sockets {a} and {b} are exchanged (by the lengths).", (a, b))
    return None


def beyond_bounds(fit: RoughFit, nominal: ArmSpecification) -> dict[str, float]:
    """Parameters that a rough fit changes by more than their bounds allow, or those of lengths where the probe is
    fixed, and by how much, mm or rad."""
    bounds = nominal.bounds()
    half = dict(zip(bounds.space.names, (np.asarray(bounds.upper) - np.asarray(bounds.lower)) / 2, strict=True))
    change = {name: float(value_of(fit.arm, name)) - float(value_of(bounds.space.base, name)) for name in fit.names}
    return {name: value for name, value in change.items() if abs(value) > half.get(name, nominal.length)}


def _far_from_stated(fit: RoughFit, nominal: ArmSpecification) -> Mistake | None:
    """Parameters that are farther from the arm's file than their bounds allow."""
    far, free = beyond_bounds(fit, nominal), nominal.space().names
    if not far:
        return None
    texts = [f"{name} by {v:.3g} mm" if is_length(name) else f"{name} by {v / DEG:.3g} deg" for name, v in far.items()]
    differs = "the arm differs from what is stated in its file by more than the bounds allow"
    tip, offset = np.asarray(fit.arm.probe), np.asarray(fit.arm.probe) - np.asarray(nominal.arm.probe)
    others = [abs(change) for name, change in far.items() if is_length(name) and name not in PROBE]
    if np.linalg.norm(offset) > _MAINLY * max(others, default=0.0) and set(far) & set(PROBE):
        differs = (
            f"the tip of the probe is {np.linalg.norm(offset):.0f} mm from where it is stated in the arm's file, near "
            f"{', '.join(f'{x:.0f}' for x in tip)} mm in the last frame"
        )
    # Along the last axis, the length of the last link says the same as the probe.
    last = f"d_{nominal.arm.joints}"
    same = {"probe_z"} if last in free and not float(nominal.arm.alpha[-1]) else set()
    of_bounds = set(far) <= {*free, *same}
    return Mistake(f"Likely cause: {differs} ({shorten(texts, 4)}).", tuple(far), of_bounds=of_bounds)
