"""Poses that trials draw from: of every stand, many, exact for the nominal arm, in independent batches.

To reach a point anew for every pose of every trial would take ten times as long as identifying the arm. So each stand has a
pool. It is cut into `BATCHES` parts, and trial t draws from part t modulo `BATCHES`: results of different parts are
independent, and their scatter shows the whole Monte Carlo error, that of the finite pool included.
"""

import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.errors import InputError
from ..kinematics import chain
from ..kinematics.arm import Arm
from ..kinematics.inverse_kinematics import damped_inverse, solve_to_targets
from ..kinematics.jacobian import jacobian_columns
from .definition import BATCHES, Setting, Stand, Study, pose_choice
from .specification import Region

_ROUNDS, _STEPS, _AT_ONCE = 100, 20, 2048
_TOLERANCE = 1e-9  # mm
# |J| |J^+| of a pose, 3 at best: beyond this the arm is so nearly straight that the tip can hardly be moved along it.
_STRAIGHT = 30.0
_CANDIDATES = 65_536  # places at a time; most may lie outside a narrow region
_TRIED = 8  # poses tried at each end of a candidate placement


class Pool(NamedTuple):
    """Poses as a table, a row a pose: q, cos and sin of q + theta, least moves (n, 3), and the point that is reached.

    ``first``, ``placements`` and ``poses`` say, stand by stand, where its rows begin and how they are cut up:
    row = first + ((batch * placements + placement) * ends + end) * poses + pose.
    """

    table: Float[np.ndarray, "rows columns"]
    first: tuple[int, ...]
    placements: tuple[int, ...]
    poses: tuple[int, ...]


_building = threading.Lock()


def pool_of(study: Study, setting: Setting) -> Pool:
    """The pool of a setting. Raises `InputError` for a stand that cannot be reached, or finds no place in its region."""
    with _building:  # threads that need the same pool wait for the first of them, which builds it on all cores
        return _pool(study, setting)


@lru_cache(maxsize=4)
def _pool(study: Study, setting: Setting) -> Pool:
    if setting.recorded:
        return _recorded(study)
    # How many poses a trial takes does not change the pool.
    tables = [
        _stand_table(study, stand._replace(poses=0), setting.limits, pose_choice(study, stand)) for stand in setting.stands
    ]
    choices = [pose_choice(study, stand) for stand in setting.stands]
    first = np.cumsum([0, *(len(table) for table in tables)])[:-1]
    return Pool(np.concatenate(tables), tuple(map(int, first)), tuple(p for p, _ in choices), tuple(m for _, m in choices))


def _recorded(study: Study) -> Pool:
    """The poses of the recording, and the centroid of the tips in every socket."""
    capture, setting = study.capture, study.settings[0]
    assert capture is not None
    points = np.repeat([stand.points[0] for stand in setting.stands if stand.points], capture.sizes, axis=0)
    first = np.cumsum([0, *capture.sizes])[:-1]
    table = _rows(study.nominal.arm, np.asarray(capture.q), points)
    return Pool(table, tuple(map(int, first)), (1,) * len(first), capture.sizes)


@lru_cache(maxsize=16)
def _stand_table(study: Study, stand: Stand, limits: tuple, choice: tuple[int, int]) -> np.ndarray:
    arm = study.nominal.arm
    # The same stand has the same pool in every study of the same seed, whatever noise, bounds and methods are.
    key = jax.random.fold_in(
        jax.random.key(study.specification.seed, impl="threefry2x32"), zlib.crc32(repr((stand, limits, choice)).encode())
    )
    placements, poses = choice
    if stand.points is not None:
        points = np.tile(np.array(stand.points), (BATCHES, 1))
    else:
        points = _placed(arm, stand, jnp.asarray(limits), key, BATCHES * placements).reshape(-1, 3)
    return _filled(arm, np.repeat(points, poses, axis=0), jnp.asarray(limits), key, stand)


