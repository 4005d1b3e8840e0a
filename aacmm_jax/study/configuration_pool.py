"""Pose pools: for every fixture many configurations, exact for the nominal arm, from which trials draw.

Solving inverse kinematics for every pose of every trial would take ten times as long as identifying the arm. So each
fixture has a pool. It is cut into `POOL_PARTS` parts, and trial t draws from part t modulo `POOL_PARTS`: results of
different parts are independent, and their scatter shows the whole Monte Carlo error, that of the finite pool included.
"""

import threading
import zlib
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.random_keys import random_key
from ..kinematics import chain
from ..kinematics.arm import Arm
from ..kinematics.inverse_kinematics import damped_inverse, least_norm_inverse, solve_to_targets
from ..kinematics.jacobian import reading_columns
from .definition import POOL_PARTS, Fixture, Setting, Study
from .specification import Region

_ROUNDS, _STEPS, _ROWS = 100, 20, 2048
_TOLERANCE = 1e-9  # mm
# |J| |J^+| of a configuration, 3 at best: beyond this the arm is so nearly straight that its tip hardly moves along it.
_MOST_CONDITION = 30.0
_CANDIDATES = 65_536  # placements at a time; most may lie outside a narrow region
_STARTS = 8  # configurations tried at each end of a candidate placement

# A row for each configuration: q, cos and sin of q + theta, damped inverse (n, 3), and the point that it reaches, of
# the nominal arm without corrections: what its joints do, and not what they read.
Table = Float[np.ndarray, "rows columns"]
# Of each fixture: first row, placements, ends, poses in the pool, poses that a trial takes at each end;
# row = first + ((part * placements + placement) * ends + end) * poses + pose.
Places = tuple[tuple[int, int, int, int, int], ...]

_building = threading.Lock()


def pool_of(study: Study, setting: Setting) -> tuple[Table, Places]:
    """The pool of a setting. Raises `InputError` for a fixture out of reach, or without a placement in its region."""
    with _building:  # threads that need the same pool wait for the first, which builds it on all cores
        return _pool(study, setting)


@lru_cache(maxsize=4)
def _pool(study: Study, setting: Setting) -> tuple[Table, Places]:
    fixtures = setting.fixtures
    if setting.recorded:
        capacities, tables = [(1, fixture.poses) for fixture in fixtures], [_recorded(study)]
        counts = [fixture.poses for fixture in fixtures]
    else:
        capacities = [study.pool_capacity(fixture) for fixture in fixtures]
        # The number of poses that a trial takes does not change the pool.
        tables = [
            _fixture_table(study, fixture._replace(poses=0), setting.limits, capacity)
            for fixture, capacity in zip(fixtures, capacities, strict=True)
        ]
        counts = [len(table) for table in tables]
    first = np.cumsum([0, *counts])[:-1].tolist()
    places = tuple(
        (row, placements, fixture.ends, poses, fixture.poses)
        for row, fixture, (placements, poses) in zip(first, fixtures, capacities, strict=True)
    )
    return np.concatenate(tables), places


def forget_pools() -> None:
    """Free the pools that are kept here; see `trial_simulation.clear_pools`."""
    _pool.cache_clear()
    _fixture_table.cache_clear()


def _recorded(study: Study) -> Table:
    """The configurations of the recording, corrections included, and the centroid of the tips in every socket."""
    capture, arm = study.capture, study.nominal.arm
    assert capture is not None
    points = [fixture.points[0] for fixture in study.settings[0].fixtures if fixture.points]
    q = np.asarray(capture.q)
    if arm.corrections is not None:
        geometry = to_numpy(arm.geometry)
        q = q + np.asarray(chain.joint_errors(geometry, chain.joint_motion(geometry, q)))[:, 0].T
    return _rows(study.plain_arm, q, np.repeat(points, capture.sizes, axis=0))


