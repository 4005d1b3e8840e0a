"""The forty mistakes: what each changes, by how much, and which findings are right.

``unit`` says what a size is: "angle" (rad of a joint), "length" (mm), "share" (of a length) or "times" (of a standard
deviation, less 1). A mistake without a unit is made or not. ``right`` are patterns that a finding, written as
``code: sentence [names; that it concerns]``, must match; names in braces are what the mistake was made with. A right
finding names the culprit, not only that something is wrong. Codes that do not exist yet are those that such a finding
could have.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

import aacmm_jax as aj

from .cases import Case
from .trial import Trial

LOADED, BENT, TURNED = 1, 1, 2  # numbers of joints, from 0: what gravity loads, whose encoder errs, what is confused
DIRECTION = np.array([0.6, -0.48, 0.64])


class Kind(NamedTuple):
    """One mistake."""

    make: Callable[[Trial, float], None]
    unit: str  # "" where a mistake has no size
    physical: bool  # made before the capture is recorded
    right: tuple[str, ...]
    applies: Callable[[Case], bool] = lambda case: True


def _of_joint(trial: Trial, joint: int, error: Callable[[Trial, np.ndarray, np.ndarray], np.ndarray]) -> None:
    """Let one joint turn by more than it reads."""

    def errors(q: np.ndarray, time: np.ndarray) -> np.ndarray:
        turned = np.zeros_like(q)
        turned[:, joint] = error(trial, q, time)
        return turned

    trial.joint_errors.append(errors)
    trial.culprit["joint"] = str(joint + 1)


def joint_error(joint: int, error: Callable[[Trial, np.ndarray, np.ndarray], np.ndarray]) -> Callable:
    """A mistake that makes one joint turn by ``size`` times a function of trial, readings and time."""

    def make(trial: Trial, size: float) -> None:
        _of_joint(trial, joint, lambda trial, q, time: size * error(trial, q, time))

    return make


def gravity_moment(trial: Trial, q: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Moment of a mass at the tip about the loaded joint, as a share of the largest."""
    column = np.asarray(trial.true.jacobian(q, (f"q_{LOADED + 1}",)))[:, 2, 0]
    reach = float(np.abs(np.asarray(trial.true.a)).sum() + np.abs(np.asarray(trial.true.d)[1:]).sum())
    return -column / reach


def approached(trial: Trial, q: np.ndarray, time: np.ndarray) -> np.ndarray:
    """From which side each pose was approached: at random, and not recorded."""
    return np.where(np.random.default_rng(7).uniform(size=len(q)) < 0.5, -1.0, 1.0)


def _half(trial: Trial) -> np.ndarray:
    """The later poses of a capture: from the middle of a group on."""
    return trial.time > 0.43


def _second_group(trial: Trial) -> np.ndarray:
    """Poses of the second group: a socket, hole, sphere or station. A finding may name the placement of a hole."""
    groups = list(dict.fromkeys(trial.label))
    name = groups[min(1, len(groups) - 1)]
    trial.culprit["group"] = name.partition("/")[0]
    return trial.label == name


