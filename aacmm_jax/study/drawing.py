"""Trials drawn from counter-based keys (seed, cell, trial): the true arm, what its encoders read, the box and the start.

A trial's numbers depend on its key alone, not on what is drawn beside it. A pose of the pool is exact for the nominal arm; for
the trial's true arm its joints are moved, by least-norm steps, until the tip stands on its (unseated) point again.
"""

import math
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..kinematics.arm import with_values
from ..kinematics.chain import Geometry, forward_pass
from ..kinematics.inverse_kinematics import damped_inverse
from ..kinematics.jacobian import jacobian_columns
from .definition import BATCHES, Numbers, Setting, Study
from .pools import Pool, pool_of

_WIDTH = 16  # trials at a time: of one width, so that every trial's arithmetic is the same whatever the chunk
_TOLERANCE = 1e-9  # mm: how far from its point a tip may end
_MOST_STEPS = 40  # a few microns take 3, the paper's tolerances 5 or 6


class Drawn(NamedTuple):
    """Trials, as `identify_many` takes them; mm and rad. Where a pose could not be moved onto its point, q is NaN."""

    q: Float[Any, "t N n"]
    true: Float[Any, "t p"]
    lower: Float[Any, "t p"]
    upper: Float[Any, "t p"]
    start: Float[Any, "t p"]
    value: Float[Any, "t l"]  # certified values of the reference lengths
    u: Float[Any, "t l"]


class _Shape(NamedTuple):
    """What fixes the compiled program."""

    stands: tuple[tuple[int, int, int, int, int], ...]  # first row, placements, ends, poses in the pool, poses taken
    lengths: tuple[tuple[int, int], ...]  # first poses of both ends
    entries: tuple[tuple[str, int], ...]
    recorded: bool
    held: int | None  # position of the length that stage 1 holds
    random_start: bool
    eccentric: bool


class _Given(NamedTuple):
    """Arrays that all trials share."""

    table: Any  # (rows, columns)
    geometry: Geometry
    nominal: Any  # (p,)
    recorded_u: Any  # (l,)


