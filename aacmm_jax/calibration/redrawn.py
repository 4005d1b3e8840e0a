"""Captures drawn anew, for Monte Carlo, the bootstrap and studies: observations of every kind in the same way.

An error of what was measured, or of the seat, changes a residual and hardly its derivatives. So the data of a trial are
those of the capture with readings drawn anew, and with a constant added to every residual that replaces the errors of
the capture by others. No kind has to say how it is drawn.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from ..core.arrays import Numbers
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.capture import Capture, ReferenceLength
from ..data.noise import Noise
from ..data.observations.observation import AbstractObservation
from ..kinematics.arm import Arm
from ..kinematics.chain import JointKinds, reading_units
from ..kinematics.inverse_kinematics import project_to_centroids
from ..kinematics.parameters import Parameters
from ..model.observed import Observed
from ..uncertainty.linearisation import Linearisation, ObservationRows
from .drawn_errors import DrawnErrors, draw_shared
from .results import Calibration
from .task import configurations


class Trials(NamedTuple):
    """Captures of a calibrated arm with new errors."""

    size: int  # numbers in one of them
    # And the coefficients of functions that the model lacks, of each trial.
    drawn: Callable[[int, np.random.Generator, Any], tuple[Capture, Float[np.ndarray, "t k"]]]


def trials_of(result: Calibration, capture: Capture, noise: Noise, u: Float[np.ndarray, " l"]) -> Trials:
    """Of a calibration; ``u`` are those of its reference lengths, mm."""
    shared = to_numpy(result.shared)

    def coefficients(found: DrawnErrors | None, count: int) -> Float[np.ndarray, "t k"]:
        return np.zeros((count, 0)) if found is None else found.coefficients

    if result.method == "joint":
        truth = truth_of(result, capture)

        def drawn_observations(count: int, random: np.random.Generator, level: Any) -> Any:
            alike = draw_shared(shared, result.arm, capture, count, random)
            return truth.drawn(count, noise, random, level, alike), coefficients(alike, count)

        return Trials(truth.size, drawn_observations)
    # Poses that hold their socket exactly, and the least change of the joints for each mm that the tip shall move.
    exact = project_to_centroids(result.arm, capture)
    by_joints = np.asarray(result.arm.jacobian(exact, [f"q_{i}" for i in range(1, result.arm.joints + 1)]))
    units = reading_units(result.arm.geometry)
    moves = units[:, None] * np.linalg.pinv(by_joints * units, rcond=1e-8)
    true_lengths = np.asarray(_lengths_by(result.arm, capture))

    def drawn(count: int, random: np.random.Generator, level: Any) -> Any:
        seats = float(noise.seating) * level * random.normal(size=(count, *exact.shape[:1], 3))
        alike = draw_shared(shared, result.arm, capture, count, random)
        if alike is not None:
            seats = seats + alike.tips
        read = noise.of_columns(result.arm.geometry.kinds, result.arm.joints, exact.shape[1])
        readings = exact + read * level * random.normal(size=(count, *exact.shape))
        readings[..., : result.arm.joints] += np.einsum("Nic,tNc->tNi", moves, seats)
        readings += 0.0 if alike is None else alike.joints
        lengths = true_lengths + u * random.normal(size=(count, len(u)))
        return batch_of_captures(capture, readings, lengths), coefficients(alike, count)

    return Trials(exact.size, drawn)


def _lengths_by(arm: Arm, capture: Capture) -> np.ndarray:
    tips = np.asarray(arm.position(project_to_centroids(arm, capture)))
    first = np.concatenate([[0], np.cumsum(capture.sizes)[:-1]])
    ends = capture.ends()
    return np.linalg.norm(tips[first[ends[:, 0]]] - tips[first[ends[:, 1]]], axis=1)


class DrawnLengths(NamedTuple):
    """Reference lengths of a batch: certified values and their standard uncertainties, mm."""

    value: Float[np.ndarray, "t l"]
    u: Float[np.ndarray, "t l"]


class ObservedTruth(NamedTuple):
    """An arm and a geometry about which data are drawn, in NumPy: by them every residual is 0 but for its errors."""

    observed: Observed
    parts: list[ObservationRows]
    kinds: JointKinds | None
    roots: list[Float[np.ndarray, "m r r"]]  # of the covariance of what was measured
    geometry: dict[str, Float[np.ndarray, " k"]]
    reading: Int[np.ndarray, " M"]  # number of the reading of each pose; equal ones were read at once

    @classmethod
    def at(cls, capture: Capture, space: Parameters, vector: Any, geometry: Mapping[str, Any]) -> "ObservedTruth":
        """By the arm with these parameters, and the geometry by the names of its parts."""
        observed, space = to_numpy((Observed.of(capture, space.base), space))
        numbers = [np.asarray(geometry[name]) for name in observed.blocks]
        z = np.concatenate([np.asarray(vector), *numbers])
        linear = Linearisation.at(observed, space, z, least=1.0)
        parts = linear.parts()
        return cls(
            observed,
            parts,
            linear.errors[0].kinds,
            [_square_roots(np.asarray(part.measured)) for part in parts],
            {name: np.asarray(values) for name, values in observed.split(z[len(space.names) :]).items()},
            np.array(configurations(observed.q)),
        )

    @property
    def size(self) -> int:
        """Numbers in the data of one trial."""
        return sum(part.observation.q.size + part.values.size for part in self.parts)

    def drawn(
        self,
        count: int,
        noise: Noise,
        random: np.random.Generator,
        level: Any = 1.0,
        alike: DrawnErrors | None = None,
    ) -> Capture:
        """A batch of captures with new errors; ``level`` (t, 1, 1) multiplies the noise of readings and seat, ``alike``
        are errors that poses share."""
        q = np.asarray(self.observed.q)
        encoder = noise.of_columns(self.kinds, self.parts[0].by_readings.shape[1], q.shape[1])
        read = encoder * level * random.normal(size=(count, self.reading.max() + 1, q.shape[1]))
        values = self.values(count, random)
        errors = self.errors_of_rows(count, level * float(noise.seating), random)
        found = []
        for part, error in zip(self.parts, errors, strict=True):
            rows = part.poses
            shift, readings = error - np.asarray(part.values), q[rows] + read[:, self.reading[rows]]
            if alike is not None:
                shift = shift + np.einsum("rcm,tmc->trm", np.asarray(part.by_tip), alike.tips[:, rows])
                readings = readings + alike.joints[:, rows]
            found.append(shifted(part.observation, readings, shift, values))
        return batch_of_observations(found, self.ends, self.lengths(count, random))

    def errors_of_rows(self, count: int, seating: Any, random: np.random.Generator) -> list[Float[np.ndarray, "t r m"]]:
        """Errors of the seat (of this standard deviation, mm) and of what was measured, in each observation's rows."""
        found = []
        for part, root in zip(self.parts, self.roots, strict=True):
            r, m = part.values.shape
            seat = seating * random.normal(size=(count, part.by_seat.shape[1], m))
            measured = np.einsum("mab,tbm->tam", root, random.normal(size=(count, r, m)))
            found.append(measured + np.einsum("rcm,tcm->trm", part.by_seat, seat))
        return found

    def values(self, count: int, random: np.random.Generator) -> dict[str, Float[np.ndarray, "t k"]]:
        """Certified values of the parts that have them."""
        return {
            name: self.geometry[name] + np.asarray(u) * random.normal(size=(count, len(u)))
            for name, (_, u) in self.observed.certified().items()
        }

    def lengths(self, count: int, random: np.random.Generator) -> DrawnLengths:
        """Certified values of the reference lengths."""
        ends = self.observed.ends
        true = np.array([np.linalg.norm(self.geometry[end] - self.geometry[start]) for start, end in ends])
        u = np.asarray(self.observed.u)
        return DrawnLengths(true + u * random.normal(size=(count, len(u))), np.broadcast_to(u, (count, len(u))))

    def resampled(self, count: int, random: np.random.Generator) -> Capture:
        """A batch of captures with poses drawn with replacement, and certified values with their uncertainty.

        Poses are drawn among those that owe the same: of one socket, one point of an artefact, one of two planes.

        Raises `InputError` where poses belong to two observations, or an observation has but one pose of each.
        """
        if self.reading.max() + 1 < len(self.reading):
            raise InputError(
                "some poses have exactly the readings of others, such as two targets seen at once, so they cannot be "
                "drawn one by one; use monte_carlo."
            )
        values = {
            name: np.asarray(value) + np.asarray(u) * random.normal(size=(count, len(u)))
            for name, (value, u) in self.observed.certified().items()
        }
        found = []
        for part in self.parts:
            observation = part.observation
            rows = _rows_with_replacement(observation, count, random)
            batch = _selected(observation, rows)
            own = {name: values[name] for name in observation.certified}
            found.append(batch.with_errors(batch.q, np.zeros((count, *part.values.shape)), own))
        nominal, u = np.asarray(self.observed.nominal), np.asarray(self.observed.u)
        drawn = nominal + u * random.normal(size=(count, len(u)))
        return batch_of_observations(found, self.ends, DrawnLengths(drawn, np.broadcast_to(u, drawn.shape)))

    @property
    def ends(self) -> list[tuple[str, str]]:
        """Names of the positions at the ends of the reference lengths."""
        return list(self.observed.ends)