def _later_of_group(trial: Trial) -> np.ndarray:
    rows = np.flatnonzero(_second_group(trial))
    return rows[len(rows) // 2 :]


def _a_pose(trial: Trial) -> int:
    """Number of a pose in the second group."""
    row = int(np.flatnonzero(_second_group(trial))[4])
    trial.culprit["pose"] = pose_name(trial, row)
    return row


def pose_name(trial: Trial, row: int) -> str:
    """A pose as findings name it: its socket or observation, and its number there, hole after hole."""
    owner = trial.label[row].partition("/")[0]
    rows = [i for i, label in enumerate(trial.label) if label.partition("/")[0] == owner]
    holes = list(dict.fromkeys(trial.label[rows]))
    return f"{owner} pose {sorted(rows, key=lambda i: holes.index(trial.label[i])).index(row) + 1}"


def growth(trial: Trial, size: float) -> None:
    trial.growth += size * trial.time


def base_moved(trial: Trial, size: float) -> None:
    trial.base[_half(trial)] += size * DIRECTION


def tip_moved(trial: Trial, size: float) -> None:
    trial.tool[_half(trial)] += size * DIRECTION


def seat_shift(trial: Trial, size: float) -> None:
    trial.seat[_later_of_group(trial)] += size * DIRECTION


def seat_scatter(trial: Trial, size: float) -> None:
    trial.scatter_factor[_second_group(trial)] += size
    if not trial.noise:  # the same errors, without any other
        trial.seat[_second_group(trial)] += size * trial.case.u * _errors(trial)[_second_group(trial)]


def _errors(trial: Trial) -> np.ndarray:
    return np.random.default_rng(11).normal(size=trial.tips.shape)


def pose_unseated(trial: Trial, size: float) -> None:
    trial.seat[_a_pose(trial)] += size * DIRECTION


def noisy_encoder(trial: Trial, size: float) -> None:
    trial.encoder_factor[TURNED] += size
    trial.culprit["joint"] = str(TURNED + 1)
    if not trial.noise:
        errors = np.random.default_rng(5).normal(size=len(trial.tips)) * np.radians(trial.case.encoder_arcsec / 3600)
        _of_joint(trial, TURNED, lambda trial, q, time: size * errors[: len(q)])


def commanded(trial: Trial, size: float) -> None:
    """The tables hold commands and readings, and the manifest picks the commands, which every joint misses: by gravity
    where it is loaded, and at random everywhere."""
    trial.commands = True
    missed = np.random.default_rng(3).normal(size=trial.exact.shape)
    trial.joint_errors.append(lambda q, time: size * missed[: len(q)])
    _of_joint(trial, LOADED, lambda trial, q, time: size * gravity_moment(trial, q, time))


def two_joints(trial: Trial, size: float) -> None:
    """All joints but two stand nearly still, where an instrument sees the tip anywhere."""
    trial.exact = trial.exact.copy()
    trial.exact[:, 2:] = trial.exact[0, 2:] + np.radians(0.2) * np.random.default_rng(2).normal(
        size=trial.exact[:, 2:].shape
    )


def close_together(trial: Trial, size: float) -> None:
    """All poses of a group lie within a degree or two of one."""
    trial.exact = trial.exact.copy()
    for name in dict.fromkeys(trial.label):
        rows = np.flatnonzero(trial.label == name)
        near = trial.exact[rows[:1]] if not trial.case.instrument else trial.exact[:1]
        trial.exact[rows] = near + np.radians(0.5) * np.random.default_rng(2).normal(size=trial.exact[rows].shape)


def tool_misplaced(trial: Trial, size: float) -> None:
    """The manifest's arm has its probe somewhere else by more than bounds allow, which every fit would take up."""
    trial.arm["probe"] = (np.array(trial.arm.get("probe", [0.0, 0.0, 0.0])) + 120.0 * DIRECTION).tolist()


def _identification(trial: Trial) -> dict:
    """The table [identification] of the arm, with the parameters fixed that are fixed without it."""
    with tempfile.TemporaryDirectory() as folder:
        space = aj.files.read_manifest(trial.write(Path(folder))).nominal.space()
    stated = trial.arm.setdefault("identification", {})
    stated["held"] = list(space.held)
    stated["free"] = [name for name in space.names if name.startswith("beta")]
    return stated


def fixed_wrong(trial: Trial, size: float) -> None:
    """A length that matters is fixed at a wrong value."""
    _identification(trial)["held"].append("a_2")
    trial.arm["joint"][1]["a"] = float(np.asarray(trial.true.a)[1]) + size
    trial.culprit["parameter"] = "a_2"


def bounds_tight(trial: Trial, size: float) -> None:
    """The zero of a joint is twice as far from nominal as its bounds allow."""
    stated, in_file = _identification(trial), 1.0 if trial.arm["angle_unit"] == "rad" else np.degrees(1.0)
    stated["override"] = dict(stated.get("override", {})) | {"theta_3": float(size * in_file)}
    trial.arm["joint"][2]["theta"] = float((np.asarray(trial.true.theta)[2] + 2 * size) * in_file)
    trial.culprit["parameter"] = "theta_3"


def reading_mistyped(trial: Trial, size: float) -> None:
    trial.readings[_a_pose(trial), TURNED] += size


def value_mistyped(trial: Trial, size: float) -> None:
    """One measured coordinate or distance."""
    trial.measured[_a_pose(trial), 0] += size


def pose_mislabelled(trial: Trial, size: float) -> None:
    """One pose is recorded under the name of another socket, hole or sphere."""
    row = _a_pose(trial)
    trial.label[row] = trial.label[0]
    trial.culprit["pose"] = pose_name(trial, row)


def rows_swapped(trial: Trial, size: float) -> None:
    """Readings of two poses are exchanged, of different sockets or holes if something holds the tip."""
    row = _a_pose(trial)
    other = row + 9 if trial.case.instrument else int(np.flatnonzero(trial.label == trial.label[0])[3])
    trial.readings[[row, other]] = trial.readings[[other, row]]
    trial.culprit["other"] = pose_name(trial, other)


def row_late(trial: Trial, size: float) -> None:
    trial.readings = np.roll(trial.readings, 1, axis=0)


def duplicates(trial: Trial, size: float) -> None:
    rows = np.concatenate([np.arange(len(trial.label)), np.arange(0, len(trial.label), 3)])
    trial.label, trial.readings = trial.label[rows], trial.readings[rows]
    trial.measured = trial.measured[rows] if len(trial.measured) else trial.measured


def certified_mistyped(trial: Trial, size: float) -> None:
    name = list(trial.certified)[1]
    trial.certified[name] = trial.certified[name] + size * np.eye(len(trial.certified[name]))[0]
    trial.culprit["value"] = name


def artefact_bent(trial: Trial, size: float) -> None:
    """The artefact is bent since its certificate: every second point is higher, or length and diameter larger, and the
    others are lower or smaller."""
    for number, name in enumerate(trial.certified):
        value = trial.certified[name].copy()
        value[-1] += size * (number % 2 * 2 - 1)
        trial.certified[name] = value


def scale_wrong(trial: Trial, size: float) -> None:
    """Every certified or measured length is wrong by one per cent, which no residual shows, but no arm is."""
    if trial.case.instrument:
        trial.measured[:, :3] *= 1.01
    trial.certified = {name: value * 1.01 for name, value in trial.certified.items()}


def groups_exchanged(trial: Trial, size: float) -> None:
    """Names of two sockets, or of two holes in one placement, are exchanged; or the file of one station or pivot begins
    with the last rows of another."""
    groups = list(dict.fromkeys(trial.label))
    if trial.case.instrument:
        trial.label[np.flatnonzero(trial.label == groups[0])[-6:]] = groups[1]
        trial.culprit["group"] = groups[1]
        return
    first, other = (trial.label == name for name in groups[1:3])
    trial.label[first], trial.label[other] = groups[2], groups[1]
    trial.culprit["group"] = groups[1].partition("/")[0]


def converted(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """A mistake of conventions: the readings that are written, and shown when the arm is used, are changed."""

    def make(trial: Trial, size: float) -> None:
        trial.misread.append(change)
        trial.culprit["joint"] = str(TURNED + 1)

    return make


def _one_column(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def changed(q: np.ndarray) -> np.ndarray:
        q = q.copy()
        q[:, TURNED] = change(q[:, TURNED])
        return q

    return changed


def length_unit(trial: Trial, size: float) -> None:
    """Values in another unit than stated: m for mm, cm for mm of lengths."""
    trial.measured = trial.measured.copy()
    if trial.case.instrument:
        trial.measured[:, :3] /= 1000.0
    trial.certified = {name: value / 10.0 for name, value in trial.certified.items()}


def left_handed(trial: Trial, size: float) -> None:
    """Two axes of measured points are exchanged."""
    trial.measured[:, :2] = trial.measured[:, 1::-1]


def stated_u(factor: float) -> Callable:
    def make(trial: Trial, size: float) -> None:
        trial.u_factor = factor

    return make


_MOVED = r"(base|station|instrument|socket|artefact)[^.]*\bmoved|^base-moved|drift of the tip"
_TIP = r"(probe|target|tool)[^.,;]*(remounted|displaced|moved)|^tip-moved"
_POSE = (r"\[{pose}[\];]",)
_SWAPPED = (r"\[({pose}|{other})[\];]",)
_GROUP = (r"\b{group} [^.]*(moved|shift|contradict|scatter)", r"^[a-z-]+:.*\[{group}\]")
_DRIFT = r"drift of joint {joint}|zero of joint {joint}|^joint-drift.*joint {joint}"
_UNDETERMINED = (
    r"close together|small part of",
    r"^(standing-joints|undetermined|poorly-determined|little-redundancy|weak-on-bounds)",
)


def _several(case: Case) -> bool:
    return len(case.groups) > 1


def _not_instrument(case: Case) -> bool:
    return not case.instrument


KINDS: dict[str, Kind] = {
    # Joints
    "bending": Kind(joint_error(LOADED, gravity_moment), "angle", True,
        (r"gravity about joint {joint}", r"bend[^.]*joint {joint}", r"cos q_{joint}")),
    "eccentric": Kind(joint_error(BENT, lambda trial, q, time: np.cos(q[:, BENT] + 1.0)), "angle", True,
        (r"(cos|sin) q_{joint}", r"eccentric[^.]*joint {joint}")),
    "second harmonic": Kind(joint_error(TURNED, lambda trial, q, time: np.cos(2 * q[:, TURNED])), "angle", True,
        (r"(cos|sin) 2 q_{joint}", r"(tilted|oval)[^.]*joint {joint}")),
    "gear ratio": Kind(joint_error(BENT, lambda trial, q, time: q[:, BENT]), "angle", True,
        (r"gear[^.]*joint {joint}", r"q_{joint} \(gear")),
    "coupling": Kind(joint_error(TURNED, lambda trial, q, time: q[:, BENT]), "angle", True,
        (r"coupl[^.]*joint {joint}", r"joint {joint}[^.]*follows joint 2")),
    "backlash": Kind(joint_error(BENT, approached), "angle", True,
        (r"(play|backlash|noisier)[^\[]*joint {joint}", r"^noisy-encoder.*\[joint {joint}\]")),
    "payload": Kind(joint_error(LOADED, lambda trial, q, time: gravity_moment(trial, q, time) * (time > 0.5)),
        "angle", True, (r"(load|gravity)[^.]*joint {joint}",)),
    "slipped zero": Kind(joint_error(TURNED, lambda trial, q, time: 1.0 * (time > 0.43)), "angle", True, (_DRIFT,)),
    "drifting zero": Kind(joint_error(TURNED, lambda trial, q, time: time), "angle", True, (_DRIFT,)),
    "noisy encoder": Kind(noisy_encoder, "times", True, (r"^noisy-encoder.*\[joint {joint}\]",)),
    "commanded for measured": Kind(commanded, "angle", True, (r"command",)),
    # Arm, base and tip
    "growth": Kind(growth, "share", True, (r"growth of the arm", r"temperature")),
    "base moved": Kind(base_moved, "length", True, (_MOVED,)),
    "tip moved": Kind(tip_moved, "length", True, (_TIP,)),
    "tool misplaced": Kind(tool_misplaced, "", False, (r"\[probe_[xyz]", r"(tool|probe)[^.]*stated"),
        lambda case: not case.target and case.kind != "transforms"),
    "fixed parameter wrong": Kind(fixed_wrong, "length", False, (r"{parameter}\b.*(fixed|held|free)",)),
    "bounds too tight": Kind(bounds_tight, "angle", False, (r"^on-bounds.*\[{parameter}[\];]",)),
    # Seats
    "seat shifts": Kind(seat_shift, "length", True, _GROUP, _several),
    "seat scatters": Kind(seat_scatter, "times", True, _GROUP, _several),
    "pose unseated": Kind(pose_unseated, "length", True, _POSE),
    # Rows
    "reading mistyped": Kind(reading_mistyped, "angle", False, _POSE),
    "value mistyped": Kind(value_mistyped, "length", False, _POSE, lambda case: case.instrument),
    "pose mislabelled": Kind(pose_mislabelled, "", False, _POSE, _not_instrument),
    "rows swapped": Kind(rows_swapped, "", False, _SWAPPED),
    "one row late": Kind(row_late, "", False, (r"row[^.]*(late|shift|earlier|behind)",)),
    "duplicates": Kind(duplicates, "", False, (r"^repeated", r"[Dd]uplicate")),
    # Artefacts and instruments
    "certified value mistyped": Kind(certified_mistyped, "length", False, (r"{value} differs", r"\[{value}[\];]"),
        _not_instrument),
    "artefact bent": Kind(artefact_bent, "length", False, (r"bent|shape", r"^lengths-disagree"), _not_instrument),
    "scale wrong": Kind(scale_wrong, "", False, (r"^scale-far-from-1", r"scale of the (instrument|lengths|artefact)")),
    "groups exchanged": Kind(groups_exchanged, "", False, (r"exchang[^.]*{group}", r"^[a-z-]+:.*\[{group}[\];]"),
        lambda case: case.kind != "touched_sphere" and _several(case)),
    # Conventions
    "wrong sign": Kind(converted(_one_column(lambda column: -column)), "", False, (r"sign[^.]*(joint|column) {joint}",
        r"(joint|column) {joint}[^.]*sign")),
    "swapped columns": Kind(converted(lambda q: q[:, [0, 1, 2, 4, 3, *range(5, q.shape[1])]]), "", False,
        (r"4 and 5[^.]*exchang", r"exchang[^.]*4 and 5")),
    "wrong offset": Kind(converted(_one_column(lambda column: column + np.radians(30.0))), "", False,
        (r"zero of joint {joint}", r"offset[^.]*joint {joint}", r"\[theta_{joint}\]")),
    "degrees for radians": Kind(converted(np.degrees), "", False, (r"degrees|in deg|\bdeg\b|unit of the readings",)),
    "wrong unit of lengths": Kind(length_unit, "", False, (r"\bin (m|cm|metres|inches)\b", r"^implausible-scale")),
    "left-handed": Kind(left_handed, "", False, (r"left-handed|mirror|exchanged axes|columns of positions are y x z",),
        lambda case: case.kind in ("points", "transforms")),
    "u too small": Kind(stated_u(0.1), "", False, (r"\bu\b[^.]*too small|^lengths-disagree|u and the|their u\b",)),
    "u too large": Kind(stated_u(10.0), "", False, (r"\bu\b[^.]*too large",)),
    # Poses
    "two joints moved": Kind(two_joints, "", True, _UNDETERMINED, lambda case: case.instrument),
    "poses too close": Kind(close_together, "", True, _UNDETERMINED),
}  # fmt: skip