def draw(study: Study, setting: Setting, cells: Int[np.ndarray, " t"], trials: Int[np.ndarray, " t"], device: Any) -> Drawn:
    """Trials ``trials`` of cells ``cells``, all of one setting, as NumPy arrays."""
    shape, given = _prepared(study, setting, device)
    count = len(cells)
    room = -(-count // _WIDTH) * _WIDTH
    cells, trials = (np.resize(numbers, room) for numbers in (cells, trials))
    rows = Numbers(*(column[cells] for column in study.numbers))
    seed = np.asarray(study.specification.seed)
    with jax.default_device(device):
        drawn = _draw(shape, given, *jax.device_put((seed, cells, trials, rows), device))
    return Drawn(*(np.asarray(leaf)[:count] for leaf in drawn))


@lru_cache(maxsize=16)
def _prepared(study: Study, setting: Setting, device: Any) -> tuple[_Shape, _Given]:
    """What all trials of a setting share, on the device."""
    pool = pool_of(study, setting)
    shape = _shape(study, setting, pool)
    u = np.array([float(length.u) for length in study.capture.lengths]) if study.capture else np.zeros(len(shape.lengths))
    given = _Given(pool.table, study.nominal.arm.geometry, np.asarray(study.space.vector()), u)
    return shape, jax.device_put(given, device)


def _shape(study: Study, setting: Setting, pool: Pool) -> _Shape:
    stands = tuple(
        (first, placements, stand.ends, poses, stand.poses)
        for stand, first, placements, poses in zip(setting.stands, pool.first, pool.placements, pool.poses, strict=True)
    )
    starts = np.cumsum([0, *setting.sizes])
    ends = [(int(starts[a]), int(starts[b])) for a, b in ends_of(study, setting)]
    held = None if setting.hold is None else study.space.index(setting.hold)
    return _Shape(stands, tuple(ends), study.space.indices(), setting.recorded, held, setting.random_start, study.eccentric)


def ends_of(study: Study, setting: Setting) -> list[tuple[int, int]]:
    """The reference lengths, as pairs of sockets."""
    if study.capture is not None:
        return [(int(a), int(b)) for a, b in study.capture.ends()]
    first = np.cumsum([0, *(stand.ends for stand in setting.stands)])
    return [(int(i), int(i) + 1) for stand, i in zip(setting.stands, first, strict=False) if stand.ends == 2]


@partial(jax.jit, static_argnames=("shape",))
def _draw(shape: _Shape, given: _Given, seed: Array, cells: Array, trials: Array, rows: Numbers) -> Drawn:
    key = jax.random.key(seed, impl="threefry2x32")

    def some(block: tuple) -> Drawn:
        cell, trial, numbers = block
        keys = jax.vmap(lambda c, t: jax.random.fold_in(jax.random.fold_in(key, c), t))(cell, trial)
        return _block(shape, given, keys, trial, numbers)

    blocks = jax.tree.map(lambda leaf: leaf.reshape(-1, _WIDTH, *leaf.shape[1:]), (cells, trials, rows))
    return jax.tree.map(lambda leaf: leaf.reshape(len(trials), *leaf.shape[2:]), jax.lax.map(some, blocks))


def _block(shape: _Shape, given: _Given, keys: Array, trials: Int[Array, " w"], numbers: Numbers) -> Drawn:
    """One block of trials."""
    n, p = given.geometry.alpha.shape[-1], given.nominal.shape[0]
    parts = jax.vmap(lambda k: jax.random.split(k, 7))(keys)
    poses = sum(ends * taken for _, _, ends, _, taken in shape.stands)
    normal = jax.vmap(lambda k: jax.random.normal(k, (p,)))(parts[:, 0])
    # The same draw serves both: its rank among all normal draws is uniform.
    off = numbers.width * jnp.where(numbers.normal, normal, jax.scipy.special.erf(normal / math.sqrt(2)))
    true = given.nominal[None] + off
    found = given.table.at[_chosen(shape, parts[:, 1], trials)].get(mode="promise_in_bounds")
    columns = jax.lax.optimization_barrier(jnp.moveaxis(found, -1, 0))  # (columns, w, N)
    q, cosine, sine = columns[:n], columns[n : 2 * n], columns[2 * n : 3 * n]
    moves = columns[3 * n : 6 * n].reshape(n, 3, _WIDTH, poses)
    point = jnp.swapaxes(columns[6 * n :], 0, 1)  # (w, 3, N)
    target = point + numbers.seating[:, None, None] * _noise(parts[:, 2], (3, poses))
    geometry = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (_WIDTH, *leaf.shape)), given.geometry)
    geometry = geometry._replace(**with_values(geometry, true, shape.entries))
    q = q + _moved(geometry, cosine, sine, moves, target)
    q = q - jnp.swapaxes(geometry.theta - given.geometry.theta[None], 0, 1)[:, :, None]
    reading = _read(shape, q, parts[:, 3:5], numbers)
    value, u = _certified(
        shape, point, parts[:, 5], jnp.where(jnp.isnan(numbers.u)[:, None], given.recorded_u[None], numbers.u[:, None])
    )
    start = jnp.broadcast_to(given.nominal, true.shape)
    if shape.random_start:
        share = jax.vmap(lambda k: jax.random.uniform(k, (p,)))(parts[:, 6])
        free = jnp.asarray(np.arange(p) != (-1 if shape.held is None else shape.held))[None]
        start = jnp.where(free, numbers.lower + share * (numbers.upper - numbers.lower), start)
    return Drawn(jnp.moveaxis(reading, 0, -1), true, numbers.lower, numbers.upper, start, value, u)


def _certified(shape: _Shape, point: Float[Array, "w 3 N"], keys: Array, u: Float[Array, "w l"]) -> tuple[Array, Array]:
    """Certified values of the reference lengths, off by their u."""
    if not shape.lengths:
        return jnp.zeros((_WIDTH, 0)), jnp.zeros((_WIDTH, 0))
    apart = jnp.stack([point[:, :, b] - point[:, :, a] for a, b in shape.lengths], axis=1)
    u = jnp.broadcast_to(u, apart.shape[:2])
    return jnp.linalg.norm(apart, axis=-1) + u * jax.vmap(lambda k: jax.random.normal(k, apart.shape[1:2]))(keys), u


