"""Captures drawn anew, for Monte Carlo, the bootstrap and studies, about a truth: an arm that meets its data exactly.

Of sockets and lengths (`SocketTruth`), readings are drawn about poses in which the arm holds its sockets. Of other
observations (`ObservedTruth`), an error of what was measured, or of the seat, changes a residual; the change of
its derivatives is negligible. So the data of a trial are those of the capture with readings drawn anew, and with a
constant added to every residual that replaces the errors of the capture by others. No kind has to say how it is drawn.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, ReferenceLength, names_in, visits_of
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm, by_joint
from ..kinematics.chain import JointKinds, reading_units
from ..kinematics.corrected_arm import function_values, with_further_corrections
from ..kinematics.corrections import term_of
from ..kinematics.inverse_kinematics import project_to_centroids
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..model.sockets import membership, starts
from ..uncertainty.covariance import SharedErrors
from ..uncertainty.linearisation import Linearisation, ObservationRows
from ..uncertainty.shared_kinds import PLACES, SUCCESSIVE, VISITS
from .results import Calibration
from .task import configurations


class DrawnErrors(NamedTuple):
    """Shared errors, in some trials: of all M poses, those of sockets first."""

    tips: Float[np.ndarray, "t M 3"]  # mm
    joints: Float[np.ndarray, "t M n"]  # what the readings are too large by, rad or mm
    coefficients: Float[np.ndarray, "t k"]  # of the functions that the model lacks


DrawShared = Callable[[int, np.random.Generator], DrawnErrors | None]  # of so many trials


def draw_shared(
    shared: SharedErrors | None, arm: Arm, capture: Capture, count: int, random: np.random.Generator
) -> DrawnErrors | None:
    """Errors of some trials; None where a calibration has none."""
    if shared is None:
        return None
    q, law = np.asarray(capture.readings), shared.law.in_numpy
    tips, turned = np.zeros((count, len(q), 3)), np.zeros((count, *q.shape))
    for i, root in enumerate(_roots(shared, capture)):
        # A variance that few places show is itself uncertain, so it is drawn too (JCGM 101, 6.4.9).
        sd = np.sqrt(random.choice(law.ratios[i], size=(count, 1, 1), p=law.weights[i] / law.weights[i].sum()))
        tips += np.einsum("Mc,tcd->tMd", root, sd * random.normal(size=(count, root.shape[1], 3)))
    values, joints = functions_of(shared.names, arm, q)
    coefficients = random.normal(size=(count, len(shared.names))) @ _square_roots(np.asarray(shared.moments)).T
    for k, joint in enumerate(joints):
        turned[:, :, joint] += coefficients[:, k, None] * values[:, k]
    return DrawnErrors(tips, turned, coefficients)


def functions_of(
    names: tuple[str, ...], arm: Arm, q: Float[np.ndarray, "M n"]
) -> tuple[Float[np.ndarray, "M k"], np.ndarray]:
    """Values of functions by the names of their coefficients, and the joint (from 0) of each."""
    if not names:
        return np.zeros((len(q), 0)), np.zeros(0, dtype=int)
    wider: Arm = to_numpy(with_further_corrections(arm, names))
    assert wider.corrections is not None
    terms = [term for name in names if (term := term_of(name, arm.joints)) is not None]
    values = function_values(wider, terms, q).T
    return values, np.array([term.joint - 1 for term in terms])


def places_of(capture: Capture) -> Float[np.ndarray, "M p"]:
    """1 for the poses of each socket or observation that a reference length starts or ends at, a column each."""
    names, belongs = _by_name(capture)
    ends = {end for length in capture.lengths for end in (length.start, length.end)}
    return belongs[[name in ends for name in names]].T


def covariance_of_lengths(
    shared: SharedErrors, arm: Arm, names: tuple[str, ...], capture: Capture
) -> Float[np.ndarray, "l l"]:
    """Covariance of reference lengths as a calibrated arm measures them, by shared errors, mm^2; ``names``
    are its parameters that were free.

    Errors of the tip move the mean of an end; how parameters follow these is left out, as it is small.
    """
    q, (of_names, belongs) = np.asarray(capture.readings), _by_name(capture)
    means = dict(zip(of_names, belongs / belongs.sum(axis=1, keepdims=True), strict=True))
    between = np.array([means[length.end] - means[length.start] for length in capture.lengths])
    directions = between @ np.asarray(arm.position(q))
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    covariance = np.zeros((len(between), len(between)))
    for root in _roots(shared, capture):
        moved = between @ root
        covariance = covariance + (directions @ directions.T) * (moved @ moved.T)
    if shared.names:
        values, joints = functions_of(shared.names, arm, q)
        angles = tuple(f"{kind}_{i}" for i, kind in enumerate(by_joint(arm, "theta", "d"), start=1))
        tips = np.asarray(arm.jacobian(q, angles))[:, :, joints] * values[:, None]
        tips = tips + np.asarray(arm.jacobian(q, names)) @ np.asarray(shared.follow)
        columns = np.einsum("lc,lN,Nck->lk", directions, between, tips)
        covariance = covariance + columns @ np.asarray(shared.moments) @ columns.T
    return covariance


def variances_in_places(shared: SharedErrors | None, capture: Capture) -> Float[np.ndarray, " s"]:
    """What shared errors add to the variance of a coordinate of each socket's mean, beside the mean of so
    many independent errors, mm^2."""
    if shared is None:
        return np.zeros(len(capture.sizes))
    within, between = float(shared.sd_of(VISITS, SUCCESSIVE)) ** 2, float(shared.sd_of(PLACES)) ** 2
    visits, length = visits_of(capture), float(shared.correlation_length)

    variances = []
    for name, size in zip(capture.names, capture.sizes, strict=True):
        part_of_mean, order = 1.0, np.arange(size)
        if name in visits:
            part_of_mean = float(np.sum((np.unique(visits[name], return_counts=True)[1] / size) ** 2))
        elif np.isfinite(length):
            part_of_mean = float(np.mean(np.exp(-np.abs(order[:, None] - order) / length)))
        variances.append(between + within * (part_of_mean - 1 / size))
    return np.array(variances)


def _by_name(capture: Capture) -> tuple[list[str], Float[np.ndarray, "k M"]]:
    """Names of sockets and observations, and 1 where a pose belongs to each."""
    sizes = (*capture.sizes, *(observation.q.shape[0] for observation in capture.observations))
    return list(names_in(capture)), membership(sizes)


def _roots(shared: SharedErrors, capture: Capture) -> list[Float[np.ndarray, "M c"]]:
    """Square roots of the covariances of a tip coordinate over the poses, one for each kind that moves tips."""
    roots, belongs = [], _by_name(capture)[1]
    total = belongs.shape[1]
    for kind, sd in zip(shared.kinds, np.asarray(shared.sd), strict=True):
        if kind == PLACES:
            roots.append(sd * places_of(capture))
        elif kind == VISITS and capture.visits is not None:
            visits = np.full(total, -1)
            visits[: len(capture.visits)] = capture.visits
            roots.append(sd * (visits[:, None] == [number for number in np.unique(visits) if number >= 0]))
        elif kind == SUCCESSIVE:
            root = np.zeros((total, total))
            for poses in map(np.flatnonzero, belongs):
                order = np.arange(len(poses))
                kernel = np.exp(-np.abs(order[:, None] - order) / float(shared.correlation_length))
                root[np.ix_(poses, poses)] = sd * np.linalg.cholesky(kernel)
            roots.append(root)
    return roots


def _square_roots(covariances: Float[np.ndarray, "*m r r"]) -> Float[np.ndarray, "*m r r"]:
    values, vectors = np.linalg.eigh(covariances)
    return vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]


def _around(
    centre: Float[np.ndarray, " k"], u: Float[np.ndarray, " k"], count: int, random: np.random.Generator
) -> Float[np.ndarray, "t k"]:
    return centre + u * random.normal(size=(count, len(u)))


class SocketTruth(NamedTuple):
    """A calibrated arm, and poses in which it holds the sockets of a capture exactly, about which data are drawn."""

    arm: Arm
    capture: Capture
    exact: Float[np.ndarray, "M n"]
    moves: Float[np.ndarray, "M n 3"]  # the least change of the joints for each mm that the tip shall move
    lengths: Float[np.ndarray, " l"]  # between the tips, mm
    counted: Float[np.ndarray, "_ n"]  # 0 where an error of a joint's reading is none of a pose
    shared: DrawShared | None = None  # shared errors

    @classmethod
    def of(cls, arm: Arm, capture: Capture) -> "SocketTruth":
        """By a calibrated arm."""
        counted = to_numpy(Observed.of(capture, arm)).counted
        counted = np.ones((1, arm.joints)) if counted is None else counted.T
        kept = None if counted.all() else counted == 0
        exact, units = project_to_centroids(arm, capture, kept=kept), reading_units(arm.geometry)
        by_joints = np.asarray(arm.jacobian(exact, [f"q_{i}" for i in range(1, arm.joints + 1)])) * counted[:, None]
        moves = units[:, None] * np.linalg.pinv(by_joints * units, rcond=1e-8)
        ends = np.asarray(arm.position(exact))[starts(capture.sizes)[capture.ends()]]
        return cls(arm, capture, exact, moves, np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), counted)

    @property
    def size(self) -> int:
        """Numbers in the data of one trial."""
        return self.exact.size

    def drawn(
        self, count: int, noise: Noise, random: np.random.Generator, level: Any = 1.0
    ) -> tuple[Capture, DrawnErrors | None]:
        """As `ObservedTruth.drawn`."""
        arm, exact = self.arm, self.exact
        seats = float(noise.seating) * level * random.normal(size=(count, len(exact), 3))
        alike = None if self.shared is None else self.shared(count, random)
        seats = seats if alike is None else seats + alike.tips
        read = noise.of_columns(arm.geometry.kinds, arm.joints, exact.shape[1])
        errors = read * level * random.normal(size=(count, *exact.shape))
        errors[..., : arm.joints] *= self.counted
        readings = exact + errors
        readings[..., : arm.joints] += np.einsum("Nic,tNc->tNi", self.moves, seats)
        readings += 0.0 if alike is None else alike.joints
        return self._batch(readings, self.lengths, random), alike

    def resampled(self, count: int, random: np.random.Generator) -> Capture:
        """As `ObservedTruth.resampled`, of each socket."""
        q, sizes = np.asarray(self.capture.q), self.capture.sizes
        pairs = zip(starts(sizes), sizes, strict=True)
        rows = np.concatenate([first + random.integers(size, size=(count, size)) for first, size in pairs], axis=1)
        nominal = np.array([float(length.value) for length in self.capture.lengths])
        return self._batch(q[rows], nominal, random)

    def _batch(self, q: Float[np.ndarray, "t M n"], centre: np.ndarray, random: np.random.Generator) -> Capture:
        u = np.array([float(length.u) for length in self.capture.lengths])
        return batch_of_captures(self.capture, q, _around(centre, u, len(q), random))


class ObservedTruth(NamedTuple):
    """An arm and a geometry about which data are drawn, in NumPy: by them every residual is 0 but for its errors."""

    observed: Observed
    parts: list[ObservationRows]
    kinds: JointKinds | None
    roots: list[Float[np.ndarray, "m r r"]]  # of the covariance of what was measured
    geometry: dict[str, Float[np.ndarray, " k"]]
    reading: Int[np.ndarray, " M"]  # number of the reading of each pose; equal ones were read at once
    shared: DrawShared | None = None

    @classmethod
    def at(cls, capture: Capture, space: Parameters, vector: Any, geometry: Mapping[str, Any]) -> "ObservedTruth":
        """By the arm with these parameters, and the geometry by the names of its parts."""
        observed, space = to_numpy((Observed.of(capture, space.base), space))
        numbers = {name: np.asarray(geometry[name]) for name in observed.blocks}
        linear = Linearisation.at(observed, space, np.concatenate([np.asarray(vector), *numbers.values()]), least=1.0)
        parts = linear.parts()
        roots = [_square_roots(np.asarray(part.measured)) for part in parts]
        return cls(observed, parts, linear.errors[0].kinds, roots, numbers, np.array(configurations(observed.q)))

    @property
    def size(self) -> int:
        """Numbers in the data of one trial."""
        return sum(part.observation.q.size + part.values.size for part in self.parts)

    def drawn(
        self, count: int, noise: Noise, random: np.random.Generator, level: Any = 1.0
    ) -> tuple[Capture, DrawnErrors | None]:
        """A batch of captures with new errors, and those of them that poses share; ``level`` (t, 1, 1) multiplies the
        noise of readings and seat."""
        alike, q = None if self.shared is None else self.shared(count, random), np.asarray(self.observed.q)
        encoder = noise.of_columns(self.kinds, self.parts[0].by_readings.shape[1], q.shape[1])
        read = encoder * level * random.normal(size=(count, self.reading.max() + 1, q.shape[1]))
        values = self.values(count, random)
        errors, counted = self.errors_of_rows(count, level * float(noise.seating), random), self.observed.counted
        observations = []
        for part, error in zip(self.parts, errors, strict=True):
            shift, added = error - np.asarray(part.values), read[:, self.reading[part.poses]]
            if counted is not None:
                added[..., : len(counted)] *= counted[:, part.poses].T
            readings = q[part.poses] + added
            if alike is not None:
                shift = shift + np.einsum("rcm,tmc->trm", np.asarray(part.by_tip), alike.tips[:, part.poses])
                readings = readings + alike.joints[:, part.poses]
            observations.append(shifted(part.observation, readings, shift, values))
        return self.batch(observations, self.lengths(count, random)), alike

    def errors_of_rows(self, count: int, seating: Any, random: np.random.Generator) -> list[Float[np.ndarray, "t r m"]]:
        """Errors of the seat (of this standard deviation, mm) and of what was measured, in each observation's rows."""
        errors = []
        for part, root in zip(self.parts, self.roots, strict=True):
            r, m = part.values.shape
            seat = seating * random.normal(size=(count, part.by_seat.shape[1], m))
            measured = np.einsum("mab,tbm->tam", root, random.normal(size=(count, r, m)))
            errors.append(measured + np.einsum("rcm,tcm->trm", part.by_seat, seat))
        return errors

    def values(
        self, count: int, random: np.random.Generator, centre: Mapping[str, Any] | None = None
    ) -> dict[str, Float[np.ndarray, "t k"]]:
        """Certified values of the parts that have them, about the geometry or other numbers."""
        centre = self.geometry if centre is None else centre
        certified = self.observed.certified().items()
        return {name: _around(np.asarray(centre[name]), np.asarray(u), count, random) for name, (_, u) in certified}

    def lengths(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "t l"]:
        """Certified values of the reference lengths, mm."""
        true = [np.linalg.norm(self.geometry[end] - self.geometry[start]) for start, end in self.observed.ends]
        return _around(np.array(true), np.asarray(self.observed.u), count, random)

    def resampled(self, count: int, random: np.random.Generator) -> Capture:
        """A batch of captures with poses drawn with replacement, and certified values with their uncertainty.

        Poses are drawn among those under the same constraint: of one socket, one point of an artefact, one of two
        planes.

        Raises `InputError` where poses belong to two observations, or an observation has but one pose of each.
        """
        if self.reading.max() + 1 < len(self.reading):
            raise InputError(
                "some poses have exactly the same readings (two targets measured at the same time, for example), so "
                "poses cannot be drawn independently; use monte_carlo."
            )
        values = self.values(count, random, {name: value for name, (value, _) in self.observed.certified().items()})
        observations = []
        for part in self.parts:
            observation = part.observation
            if np.bincount(observation.places).max() < 2:
                raise InputError(
                    f"observation '{observation.name}' has only one pose per point, so no pose can be drawn in "
                    "place of another; record several poses per point, or use monte_carlo."
                )
            rows = np.empty((count, observation.q.shape[0]), dtype=int)
            for place in range(observation.places.max() + 1):
                group = np.flatnonzero(observation.places == place)
                rows[:, group] = group[random.integers(len(group), size=(count, len(group)))]
            fields = [field for field in observation.by_pose if not isinstance(getattr(observation, field), tuple)]
            chosen = [np.asarray(getattr(observation, field))[rows] for field in fields]
            batch = eqx.tree_at(
                lambda tree, fields=fields: [getattr(tree, field) for field in fields],
                _repeated(observation, count),
                chosen,
            )
            certified = {name: values[name] for name in observation.certified}
            observations.append(batch.with_errors(batch.q, np.zeros((count, *part.values.shape)), certified))
        lengths = _around(np.asarray(self.observed.nominal), np.asarray(self.observed.u), count, random)
        return self.batch(observations, lengths)

    def batch(self, observations: list[AbstractObservation], lengths: Float[np.ndarray, "t l"]) -> Capture:
        """A batch of captures, as `identify_many` takes it, with these certified values of the reference lengths."""
        count, _, joints = observations[0].q.shape
        template = Capture({}, (), [jax.tree.map(lambda leaf: leaf[0], batch) for batch in observations])
        references = []
        for pair, value, u in zip(self.observed.ends, lengths.T, np.asarray(self.observed.u), strict=True):
            start, end = (position.removeprefix("position of ") for position in pair)
            length = ReferenceLength(start, end, 1.0)
            values = (value, np.broadcast_to(u, value.shape))
            references.append(eqx.tree_at(lambda length: (length.value, length.u), length, values))
        return eqx.tree_at(
            lambda capture: (capture.q, capture.lengths, capture.observations),
            template,
            (np.zeros((count, 0, joints)), tuple(references), tuple(observations)),
        )


