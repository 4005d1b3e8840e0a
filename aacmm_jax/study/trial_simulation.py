"""Trials drawn from counter-based keys (seed, cell, trial): the true arm, the readings, the box and the start.

A trial's numbers depend on its key alone, not on what else is drawn. A configuration of the pool is exact for the
nominal arm; for the trial's true arm its joints are changed until the tip is at its point (displaced by the seating
error) again. That is inverse kinematics, but not by `solve_to_targets`: all trials of a pool share the damped inverses
of the nominal arm, and cos and sin follow by angle addition, which takes a tenth of the time and rounds differently, so
that results would change.
"""

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.random_keys import random_key
from ..kinematics.arm import with_values
from ..kinematics.chain import (
    Corrections,
    Geometry,
    JointKinds,
    JointMotion,
    forward_pass,
    joint_errors,
    joint_motion_of_rows,
    reading_units,
)
from ..kinematics.inverse_kinematics import damped_inverse
from ..kinematics.jacobian import reading_columns
from .configuration_pool import Places, forget_pools, pool_of
from .definition import POOL_PARTS, CellValues, Setting, Study

_WIDTH = 16  # trials at a time: of one width, so that every trial's arithmetic is the same whatever the chunk
_SIZES = 64, 256  # trials of one call of the compiled program: few sizes, as each takes 10 s to compile
_TOLERANCE = 1e-9  # mm: how far from its point a tip may end
_SUBSTITUTIONS = 6  # slopes of 0.01, as of 50 arcsec of order 31, leave 1e-12 of the error
_MOST_STEPS = 40  # deviations of a few microns take 3, the paper's tolerances 5 or 6


class DrawnTrials(NamedTuple):
    """Trials, as `identify_many` takes them; mm and rad. q is NaN where the true arm did not reach its points.

    Example:
        >>> drawn, captures = aj.study.draw_trials(study, 0, [0, 1, 2])
        >>> print(drawn.q.shape, drawn.true.shape)
        (3, 30, 6) (3, 21)
    """

    q: Float[Any, "t N n"]
    true: Float[Any, "t p"]
    lower: Float[Any, "t p"]
    upper: Float[Any, "t p"]
    start: Float[Any, "t p"]
    value: Float[Any, "t l"]  # certified values of the reference lengths
    u: Float[Any, "t l"]


class _Static(NamedTuple):
    """What determines the compiled program."""

    fixtures: Places
    lengths: tuple[tuple[int, int], ...]  # first poses of both ends
    indices: tuple[tuple[str, int], ...]  # of the free parameters: kind and joint
    recorded: bool
    anchor: int | None  # index of the length that stage 1 fixes
    random_start: bool
    eccentric: bool  # of any cell: sines are then computed for all


# Arrays that all trials share: the pool's table, the chain, and the nominal parameters and recorded u of lengths.
_Shared = tuple[Any, Geometry, Any, Any]