def _noise(keys: Array, shape: tuple[int, ...]) -> Float[Array, "w ..."]:
    """Standard normal noise for every trial. Drawn in float32, which takes a third of the time: noise needs no more digits."""
    return jax.vmap(lambda k: jax.random.normal(k, shape, dtype=jnp.float32))(keys).astype(jnp.float64)


def _chosen(shape: _Shape, keys: Array, trials: Int[Array, " w"]) -> Int[Array, "w N"]:
    """Rows of the pool for every trial: of each stand one placement, and different poses of it at each end.

    The poses are those first + j * step modulo the pool's size, a power of two, with an odd step: no pose comes twice, and
    since the pool is in random order, any such choice is as good as another.
    """
    if shape.recorded:
        size = sum(taken for *_, taken in shape.stands)
        return jnp.broadcast_to(jnp.arange(size), (_WIDTH, size))
    batch = trials % BATCHES
    most = max(ends for _, _, ends, _, _ in shape.stands)
    bits = jax.vmap(lambda k: jax.random.bits(k, (len(shape.stands), 1 + 2 * most), dtype=jnp.uint32))(keys)
    bits = (bits >> 1).astype(jnp.int64)
    chosen = []
    for i, (first, placements, ends, poses, taken) in enumerate(shape.stands):
        place = (batch * placements + bits[:, i, 0] % placements) * ends
        for end in range(ends):
            begin, step = bits[:, i, 1 + 2 * end, None], 2 * bits[:, i, 2 + 2 * end, None] + 1
            pose = (begin + step * jnp.arange(taken)[None]) % poses
            chosen.append(first + (place[:, None] + end) * poses + pose)
    return jnp.concatenate(chosen, axis=1)


def _moved(
    geometry: Geometry,
    cosine: Float[Array, "n w N"],
    sine: Float[Array, "n w N"],
    moves: Float[Array, "n 3 w N"],
    target: Float[Array, "w 3 N"],
) -> Float[Array, "n w N"]:
    """Change of the joints that brings the tips of the true arms onto their targets; NaN for a trial where nothing does.

    Every step uses the least moves of the pool, made for the nominal arm (a chord method: each step leaves about a
    hundredth of the error). cos and sin follow by angle addition. A trial takes steps until it has arrived; one that has not
    (an arm nearly straight, far from nominal) starts again with damped steps of its own.
    """
    rows = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1)[:, :, None], geometry)
    # Barriers keep XLA from computing them anew for every pose, and the tip for every joint.
    links, *twist = jax.lax.optimization_barrier((rows, jnp.cos(rows.alpha), jnp.sin(rows.alpha)))

    def gap_of(cosine: Array, sine: Array) -> tuple[Array, Array]:
        gap = jax.lax.optimization_barrier(target - jnp.stack(_tip(links, (twist[0], twist[1]), cosine, sine), axis=1))
        return gap, jnp.max(jnp.abs(gap), axis=(1, 2))

    def more(state: tuple) -> Array:
        return (state[0] < _MOST_STEPS) & jnp.any(state[-1] > _TOLERANCE)

    def step(state: tuple) -> tuple:
        number, change, cosine, sine, gap, off = state
        move = sum(moves[:, i] * gap[None, :, i] for i in range(3))
        move = jnp.where((off > _TOLERANCE)[None, :, None], move, 0.0)
        cosine, sine = _turned(cosine, sine, move)
        return number + 1, change + move, cosine, sine, *gap_of(cosine, sine)

    begin = (jnp.asarray(0), jnp.zeros_like(cosine), cosine, sine, *gap_of(cosine, sine))
    _, change, _, _, _, off = jax.lax.while_loop(more, step, begin)
    arrived = off <= _TOLERANCE

    def again() -> Array:
        slow, off = _moved_slowly(geometry, cosine, sine, target)
        return jnp.where(arrived[None, :, None], change, jnp.where((off <= _TOLERANCE)[None, :, None], slow, jnp.nan))

    return jax.lax.cond(jnp.all(arrived), lambda: change, again)


