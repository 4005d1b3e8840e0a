"""Places for sockets and reference lengths, poses that reach them, and the information these would add."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial.transform import Rotation

from ..core.arrays import in_chunks
from ..core.errors import InputError
from ..data.noise import Noise, tip_covariances
from ..kinematics.arm import Arm, jacobian_at
from ..kinematics.chain import Geometry, sines_cosines
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import configurations_at, total_link_length
from ..model.weights import inverse_root
from .fedorov_exchange import Candidates, Goal, covariance_of

_TRIES = 24  # poses tried in each socket of a place
_REACHED = 0.25  # of them must arrive
_SHIFT, _TURN = 0.05, 0.4  # of the links' sum; rad
_PRIOR = 1e-4  # nobody is in doubt by more than 100 mm or 100 mrad: keeps the first sums invertible


class Scene(NamedTuple):
    """What all designs for one arm share."""

    arm: Arm
    space: Parameters
    noise: Noise
    limits: Float[np.ndarray, "n 2"]
    goal: Goal
    random: np.random.Generator
    above: float  # mm: no joint and no tip below

    def draw(self, count: int) -> Float[np.ndarray, "c n"]:
        """Poses at random within the limits."""
        return self.random.uniform(self.limits[:, 0], self.limits[:, 1], (count, self.arm.joints))


class Place(NamedTuple):
    """Where sockets stand, and which are the ends of reference lengths with what standard uncertainty; mm."""

    points: Float[np.ndarray, "s 3"]
    ends: tuple[tuple[int, int], ...]
    u: tuple[float, ...]


def candidates_of(scene: Scene, place: Place, q: Float[np.ndarray, "c n"], owner: Int[np.ndarray, " c"]) -> Candidates:
    """What each pose would add to what is known, and what the lengths add by themselves."""
    p, sockets = len(scene.space.names), len(place.points)
    slopes = jacobian_at(scene.arm, q, scene.space.names) * np.asarray(scene.space.scale)
    roots = in_chunks(lambda rows: np.asarray(_roots(scene.arm.geometry, jnp.asarray(rows), scene.noise)), q)
    rows = np.zeros((len(q), 3, p + 3 * sockets))
    rows[:, :, :p] = roots @ slopes
    for axis in range(3):
        rows[np.arange(len(q)), :, p + 3 * owner + axis] = -roots[:, :, axis]
    base = np.diag(np.concatenate([np.full(p, _PRIOR), np.full(3 * sockets, _PRIOR)]))
    for (start, end), u in zip(place.ends, place.u, strict=True):
        between = place.points[end] - place.points[start]
        row = np.zeros(p + 3 * sockets)
        direction = between / np.linalg.norm(between)
        row[p + 3 * end : p + 3 * end + 3], row[p + 3 * start : p + 3 * start + 3] = direction, -direction
        base += np.outer(row, row) / u**2
    return Candidates(rows, owner, base, p)


@jax.jit
def _roots(geometry: Geometry, q: Array, noise: Noise) -> Float[Array, "c 3 3"]:
    return jnp.moveaxis(inverse_root(tip_covariances(geometry, sines_cosines(q), noise)), -1, 0)


def worth(scene: Scene, place: Place, poses: int) -> float:
    """The criterion for so many poses taken at random in a place; infinite where a socket cannot be reached well."""
    q, owner = configurations_at(scene, place.points, _TRIES)
    if np.bincount(owner, minlength=len(place.points)).min(initial=_TRIES) < _REACHED * _TRIES:
        return np.inf
    candidates = candidates_of(scene, place, q, owner)
    flat = candidates.rows.reshape(-1, candidates.base.shape[0])
    information = candidates.base + flat.T @ flat * (poses / len(q))
    return float(scene.goal.value(covariance_of(information, candidates.parameters)))


def places(
    scene: Scene,
    count: int,
    sockets: int,
    length: tuple[float, float],
    u: float,
    region: Mapping[str, tuple[float, float]],
) -> list[Place]:
    """Places at random for sockets, two by two as the ends of the reference length, in a region."""
    found: list[Place] = []
    pairs = sockets // 2
    ends = tuple((2 * i, 2 * i + 1) for i in range(pairs))
    for _ in range(60):
        middle = np.asarray(scene.arm.position(scene.draw(40 * count * (pairs + 1))))
        turn = scene.random.normal(size=middle.shape)
        size = np.exp(scene.random.uniform(math.log(length[0]), math.log(length[1]), len(middle)))[:, None]
        half = 0.5 * size * turn / np.linalg.norm(turn, axis=1, keepdims=True)
        both = np.stack([middle - half, middle + half], axis=1)
        both = both[_inside(both, region).all(axis=1)]
        alone = middle[_inside(middle, region)]
        possible = min(len(both) // max(pairs, 1), len(alone))
        for i in range(possible):
            points = both[i * pairs : (i + 1) * pairs].reshape(-1, 3)
            points = np.concatenate([points, alone[i : i + sockets % 2]])
            found.append(Place(points, ends, (u,) * pairs))
            if len(found) == count:
                return found
    raise InputError("no place for the sockets and the reference length in that region; widen it, or shorten the length.")


def beside(scene: Scene, place: Place, region: Mapping[str, tuple[float, float]]) -> Place | None:
    """A place with one of its lengths, or its single socket, moved and turned a little; None where that leaves the region."""
    points = place.points.copy()
    stands = [list(pair) for pair in place.ends]
    stands += [[i] for i in range(len(points)) if not any(i in pair for pair in stands)]
    moved = stands[scene.random.integers(len(stands))]
    middle = points[moved].mean(axis=0)
    shift = scene.random.normal(size=3) * _SHIFT * total_link_length(scene.arm)
    turn = Rotation.from_rotvec(scene.random.normal(size=3) * _TURN)
    points[moved] = middle + shift + turn.apply(points[moved] - middle)
    return place._replace(points=points) if _inside(points, region).all() else None


def _inside(points: Float[np.ndarray, "... 3"], region: Mapping[str, tuple[float, float]]) -> np.ndarray:
    measures = {"x": points[..., 0], "y": points[..., 1], "z": points[..., 2], "distance": np.linalg.norm(points, axis=-1)}
    inside = np.ones(points.shape[:-1], dtype=bool)
    for key, (low, high) in region.items():
        inside &= (measures[key] >= low) & (measures[key] <= high)
    return inside