def check_reach(study: Study) -> None:
    """Raise `InputError` where a stand cannot be reached, or finds no place in its region: before any work."""
    arm = study.nominal.arm
    # Stands that differ in their name or their poses only are reached alike.
    stands = {
        (stand._replace(name=stand.name if stand.points else stand.name[0], poses=0), setting.limits)
        for setting in dict.fromkeys(study.settings)
        if not setting.recorded
        for stand in setting.stands
    }
    for stand, wanted in sorted(stands, key=repr):
        limits, key = jnp.asarray(wanted), jax.random.key(study.specification.seed, impl="threefry2x32")
        if stand.points is None:
            _placed(arm, stand, limits, key, 1)
            continue
        points = np.repeat(np.array(stand.points), _AT_ONCE // stand.ends // 4, axis=0)
        _, good = _tried(arm, _uniform(key, limits, len(points)), points, limits)
        if good.reshape(stand.ends, -1).mean(axis=1).min() < 0.05:
            raise _out_of_reach(stand)


def _out_of_reach(stand: Stand) -> InputError:
    return InputError(
        f"{_described(stand)} cannot be reached in enough poses within the joint limits; move it, or widen them "
        "(capture.joint_limits_deg)."
    )


def _described(stand: Stand) -> str:
    kind = "socket" if stand.ends == 1 else "reference length"
    if stand.points is None:
        return f"{kind} {stand.name}"
    return f"{kind} {stand.name} at " + " and ".join("(" + ", ".join(f"{x:g}" for x in p) + ")" for p in stand.points) + " mm"


def _filled(arm: Arm, points: Float[np.ndarray, "m 3"], limits: Array, key: Array, stand: Stand) -> np.ndarray:
    """Rows for all points; each point's row depends on its place alone, not on how the others fare."""
    q = np.zeros((len(points), arm.joints))
    missing = np.arange(len(points))
    for number in range(_ROUNDS):
        start = _uniform(jax.random.fold_in(key, number), limits, len(points))
        found, good = _tried(arm, start[missing], points[missing], limits)
        q[missing[good]] = found[good]
        missing = missing[~good]
        if not len(missing):
            return _rows(arm, q, points)
        if number == 9 and 2 * len(missing) > len(points):  # hopeless: a place with room succeeds in a few tries
            break
    raise _out_of_reach(stand)


def _uniform(key: Array, limits: Array, count: int) -> np.ndarray:
    low, high = limits[None, :, 0], limits[None, :, 1]
    return np.asarray(jax.random.uniform(key, (count, limits.shape[0]), minval=low, maxval=high))


def _tried(arm: Arm, start: np.ndarray, points: np.ndarray, limits: Array) -> tuple[np.ndarray, np.ndarray]:
    """Poses from starts, and which of them reach their point well: in blocks of one size, so that one program serves all."""
    blocks = [np.resize(np.arange(i, min(i + _AT_ONCE, len(start))), _AT_ONCE) for i in range(0, len(start), _AT_ONCE)]
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def one(block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with jax.default_device(device):
            q, good = _try(arm.geometry, jnp.asarray(start[block]), jnp.asarray(points[block]), limits)
        return np.asarray(q), np.asarray(good)

    with ThreadPoolExecutor() as threads:
        pieces = list(threads.map(one, blocks))
    q, good = (np.concatenate(column)[: len(start)] for column in zip(*pieces, strict=True))
    return q, good


@jax.jit
def _try(geometry: chain.Geometry, start: Array, points: Array, limits: Array) -> tuple[Array, Array]:
    q, distance = solve_to_targets(geometry, start, points, limits, _STEPS)
    columns = jacobian_columns(chain.forward_pass(geometry, chain.sines_cosines(q)))["theta"]
    moves = damped_inverse(columns, jnp.zeros(q.shape[0]))
    stiffness = jnp.sqrt(jnp.sum(columns**2, axis=(0, 1)) * jnp.sum(moves**2, axis=(0, 1)))
    return q, (distance <= _TOLERANCE) & (stiffness <= _STRAIGHT)


def _rows(arm: Arm, q: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The table's rows of poses."""
    moves = [
        np.asarray(_moves(arm.geometry, jnp.asarray(np.resize(q[i : i + _AT_ONCE], (_AT_ONCE, q.shape[1])))))
        for i in range(0, len(q), _AT_ONCE)
    ]
    total = q + np.asarray(arm.theta)
    return np.hstack([q, np.cos(total), np.sin(total), np.concatenate(moves)[: len(q)], points])


@jax.jit
def _moves(geometry: chain.Geometry, q: Array) -> Array:
    columns = jacobian_columns(chain.forward_pass(geometry, chain.sines_cosines(q)))["theta"]
    return jnp.moveaxis(damped_inverse(columns, jnp.zeros(q.shape[0])), -1, 0).reshape(q.shape[0], -1)


def _placed(arm: Arm, stand: Stand, limits: Array, key: Array, count: int) -> np.ndarray:
    """Places for a stand in its region, ``(count, ends, 3)``: the first of the candidates that can be reached well enough."""
    assert stand.region is not None
    found: list[np.ndarray] = []
    for number in range(_ROUNDS):
        there = _candidates(stand, stand.region, jax.random.fold_in(key, 1000 + number), _CANDIDATES)[: 2 * count + 64]
        if len(there):
            points = np.repeat(there.reshape(-1, 3), _TRIED, axis=0)
            _, good = _tried(arm, _uniform(jax.random.fold_in(key, 2000 + number), limits, len(points)), points, limits)
            enough = good.reshape(len(there), stand.ends, _TRIED).sum(axis=-1).min(axis=-1) >= _TRIED // 2
            found += list(there[enough])
        if len(found) >= count:
            return np.array(found[:count])
    size = "" if stand.length is None else f" of {stand.length:g} mm"
    kind = "socket" if stand.length is None else "reference length"
    raise InputError(
        f"a {kind}{size} finds no place in its region that the arm reaches within its joint limits; widen or move the region."
    )


def _candidates(stand: Stand, region: Region, key: Array, count: int) -> np.ndarray:
    """Places at random, both ends in the region."""
    place_key, turn_key = jax.random.split(key)
    middle = _in_region(region, place_key, count)
    if stand.length is None:
        return middle[_inside(region, middle)][:, None, :]
    turn = np.asarray(jax.random.normal(turn_key, (count, 3)))
    half = 0.5 * stand.length * turn / np.linalg.norm(turn, axis=1, keepdims=True)
    both = np.stack([middle - half, middle + half], axis=1)
    return both[_inside(region, both).all(axis=1)]


def _in_region(region: Region, key: Array, count: int) -> np.ndarray:
    """Points spread evenly over the box round a region."""
    outer = region.distance_mm[1] if region.distance_mm else np.inf
    ranges = [(max(r[0], -outer), min(r[1], outer)) if r else (-outer, outer) for r in (region.x_mm, region.y_mm, region.z_mm)]
    low, high = np.array(ranges).T
    return low + (high - low) * np.asarray(jax.random.uniform(key, (count, 3)))


def _inside(region: Region, points: Float[np.ndarray, "... 3"]) -> np.ndarray:
    inside = np.ones(points.shape[:-1], dtype=bool)
    for axis, limits in enumerate((region.x_mm, region.y_mm, region.z_mm)):
        if limits is not None:
            inside &= (points[..., axis] >= limits[0]) & (points[..., axis] <= limits[1])
    if region.distance_mm is not None:
        distance = np.linalg.norm(points, axis=-1)
        inside &= (distance >= region.distance_mm[0]) & (distance <= region.distance_mm[1])
    return inside