def _moved_slowly(geometry: Geometry, cosine: Array, sine: Array, target: Array) -> tuple[Array, Array]:
    """The same by damped least-norm steps with the true arm's own derivatives; and how far off each trial ends, mm."""
    turned = jax.tree.map(lambda leaf: leaf[:, None, :], geometry._replace(theta=jnp.zeros_like(geometry.theta)))

    def step(_: Array, state: tuple) -> tuple:
        change, cosine, sine, _ = state
        forward = forward_pass(turned, (cosine[:, :, None], sine[:, :, None]))
        gap = target - forward.tip
        moves = jax.vmap(damped_inverse, in_axes=(1, 0), out_axes=1)(
            jacobian_columns(forward)["theta"], 1e-2 * jnp.sum(gap**2, axis=1) + 1e-12
        )
        move = jnp.clip(jnp.sum(moves * gap[None], axis=2), -0.2, 0.2)
        return change + move, *_turned(cosine, sine, move), jnp.max(jnp.abs(gap), axis=(1, 2))

    begin = (jnp.zeros_like(cosine), cosine, sine, jnp.zeros(_WIDTH))
    change, *_, off = jax.lax.fori_loop(0, _MOST_STEPS, step, begin)
    return change, off


def _turned(cosine: Array, sine: Array, move: Array) -> tuple[Array, Array]:
    """cos and sin of an angle after a small turn, by their series: exact to rounding up to 0.2 rad, and a tenth of the time."""
    square = move * move
    sine_move, cosine_move = jnp.ones_like(move), jnp.ones_like(move)
    for k in (9, 7, 5, 3):
        sine_move = 1 - square * (1 / (k * (k - 1))) * sine_move
        cosine_move = 1 - square * (1 / ((k + 1) * k)) * cosine_move
    cosine_move, sine_move = 1 - square * 0.5 * cosine_move, move * sine_move
    return cosine * cosine_move - sine * sine_move, sine * cosine_move + cosine * sine_move


def _tip(links: Geometry, twist: tuple[Array, Array], cosine: Array, sine: Array) -> tuple[Array, ...]:
    """The tip alone, forward from the probe back to the base: one vector instead of a frame. ``cosine`` of q + theta."""
    (cos_twist, sin_twist), (x, y, z) = twist, links.probe
    for i in reversed(range(cosine.shape[0])):
        if links.beta is not None:
            cos_tilt, sin_tilt = jnp.cos(links.beta[i]), jnp.sin(links.beta[i])
            x, z = cos_tilt * x + sin_tilt * z, cos_tilt * z - sin_tilt * x
        x, y, z = x + links.a[i], cos_twist[i] * y - sin_twist[i] * z, sin_twist[i] * y + cos_twist[i] * z + links.d[i]
        x, y = cosine[i] * x - sine[i] * y, sine[i] * x + cosine[i] * y
    return tuple(jnp.broadcast_to(part, cosine.shape[1:]) for part in (x, y, z))


def _read(shape: _Shape, q: Float[Array, "n w N"], keys: Array, numbers: Numbers) -> Float[Array, "n w N"]:
    """What the encoders read: eccentricity (a first harmonic of the angle, its two parts drawn for every joint), noise, resolution."""
    n, _, poses = q.shape
    if shape.eccentric:
        parts = jax.vmap(lambda k: jax.random.normal(k, (2, n)))(keys[:, 1]) * numbers.eccentricity[:, None, None]
        parts = jnp.moveaxis(parts, 0, -1)[..., None]
        q = q + parts[0] * jnp.sin(q) + parts[1] * jnp.cos(q)
    q = q + numbers.encoder[None, :, None] * jnp.moveaxis(_noise(keys[:, 0], (n, poses)), 0, 1)
    step = numbers.resolution[None, :, None]
    return jnp.where(step > 0, jnp.round(q / jnp.where(step > 0, step, 1.0)) * step, q)