def truth_of(result: Calibration, capture: Capture) -> ObservedTruth:
    """The arm and the geometry of a calibration. Raises `InputError` where it is of another capture."""
    geometry = result.observed.geometry
    missing = [name for name in Observed.of(capture, None).blocks if name not in geometry]
    if missing:
        raise InputError(
            f"the calibration knows nothing of the {missing[0]}; give the capture that it was identified from."
        )
    return ObservedTruth.at(capture, Parameters(result.arm, result.space.names), result.parameters, geometry)


def shifted(
    observation: AbstractObservation,
    q: Float[np.ndarray, "t m n"],
    shift: Float[np.ndarray, "t r m"],
    values: Mapping[str, Float[np.ndarray, "t k"]],
) -> AbstractObservation:
    """A batch of one observation, whose own data are the same in all trials."""
    own = {name: values[name] for name in observation.certified}
    return _repeated(observation, len(q)).with_errors(q, shift, own)


def _repeated(observation: AbstractObservation, count: int) -> AbstractObservation:
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (count, *np.shape(leaf))), observation)


def batch_of_observations(
    observations: list[AbstractObservation], ends: list[tuple[str, str]], lengths: DrawnLengths
) -> Capture:
    """A batch of captures, as `identify_many` takes it; ``ends`` are names of the positions at the lengths' ends."""
    count, _, joints = observations[0].q.shape
    names = [(start.removeprefix("position of "), end.removeprefix("position of ")) for start, end in ends]
    template = Capture({}, (), [jax.tree.map(lambda leaf: leaf[0], one) for one in observations])
    references = tuple(
        eqx.tree_at(
            lambda one: (one.value, one.u),
            ReferenceLength(pair[0], pair[1], 1.0),
            (lengths.value[:, i], lengths.u[:, i]),
        )
        for i, pair in enumerate(names)
    )
    return eqx.tree_at(
        lambda capture: (capture.q, capture.lengths, capture.observations),
        template,
        (np.zeros((count, 0, joints)), references, tuple(observations)),
    )