def draw(
    study: Study, setting: Setting, cells: Int[np.ndarray, " t"], trials: Int[np.ndarray, " t"], device: Any
) -> DrawnTrials:
    """Trials ``trials`` of cells ``cells``, all of one setting, as NumPy arrays."""
    static, shared = _prepared(study, setting, device)
    count = len(cells)
    size = _SIZES[count > _SIZES[0]]
    padded = -(-count // size) * size
    cells, trials = (np.resize(numbers, padded) for numbers in (cells, trials))
    values = CellValues(*(column[cells] for column in study.cell_values))
    seed, parts = np.asarray(study.specification.seed), []
    for first in range(0, padded, size):
        given = jax.tree.map(lambda column, i=first: column[i : i + size], (cells, trials, values))
        with jax.default_device(device):
            drawn = _draw(static, shared, *jax.device_put((seed, *given), device))
        parts.append(jax.tree.map(np.asarray, drawn))
    return DrawnTrials(*(np.concatenate(column)[:count] for column in zip(*parts, strict=True)))


@lru_cache(maxsize=16)
def _prepared(study: Study, setting: Setting, device: Any) -> tuple[_Static, _Shared]:
    """What all trials of a setting share, on the device."""
    table, places = pool_of(study, setting)
    starts = np.cumsum([0, *setting.sizes]).tolist()
    static = _Static(
        fixtures=places,
        lengths=tuple((starts[a], starts[b]) for a, b in ends_of(study, setting)),
        indices=study.space.indices(),
        recorded=setting.recorded,
        anchor=None if setting.hold is None else study.space.index(setting.hold),
        random_start=setting.random_start,
        eccentric=bool(np.any(study.cell_values.eccentricity > 0)),
    )
    u = [float(length.u) for length in study.capture.lengths] if study.capture else [0.0] * len(static.lengths)
    shared = table, study.space.base.geometry, np.asarray(study.space.vector()), np.array(u)
    return static, jax.device_put(shared, device)


def clear_pools() -> None:
    """Free the pools of configurations, which are kept for more trials of the same study.

    Example:
        >>> aj.study.clear_pools()
    """
    forget_pools()
    _prepared.cache_clear()


def ends_of(study: Study, setting: Setting) -> list[tuple[int, int]]:
    """The reference lengths, as pairs of sockets."""
    if study.capture is not None:
        return [(int(a), int(b)) for a, b in study.capture.ends()]
    first = np.cumsum([0, *(fixture.ends for fixture in setting.fixtures)]).tolist()
    return [(i, i + 1) for fixture, i in zip(setting.fixtures, first, strict=False) if fixture.ends == 2]


@partial(jax.jit, static_argnames=("static",))
def _draw(
    static: _Static, shared: _Shared, seed: Array, cells: Array, trials: Array, values: CellValues
) -> DrawnTrials:
    key = random_key(seed)

    def some(chunk: tuple) -> DrawnTrials:
        cell, trial, values = chunk
        keys = jax.vmap(lambda c, t: jax.random.fold_in(jax.random.fold_in(key, c), t))(cell, trial)
        return _chunk(static, shared, keys, trial, values)

    chunks = jax.tree.map(lambda leaf: leaf.reshape(-1, _WIDTH, *leaf.shape[1:]), (cells, trials, values))
    return jax.tree.map(lambda leaf: leaf.reshape(len(trials), *leaf.shape[2:]), jax.lax.map(some, chunks))


def _chunk(static: _Static, shared: _Shared, keys: Array, trials: Int[Array, " w"], values: CellValues) -> DrawnTrials:
    """`_WIDTH` trials."""
    table, plain, nominal, recorded_u = shared
    n, p = plain.alpha.shape[-1], nominal.shape[0]
    parts = jax.vmap(lambda k: jax.random.split(k, 7))(keys)
    poses = sum(ends * taken for _, _, ends, _, taken in static.fixtures)
    normal = _normal(parts[:, 0], (p,))
    # One draw for both distributions: its rank among all normal draws is uniform.
    deviation = values.width * jnp.where(values.normal, normal, jax.scipy.special.erf(normal / math.sqrt(2)))
    true = nominal[None] + deviation
    rows = table.at[_chosen(static, parts[:, 1], trials)].get(mode="promise_in_bounds")
    columns = jax.lax.optimization_barrier(jnp.moveaxis(rows, -1, 0))  # (columns, w, N)
    q, cosine, sine = columns[:n], columns[n : 2 * n], columns[2 * n : 3 * n]
    inverse = columns[3 * n : 6 * n].reshape(n, 3, _WIDTH, poses)
    point = jnp.swapaxes(columns[6 * n :], 0, 1)  # (w, 3, N)
    target = point + values.seating[:, None, None] * _noise(parts[:, 2], (3, poses))
    # Functions of corrections are those of one nominal arm.
    geometry, corrections = plain._replace(corrections=None), plain.corrections
    geometry = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_WIDTH, *leaf.shape)), geometry)
    geometry = geometry._replace(**with_values(geometry, true, static.indices))
    offsets = jnp.swapaxes(geometry.theta - plain.theta[None], 0, 1)[:, :, None]
    joints = JointMotion(cosine, sine, None)
    if geometry.kinds is not None:  # the angle of a prismatic joint is that of the true arm
        prismatic, angle = geometry.kinds.mask(3), jnp.swapaxes(geometry.theta, 0, 1)[:, :, None]
        cosine, sine = jnp.where(prismatic, jnp.cos(angle), cosine), jnp.where(prismatic, jnp.sin(angle), sine)
        joints = JointMotion(cosine, sine, jnp.where(prismatic, q, 0.0))
        offsets = jnp.where(prismatic, 0.0, offsets)
    chain = geometry._replace(coefficients=None, gravity=None)
    q = q + _joint_changes(chain, joints, inverse, target) - offsets
    q = q if corrections is None else _read_where(geometry, corrections, q)
    reading = _readings(static, q, geometry.kinds, parts[:, 3:5], values)
    u = jnp.where(jnp.isnan(values.u)[:, None], recorded_u[None], values.u[:, None])
    value = u = jnp.zeros((_WIDTH, 0)) if not static.lengths else u
    if static.lengths:
        between = jnp.stack([point[:, :, b] - point[:, :, a] for a, b in static.lengths], axis=1)
        u = jnp.broadcast_to(u, between.shape[:2])
        value = jnp.linalg.norm(between, axis=-1) + u * _normal(parts[:, 5], between.shape[1:2])
    start = jnp.broadcast_to(nominal, true.shape)
    if static.random_start:
        fraction = jax.vmap(lambda k: jax.random.uniform(k, (p,), jnp.float64))(parts[:, 6])
        free = jnp.asarray(np.arange(p) != (-1 if static.anchor is None else static.anchor))[None]
        free = free & jnp.isfinite(values.upper - values.lower)  # coefficients of corrections have no bounds
        start = jnp.where(free, values.lower + fraction * (values.upper - values.lower), start)
    return DrawnTrials(jnp.moveaxis(reading, 0, -1), true, values.lower, values.upper, start, value, u)