def truth_of(result: Calibration, capture: Capture) -> SocketTruth | ObservedTruth:
    """The arm and the geometry of a calibration. Raises `InputError` where it is of another capture."""
    shared = partial(draw_shared, to_numpy(result.shared), result.arm, capture)
    if result.method != "joint":
        return SocketTruth.of(result.arm, capture)._replace(shared=shared)
    geometry = result.observed.geometry
    for name in Observed.of(capture, None).blocks:
        if name not in geometry:
            raise InputError(
                f"the calibration does not contain the {name}; give the capture from which the arm was calibrated."
            )
    space = Parameters(result.arm, result.space.names)
    return ObservedTruth.at(capture, space, result.parameters, geometry)._replace(shared=shared)


def shifted(
    observation: AbstractObservation,
    q: Float[np.ndarray, "t m n"],
    shift: Float[np.ndarray, "t r m"],
    values: Mapping[str, Float[np.ndarray, "t k"]],
) -> AbstractObservation:
    """A batch of one observation, whose own data are the same in all trials."""
    certified = {name: values[name] for name in observation.certified}
    return _repeated(observation, len(q)).with_errors(q, shift, certified)


def _repeated(observation: AbstractObservation, count: int) -> AbstractObservation:
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *np.shape(leaf))), observation)


