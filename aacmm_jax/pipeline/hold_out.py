"""Poses that a calibration does not use, to test it on: which they are, and how they agree with it; and the residuals
of all poses, one by one."""

import fnmatch
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from ..acceptance.record import EvaluationRecord
from ..calibration.agreement import CrossValidation
from ..calibration.pose_table import HELD_OUT, PoseResiduals, joined_rows, residuals_by_pose
from ..calibration.record import CalibrationRecord, uncertainty_of
from ..core.arguments import checked_arguments
from ..core.errors import InputError, nearest
from ..core.random_keys import random_generator
from ..data.capture import Capture, drawn_poses, names_in, part_of
from .cross_validation import distances_by, left_out_group

Masks = Mapping[str, Bool[np.ndarray, " m"]]  # observation -> which of its poses are held out


def held_out_poses(capture: Capture, hold_out: float | str | None, only_poses: int | None, seed: int) -> Masks:
    """The poses of each observation that are held out; nothing where neither option is given.

    A share is drawn at random from each observation, of which at least one pose is kept. A group is all observations
    of such a name, or of a name that begins with it and a slash, as those of a placement do. ``only_poses`` draws that
    many poses to keep from all observations together.
    """
    if hold_out is None and only_poses is None:
        return {}
    if hold_out is not None and only_poses is not None:
        raise InputError("--hold-out (hold_out) and --only-poses (only_poses) both choose poses; give one of them.")
    sizes = {part.name: part.q.shape[0] for part in capture.parts}
    if isinstance(hold_out, str):
        chosen = _of_group(names_in(capture), hold_out)
        masks = {name: np.full(size, name in chosen) for name, size in sizes.items()}
    elif hold_out is not None:
        masks = _share_of_each(sizes, float(hold_out), seed)
    else:
        masks = {name: ~drawn for name, drawn in drawn_poses(capture, only_poses or 0, seed).items()}
    if not any(np.any(mask) for mask in masks.values()):
        raise InputError(
            f"--hold-out {hold_out} (hold_out) of {sum(sizes.values())} poses in {len(sizes)} observations, each of "
            "which keeps at least one pose, is less than one pose; hold out a larger share, or a group."
        )
    if all(np.all(mask) for mask in masks.values()):
        raise InputError(f"--hold-out '{hold_out}' (hold_out) leaves no pose to calibrate with; hold out less.")
    return masks


def _of_group(names: Sequence[str], pattern: str) -> set[str]:
    """The observations with such a name, or in a placement or session with such a name."""
    chosen = {name for name in names if any(fnmatch.fnmatchcase(name, form) for form in (pattern, f"{pattern}/*"))}
    chosen |= {name for name in names if name == pattern}
    if not chosen:
        raise InputError(f"no socket or observation matches --hold-out '{pattern}' (hold_out){nearest(pattern, names)}")
    return chosen


def _share_of_each(sizes: Mapping[str, int], share: float, seed: int) -> Masks:
    """So large a share of the poses of each observation; rounding errors of one are made up for by the next."""
    if not 0 < share < 1:
        raise InputError(
            f"--hold-out {share:g} (hold_out) is not a share of the poses between 0 and 1; give such a share, or the "
            "name of a group."
        )
    random, masks, ends = random_generator(seed), {}, np.floor(share * np.cumsum([0, *sizes.values()]) + 0.5)
    for (name, size), count in zip(sizes.items(), np.diff(ends).astype(int), strict=True):
        masks[name] = np.zeros(size, dtype=bool)
        masks[name][random.choice(size, min(count, size - 1), replace=False)] = True
    return masks


def without_held_out(capture: Capture, masks: Masks) -> Capture:
    """The poses to calibrate with, and the reference lengths between sockets that have some."""
    return _where(capture, {name: ~mask for name, mask in masks.items()}) if masks else capture


def _where(capture: Capture, masks: Masks) -> Capture:
    names = [name for name in names_in(capture) if np.any(masks[name])]
    rows = {name: np.flatnonzero(masks[name]) for name in names}
    return part_of(capture, names, rows)


def tested(record: CalibrationRecord, capture: Capture, masks: Masks) -> CalibrationRecord:
    """With the residuals of the poses of the whole capture that were held out; where these are whole observations, they
    are the group of a cross-validation too, unless there is one."""
    names = set(names_in(record.recording.capture))  # without what contradicted the others
    names = [name for name in names_in(capture) if name in names or np.any(masks[name])]
    whole, uncertainty = part_of(capture, names), uncertainty_of(record)
    used = np.concatenate([~masks[name] for name in names_in(whole)])
    rows = residuals_by_pose(uncertainty, whole, used, record.observed.geometry).used_as(HELD_OUT)
    by_nominal = None
    if record.names:  # as in a calibration with all parameters of the arm held
        nominal = distances_by(record.recording.nominal.arm, record.recording.capture, whole, record.given_noise)
        by_nominal = np.concatenate(nominal)[~used]
    record = record._replace(held_out=rows, held_out_nominal=by_nominal)
    if record.validation is not None or any(0 < np.sum(mask) < len(mask) for mask in masks.values()):
        return record
    nominal = record.recording.nominal.arm
    group = left_out_group(uncertainty, _where(capture, masks), record.converged, nominal=nominal)
    return record._replace(validation=CrossValidation((group,)))


@checked_arguments
def residuals_of(record: CalibrationRecord | EvaluationRecord) -> PoseResiduals:
    """Residuals of a calibration or an evaluation, pose by pose, beside what is predicted for each.

    Held-out poses are compared with the geometry that the calibration found (the position of a socket, the frame of a
    station), and only geometry that nothing else shows is fitted to them. In an evaluation all geometry is fitted.

    Args:
        record: from `calibrate_capture` or `evaluate_capture`, or loaded from a file.

    Returns:
        Observation, number, use, residual (mm in the base frame), distance (mm) and its predicted standard uncertainty
        (mm) of every pose; see `calibration.PoseResiduals`.

    Raises:
        InputError: an evaluation of a file that does not hold the uncertainty of the calibration.

    Example:
        >>> calibrated = aj.calibrate_capture(aj.Recording(two_bars, nominal), noise=noise, hold_out=0.2)
        >>> rows = aj.residuals_of(calibrated)
        >>> print(rows.use.count("held out"), "of", len(rows.pose), "poses held out")
        12 of 60 poses held out
    """
    if isinstance(record, EvaluationRecord):
        capture = record.recording.capture
        if record.uncertainty is None:
            raise InputError("this evaluation does not contain the uncertainty of its calibration; evaluate it again.")
        used = [np.full(part.q.shape[0], part.name in record.used) for part in capture.parts]
        return residuals_by_pose(record.uncertainty, capture, np.concatenate(used), {})
    capture, others = record.recording.capture, record.held_out
    used = np.ones(len(capture.readings), dtype=bool)
    rows = residuals_by_pose(uncertainty_of(record), capture, used, record.observed.geometry)
    return rows if others is None else joined_rows(rows, others)