def _read_where(geometry: Geometry, corrections: Corrections, q: Float[Array, "n w N"]) -> Float[Array, "n w N"]:
    """Readings with which corrected joints do what those of a plain arm do at q.

    The errors of joints change so little with the readings (their slope is their amplitude times the order of the
    harmonic) that a few substitutions are exact to rounding.
    """
    corrected = jax.tree.map(lambda leaf: leaf[:, None, :], geometry)._replace(corrections=corrections)

    def closer(_: Array, reading: Float[Array, "n w N"]) -> Float[Array, "n w N"]:
        return q - joint_errors(corrected, joint_motion_of_rows(corrected, reading[:, :, None]))[0][:, :, 0]

    return jax.lax.fori_loop(0, _SUBSTITUTIONS, closer, q)


def _normal(keys: Array, shape: tuple[int, ...], dtype: Any = jnp.float64) -> Float[Array, "w ..."]:
    return jax.vmap(lambda k: jax.random.normal(k, shape, dtype))(keys)


def _noise(keys: Array, shape: tuple[int, ...]) -> Float[Array, "w ..."]:
    """Standard normal noise for every trial, in float32: a third of the time, and noise needs no more digits."""
    return _normal(keys, shape, jnp.float32).astype(jnp.float64)


def _chosen(static: _Static, keys: Array, trials: Int[Array, " w"]) -> Int[Array, "w N"]:
    """Rows of the pool for every trial: of each fixture one placement, and different configurations at each end.

    They are first + j * step modulo the pool's size, a power of two, with an odd step: none comes twice, and since the
    pool is in random order, any such choice is as good as another.
    """
    if static.recorded:
        size = sum(taken for *_, taken in static.fixtures)
        return jnp.broadcast_to(jnp.arange(size), (_WIDTH, size))
    part = trials % POOL_PARTS
    most = max(ends for _, _, ends, _, _ in static.fixtures)
    bits = jax.vmap(lambda k: jax.random.bits(k, (len(static.fixtures), 1 + 2 * most), dtype=jnp.uint32))(keys)
    bits = (bits >> 1).astype(jnp.int64)
    chosen = []
    for i, (first, placements, ends, poses, taken) in enumerate(static.fixtures):
        placement = (part * placements + bits[:, i, 0] % placements) * ends
        for end in range(ends):
            begin, step = bits[:, i, 1 + 2 * end, None], 2 * bits[:, i, 2 + 2 * end, None] + 1
            pose = (begin + step * jnp.arange(taken)[None]) % poses
            chosen.append(first + (placement[:, None] + end) * poses + pose)
    return jnp.concatenate(chosen, axis=1)