def _square_roots(covariances: Float[np.ndarray, "m r r"]) -> Float[np.ndarray, "m r r"]:
    """Of positive semidefinite matrices, which may be 0."""
    values, vectors = np.linalg.eigh(covariances)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]


def _rows_with_replacement(
    observation: AbstractObservation, count: int, random: np.random.Generator
) -> Int[np.ndarray, "t m"]:
    places = observation.places
    if np.bincount(places).max() < 2:
        raise InputError(
            f"observation '{observation.name}' has one pose in each point, so none can be drawn in the place of "
            "another; record several, or use monte_carlo."
        )
    rows = np.empty((count, observation.q.shape[0]), dtype=int)
    for place in range(places.max() + 1):
        group = np.flatnonzero(places == place)
        rows[:, group] = group[random.integers(len(group), size=(count, len(group)))]
    return rows


def _selected(observation: AbstractObservation, rows: Int[np.ndarray, "t m"]) -> AbstractObservation:
    """A batch of the observation with these poses."""
    fields = [field for field in observation.by_pose if not isinstance(getattr(observation, field), tuple)]
    batch = _repeated(observation, len(rows))
    chosen = [np.asarray(getattr(observation, field))[rows] for field in fields]
    return eqx.tree_at(lambda one: [getattr(one, field) for field in fields], batch, chosen)


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
        own = [np.asarray(length.u) for length in capture.lengths]
        u = np.broadcast_to(np.stack(own), np.shape(values)) if own else np.zeros((len(np.asarray(q)), 0))
    leaves = lambda c: [c.q, *(c.lengths[i].value for i in lengths), *(c.lengths[i].u for i in lengths)]  # noqa: E731
    columns = [np.asarray(column)[:, i] for column in (values, u) for i in lengths]
    return eqx.tree_at(leaves, capture, [np.asarray(q), *columns])