def batch_of_captures(capture: Capture, q: Numbers, values: Numbers, u: Numbers | None = None) -> Capture:
    """A batch of captures like this one, with other readings and reference lengths, as `identify_many` takes it.

    Args:
        capture: The sockets with their numbers of poses, and the reference lengths, l of them.
        q: Readings ``(batch, N, n)``, socket after socket, rad.
        values: Certified values of the reference lengths ``(batch, l)``, mm.
        u: Their standard uncertainties, likewise; by default the capture's.

    Returns:
        The captures; nothing is checked.

    Example:
        >>> draws = np.random.default_rng(0).normal(0.0, 1e-5, (100, *capture.q.shape))
        >>> batch = aj.calibration.batch_of_captures(capture, capture.q + draws, np.full((100, 1), 469.04))
        >>> print(batch.q.shape, batch.lengths[0].value.shape)
        (100, 50, 6) (100,)
    """
    lengths = range(len(capture.lengths))
    if u is None:
        stated = [np.asarray(length.u) for length in capture.lengths]
        u = np.broadcast_to(np.stack(stated), np.shape(values)) if stated else np.zeros((len(np.asarray(q)), 0))
    leaves = lambda c: [c.q, *(c.lengths[i].value for i in lengths), *(c.lengths[i].u for i in lengths)]  # noqa: E731
    columns = [np.asarray(column)[:, i] for column in (values, u) for i in lengths]
    return eqx.tree_at(leaves, capture, [np.asarray(q), *columns])