def _joint_changes(
    geometry: Geometry,
    joints: JointMotion,  # with the zero offsets in it
    inverse: Float[Array, "n 3 w N"],
    target: Float[Array, "w 3 N"],
) -> Float[Array, "n w N"]:
    """Changes of the joints that bring the tips of the true arms to their targets; NaN where they do not arrive.

    Every step uses the damped inverse of the pool, computed for the nominal arm (a chord method: each step leaves about
    a hundredth of the error). A trial takes steps until it has arrived; one that does not (an arm nearly straight, far
    from nominal) starts again with damped steps of its own.
    """
    rows = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1)[:, :, None], geometry)
    # Barriers keep XLA from computing them again for every pose, and the tip for every joint.
    links, *twist = jax.lax.optimization_barrier((rows, jnp.cos(rows.alpha), jnp.sin(rows.alpha)))

    def gap_of(joints: JointMotion) -> tuple[Array, Array]:
        gap = jax.lax.optimization_barrier(target - jnp.stack(_tip(links, (twist[0], twist[1]), joints), axis=1))
        return gap, jnp.max(jnp.abs(gap), axis=(1, 2))

    def unfinished(state: tuple) -> Array:
        return (state[0] < _MOST_STEPS) & jnp.any(state[-1] > _TOLERANCE)

    def step(state: tuple) -> tuple:
        number, change, joints, gap, distance = state
        move = sum(inverse[:, i] * gap[None, :, i] for i in range(3))
        move = jnp.where((distance > _TOLERANCE)[None, :, None], move, 0.0)
        joints = _moved(joints, geometry.kinds, move)
        return number + 1, change + move, joints, *gap_of(joints)

    begin = (jnp.asarray(0), jnp.zeros_like(joints.cos), joints, *gap_of(joints))
    _, change, _, _, distance = jax.lax.while_loop(unfinished, step, begin)
    arrived = distance <= _TOLERANCE

    def again() -> Array:
        damped, distance = _damped_changes(geometry, joints, target)
        return jnp.where(
            arrived[None, :, None], change, jnp.where((distance <= _TOLERANCE)[None, :, None], damped, jnp.nan)
        )

    return jax.lax.cond(jnp.all(arrived), lambda: change, again)


def _damped_changes(geometry: Geometry, joints: JointMotion, target: Array) -> tuple[Array, Array]:
    """The same by damped least-norm steps with the true arm's own derivatives; and the final distances, mm."""
    units = reading_units(geometry)[:, None, None]
    zeroed = jax.tree.map(lambda leaf: leaf[:, None, :], geometry._replace(theta=jnp.zeros_like(geometry.theta)))

    def step(_: Array, state: tuple) -> tuple:
        change, joints, _ = state
        forward = forward_pass(zeroed, jax.tree.map(lambda leaf: leaf[:, :, None], joints))
        gap = target - forward.tip
        inverse = jax.vmap(damped_inverse, in_axes=(1, 0), out_axes=1)(
            reading_columns(forward) * units[..., None], 1e-2 * jnp.sum(gap**2, axis=1) + 1e-12
        )
        move = units * jnp.clip(jnp.sum(inverse * gap[None], axis=2), -0.2, 0.2)
        return change + move, _moved(joints, geometry.kinds, move), jnp.max(jnp.abs(gap), axis=(1, 2))

    begin = (jnp.zeros_like(joints.cos), joints, jnp.zeros(_WIDTH))
    change, _, distance = jax.lax.fori_loop(0, _MOST_STEPS, step, begin)
    return change, distance