@lru_cache(maxsize=16)
def _fixture_table(study: Study, fixture: Fixture, limits: tuple, capacity: tuple[int, int]) -> Table:
    """The pool of one fixture. A point's row depends on its index alone, not on which others are still unsolved.

    `random_configurations` tries the missing points together and accepts nearly straight arms, so it cannot be used
    here.
    """
    arm, (placements, poses), bounds = study.plain_arm, capacity, jnp.asarray(limits)
    key = pool_key(study.specification.seed, fixture, limits, capacity)
    if fixture.points is not None:
        points = np.tile(np.array(fixture.points), (POOL_PARTS, 1))
    else:
        points = _placements(arm, fixture, bounds, key, POOL_PARTS * placements).reshape(-1, 3)
    points = np.repeat(points, poses, axis=0)
    q, missing = np.zeros((len(points), arm.joints)), np.arange(len(points))
    for number in range(_ROUNDS):
        start = _uniform(jax.random.fold_in(key, number), bounds, len(points))
        solved, good = _solved(arm, start[missing], points[missing], bounds)
        q[missing[good]] = solved[good]
        missing = missing[~good]
        if not len(missing):
            return _rows(arm, q, points)
        if number == 9 and 2 * len(missing) > len(points):  # a point well within reach takes a few rounds
            break
    raise _out_of_reach(fixture)


def pool_key(seed: int, fixture: Fixture, limits: tuple, capacity: tuple[int, int]) -> Array:
    """The key of a pool: a fixture has the same pool in every study of a seed, whatever its noise, bounds and methods.

    It is the checksum of a text in which a `Fixture` is called a Stand: another text, a field's new name included,
    would change the results of every study.
    """
    text = repr((fixture, limits, capacity)).replace("Fixture(", "Stand(", 1)
    return jax.random.fold_in(random_key(seed), zlib.crc32(text.encode()))


