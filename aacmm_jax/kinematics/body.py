"""The body of an arm as capsules that its frames carry: segments with a radius, about the links or about given shapes.

A capsule's ends may be in two frames, so that a link whose length changes with a joint keeps its ends.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_numpy
from .arm import Arm
from .chain import ForwardPass, forward_pass, joint_motion

_SHORTEST = 1e-6  # mm: shorter links have no capsule
_NEAR = 2.0  # times the sum of the radii: capsules that less of the arm joins than this are neighbours
_LARGEST_RADIUS = 2000.0  # mm


class Body(NamedTuple):
    """Capsules and the pairs of them that may not touch; lengths in mm.

    Frame 0 is the base, frame i the one after joint i.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0)
        >>> print(body.names[:3], body.radius[:3])
        ('offset d_1', 'link a_2', 'offset d_3') [40. 40. 40.]
    """

    names: tuple[str, ...]
    start_frame: Int[np.ndarray, " k"]
    start: Float[np.ndarray, "k 3"]  # in its frame
    end_frame: Int[np.ndarray, " k"]
    end: Float[np.ndarray, "k 3"]
    radius: Float[np.ndarray, " k"]
    pairs: Int[np.ndarray, "m 2"]


class Frames(NamedTuple):
    """Axes (columns) and origins of the frames 0 to n, in the base frame."""

    axes: Float[AnyArray, "f 3 3 N"]
    origins: Float[AnyArray, "f 3 N"]


def frames_at(arm: Arm, q: Float[AnyArray, "N n"]) -> Frames:
    """The frames of an arm at N configurations."""
    return frames_of(forward_pass(arm.geometry, joint_motion(arm.geometry, q)))


def frames_of(forward: ForwardPass) -> Frames:
    """The frames of a forward pass of N configurations."""
    xp = namespace(forward)
    z = xp.concatenate([forward.z_before[1:], forward.frame[2][None]])
    if forward.y is None:
        x = forward.x
        y = xp.cross(z, x, axis=-2)
    else:  # Hayati's rotation about y turns x
        y = forward.y
        x = xp.cross(y, z, axis=-2)
    base = xp.broadcast_to(xp.asarray(np.eye(3))[None, :, :, None], (1, 3, 3, z.shape[-1]))
    axes = xp.concatenate([base, xp.stack([x, y, z], axis=2)])
    return Frames(axes, xp.concatenate([xp.zeros_like(forward.origin[:1]), forward.origin]))


def capsule_ends(body: Body, frames: Frames) -> tuple[Float[AnyArray, "k 3 N"], Float[AnyArray, "k 3 N"]]:
    """Where the capsules' segments begin and end, in the base frame, mm."""

    def placed(frame: Int[np.ndarray, " k"], point: Float[np.ndarray, "k 3"]) -> AnyArray:
        axes, xp = frames.axes[frame], namespace(frames)
        columns = (axes[:, :, i] * xp.asarray(point[:, i])[:, None, None] for i in range(3))
        return frames.origins[frame] + sum(columns)

    return placed(body.start_frame, body.start), placed(body.end_frame, body.end)


def body_along_links(arm: Arm, radius: float | Sequence[float], tool_radius: float | None = None) -> Body:
    """Capsules about an arm's offsets d, lengths a and its probe, as the D-H table has them.

    That is the body of an arm whose links are where its table's frames are; of a robot with links beside its axes, its
    URDF's shapes are nearer to the truth (`files.urdf_body`). The tool's capsule ends two radii before the tip, so that
    it clears a surface that the tip is in up to a tilt of 60 deg. Capsules that little of the arm joins touch at their
    joint, and are no pair.

    Args:
        arm: One arm.
        radius: Radius of every link, or one for each joint, mm.
        tool_radius: Radius of the probe, mm; by default a quarter of the last link's, 8 at most.

    Raises:
        InputError: A radius is not positive, or not one for each joint.

    Example:
        >>> body = aj.kinematics.body_along_links(arm, 40.0, tool_radius=5.0)
        >>> print(len(body.names), body.radius.max(), "mm")
        7 40.0 mm
    """
    arm = to_numpy(arm)
    radii = np.asarray(radius, dtype=float)
    radii = np.full(arm.joints, radii) if radii.ndim == 0 else radii
    if radii.shape != (arm.joints,):
        raise InputError(f"radius has {radii.size} values, but the arm has {arm.joints} joints; give one for each.")
    tool = float(min(radii[-1] / 4, 8.0) if tool_radius is None else tool_radius)
    if not all(np.isfinite(x) and 0 < x <= _LARGEST_RADIUS for x in (*radii, tool)):
        raise InputError(f"a radius of the arm's links must be above 0 and at most {_LARGEST_RADIUS:g} mm.")
    rows: list[tuple[str, int, np.ndarray, int, np.ndarray, float, float]] = []
    beta = np.zeros(arm.joints) if arm.beta is None else np.asarray(arm.beta)
    for i in range(arm.joints):
        a, d = float(arm.a[i]), float(arm.d[i])
        # The end of the offset, in the frame after the joint: a back along x, which beta turns about y.
        corner = np.array([-a * np.cos(beta[i]), 0.0, -a * np.sin(beta[i])])
        if abs(d) > _SHORTEST:
            rows.append((f"offset d_{i + 1}", i, np.zeros(3), i + 1, corner, radii[i], abs(d)))
        if abs(a) > _SHORTEST:
            rows.append((f"link a_{i + 1}", i + 1, corner, i + 1, np.zeros(3), radii[i], abs(a)))
    probe = np.asarray(arm.probe, dtype=float)
    size = float(np.linalg.norm(probe))
    if size > 2 * tool + _SHORTEST:
        end = probe * (1 - 2 * tool / size)
        rows.append(("probe", arm.joints, np.zeros(3), arm.joints, end, tool, size))
    if not rows:
        raise InputError("the arm has no link that is longer than 0, so it has no body; give its URDF.")
    names, start_frame, start, end_frame, end, widths, lengths = zip(*rows, strict=True)
    until = np.concatenate([[0.0], np.cumsum(lengths)])  # how much of the arm is before each capsule
    pairs = [
        (i, j)
        for i in range(len(rows))
        for j in range(i + 1, len(rows))
        if until[j] - until[i + 1] > _NEAR * (widths[i] + widths[j])
    ]
    return Body(
        names, np.array(start_frame), np.array(start), np.array(end_frame), np.array(end), np.array(widths),
        np.array(pairs, dtype=int).reshape(-1, 2),
    )  # fmt: skip