def _moved(joints: JointMotion, kinds: JointKinds | None, move: Any) -> JointMotion:
    """Joints after small changes of the readings."""
    if joints.slide is None or kinds is None:
        return JointMotion(*_rotated(joints.cos, joints.sin, move), None)
    prismatic = kinds.mask(3)
    turned = _rotated(joints.cos, joints.sin, jnp.where(prismatic, 0.0, move))
    return JointMotion(*turned, joints.slide + jnp.where(prismatic, move, 0.0))


def _rotated(cosine: Any, sine: Any, angle: Array) -> tuple[Array, Array]:
    """cos and sin after a small rotation, by their series: exact to rounding up to 0.2 rad, and a tenth of the time."""
    square = angle * angle
    sine_ratio, cosine_ratio = jnp.ones_like(angle), jnp.ones_like(angle)
    for k in (9, 7, 5, 3):
        sine_ratio = 1 - square * (1 / (k * (k - 1))) * sine_ratio
        cosine_ratio = 1 - square * (1 / ((k + 1) * k)) * cosine_ratio
    cos_angle, sin_angle = 1 - square * 0.5 * cosine_ratio, angle * sine_ratio
    return cosine * cos_angle - sine * sin_angle, sine * cos_angle + cosine * sin_angle


def _tip(links: Geometry, twist: tuple[Array, Array], joints: JointMotion) -> tuple[Array, ...]:
    """The tip alone, from the probe back to the base: one vector instead of a frame."""
    (cos_twist, sin_twist), (x, y, z), (cosine, sine, slide, *_) = twist, links.probe, joints
    for i in reversed(range(cosine.shape[0])):
        if links.beta is not None:
            cos_tilt, sin_tilt = jnp.cos(links.beta[i]), jnp.sin(links.beta[i])
            x, z = cos_tilt * x + sin_tilt * z, cos_tilt * z - sin_tilt * x
        d = links.d[i] if slide is None else links.d[i] + slide[i]
        x, y, z = x + links.a[i], cos_twist[i] * y - sin_twist[i] * z, sin_twist[i] * y + cos_twist[i] * z + d
        x, y = cosine[i] * x - sine[i] * y, sine[i] * x + cosine[i] * y
    return tuple(jnp.broadcast_to(part, cosine.shape[1:]) for part in (x, y, z))


def _readings(
    static: _Static, q: Float[Array, "n w N"], kinds: JointKinds | None, keys: Array, values: CellValues
) -> Float[Array, "n w N"]:
    """Readings: eccentricity (a first harmonic of the angle, its coefficients drawn by joint), noise and rounding."""
    n, _, poses = q.shape
    encoder, step = values.encoder[None, :, None], values.resolution[None, :, None]
    if kinds is not None:
        encoder = jnp.where(kinds.mask(3), values.linear_encoder[None, :, None], encoder)
        step = jnp.where(kinds.mask(3), values.linear_resolution[None, :, None], step)
    if static.eccentric:
        harmonics = _normal(keys[:, 1], (2, n)) * values.eccentricity[:, None, None]
        harmonics = jnp.moveaxis(harmonics, 0, -1)[..., None]
        if kinds is not None:
            harmonics = jnp.where(kinds.mask(3)[None], 0.0, harmonics)
        q = q + harmonics[0] * jnp.sin(q) + harmonics[1] * jnp.cos(q)
    q = q + encoder * jnp.moveaxis(_noise(keys[:, 0], (n, poses)), 0, 1)
    return jnp.where(step > 0, jnp.round(q / jnp.where(step > 0, step, 1.0)) * step, q)