def check_reach(study: Study) -> None:
    """Raise `InputError` where a fixture is out of reach, or has no placement in its region: before any work."""
    arm, key, seen = study.plain_arm, random_key(study.specification.seed), set()
    for setting in dict.fromkeys(study.settings):
        for fixture in () if setting.recorded else setting.fixtures:
            # Reach does not depend on the number of poses, nor for random placements on the number in the name.
            alike = fixture._replace(name=fixture.name if fixture.points else fixture.name[0], poses=0), setting.limits
            limits = jnp.asarray(setting.limits)
            if alike not in seen and fixture.points is None:
                _placements(arm, fixture, limits, key, 1)
            elif alike not in seen:
                points = np.repeat(np.array(fixture.points), _ROWS // fixture.ends // 4, axis=0)
                _, good = _solved(arm, _uniform(key, limits, len(points)), points, limits)
                if good.reshape(fixture.ends, -1).mean(axis=1).min() < 0.05:
                    raise _out_of_reach(fixture)
            seen.add(alike)


def _out_of_reach(fixture: Fixture) -> InputError:
    what = f"{'socket' if fixture.ends == 1 else 'reference length'} {fixture.name}"
    if fixture.points is not None:
        points = " and ".join("(" + ", ".join(f"{x:g}" for x in point) + ")" for point in fixture.points)
        what += f" at {points} mm"
    return InputError(
        f"{what} cannot be reached in enough poses within the joint limits; change its position, or widen the joint "
        "limits (capture.joint_limits_deg)."
    )


def _uniform(key: Array, limits: Array, count: int) -> np.ndarray:
    low, high = limits[None, :, 0], limits[None, :, 1]
    return np.asarray(jax.random.uniform(key, (count, limits.shape[0]), jnp.float64, low, high))


def _solved(arm: Arm, start: np.ndarray, points: np.ndarray, limits: Array) -> tuple[np.ndarray, np.ndarray]:
    """Configurations solved from starts, and which reach their point well; in chunks of one size, for one program."""
    chunks = [np.resize(np.arange(i, min(i + _ROWS, len(start))), _ROWS) for i in range(0, len(start), _ROWS)]
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]

    def solve(chunk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with jax.default_device(device):
            q, good = _solve(arm.geometry, jnp.asarray(start[chunk]), jnp.asarray(points[chunk]), limits)
        return np.asarray(q), np.asarray(good)

    with ThreadPoolExecutor() as threads:
        columns = zip(*threads.map(solve, chunks), strict=True)
    q, good = (np.concatenate(column)[: len(start)] for column in columns)
    return q, good


@jax.jit
def _solve(geometry: chain.Geometry, start: Array, points: Array, limits: Array) -> tuple[Array, Array]:
    q, distance = solve_to_targets(geometry, start, points, limits, _STEPS)
    columns = reading_columns(chain.forward_pass(geometry, chain.joint_motion(geometry, q)))
    columns = columns * chain.reading_units(geometry)[:, None, None]
    inverse = damped_inverse(columns, jnp.zeros(q.shape[0]))
    condition = jnp.sqrt(jnp.sum(columns**2, axis=(0, 1)) * jnp.sum(inverse**2, axis=(0, 1)))
    return q, (distance <= _TOLERANCE) & (condition <= _MOST_CONDITION)


def _rows(arm: Arm, q: np.ndarray, points: np.ndarray) -> Table:
    """Rows of the table for configurations."""
    inverses = [
        np.asarray(_inverse(arm.geometry, jnp.asarray(np.resize(q[i : i + _ROWS], (_ROWS, q.shape[1])))))
        for i in range(0, len(q), _ROWS)
    ]
    prismatic = np.isin(np.arange(1, arm.joints + 1), arm.prismatic)
    total = np.where(prismatic, 0.0, q) + np.asarray(arm.theta)
    return np.hstack([q, np.cos(total), np.sin(total), np.concatenate(inverses)[: len(q)], points])


@jax.jit
def _inverse(geometry: chain.Geometry, q: Array) -> Array:
    return jnp.moveaxis(least_norm_inverse(geometry, q), -1, 0).reshape(q.shape[0], -1)


def _placements(arm: Arm, fixture: Fixture, limits: Array, key: Array, count: int) -> np.ndarray:
    """Placements of a fixture in its region, ``(count, ends, 3)``: the first candidates that are well within reach."""
    assert fixture.region is not None
    placements: list[np.ndarray] = []
    for number in range(_ROUNDS):
        candidates = _candidates(fixture, fixture.region, jax.random.fold_in(key, 1000 + number), _CANDIDATES)
        candidates = candidates[: 2 * count + 64]
        if len(candidates):
            points = np.repeat(candidates.reshape(-1, 3), _STARTS, axis=0)
            start = _uniform(jax.random.fold_in(key, 2000 + number), limits, len(points))
            _, good = _solved(arm, start, points, limits)
            successes = good.reshape(len(candidates), fixture.ends, _STARTS).sum(axis=-1).min(axis=-1)
            placements += list(candidates[successes >= _STARTS // 2])
        if len(placements) >= count:
            return np.array(placements[:count])
    kind = "socket" if fixture.length is None else f"reference length of {fixture.length:g} mm"
    raise InputError(
        f"no position of a {kind} in its region is within the reach and the joint limits of the arm; widen or move the "
        "region."
    )


def _candidates(fixture: Fixture, region: Region, key: Array, count: int) -> np.ndarray:
    """Random placements with all ends in the region; their middles are uniform over its bounding box."""
    centre_key, direction_key = jax.random.split(key)
    axes, outer = (region.x_mm, region.y_mm, region.z_mm), region.distance_mm[1] if region.distance_mm else np.inf
    low, high = np.array([(max(r[0], -outer), min(r[1], outer)) if r else (-outer, outer) for r in axes]).T
    centre = low + (high - low) * np.asarray(jax.random.uniform(centre_key, (count, 3), jnp.float64))
    ends = centre[:, None]
    if fixture.length is not None:
        direction = np.asarray(jax.random.normal(direction_key, (count, 3), jnp.float64))
        half = 0.5 * fixture.length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        ends = np.stack([centre - half, centre + half], axis=1)
    inside = np.ones(ends.shape[:-1], dtype=bool)
    amounts = (*np.moveaxis(ends, -1, 0), np.linalg.norm(ends, axis=-1))
    for amount, limits in zip(amounts, (*axes, region.distance_mm), strict=True):
        if limits is not None:
            inside &= (amount >= limits[0]) & (amount <= limits[1])
    return ends[inside.all(axis=1)]
