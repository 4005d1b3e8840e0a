"""Simulated captures: poses of an arm that reach given points, with noise of the encoders and of the seat."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.arguments import Range, check_finite, checked, checked_arguments, items_of, real_number, shown
from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError, naming, nearest
from ..core.numpy_or_jax import AnyArray, to_numpy
from ..core.random_keys import random_generator, random_key, random_numbers
from ..core.units import ARCSEC
from ..kinematics.arm import Arm, is_single, joint_limits, tips_of
from ..kinematics.chain import length_scale
from ..kinematics.corrected_arm import holding_torques
from ..kinematics.correction_kinds import REFERENCE_TEMPERATURE
from ..kinematics.inverse_kinematics import project_to_targets, random_configurations
from ..kinematics.robots import chains_of
from .capture import Capture
from .capture_data import ReferenceLength, check_temperatures
from .noise import Noise
from .observations.contacts import AbstractSimulatedContact
from .observations.declared import MOST_POSES
from .observations.observation import AbstractObservation
from .observations.simulated import AbstractSimulated

_ROUNDS, _DRAWN = 50, 2000  # of random configurations, for a link in a region
_TRIED = 3  # positions of a surface for each contact, of which the other chain reaches some
_RESOLUTION = Annotated[Float[AnyArray, ""] | Float[AnyArray, " 2"], Range(least=0)]


@checked_arguments
def simulate(
    arm: Arm,
    sockets: Mapping[str, Numbers],
    *,
    poses: int | Mapping[str, int] = 70,
    lengths: Iterable[ReferenceLength | tuple] = (),
    noise: Noise | None = None,
    encoder_arcsec: Numbers | None = None,
    seating: Numbers | None = None,
    resolution_arcsec: float | Sequence[float] = 0.0,
    limits: Sequence[Sequence[float]] | None = None,
    observations: Iterable[AbstractSimulated] = (),
    chains: Mapping[str, str | Sequence[str]] | None = None,
    temperature: Numbers | None = None,
    load: Numbers | None = None,
    seed: int = 0,
) -> Capture:
    """Record a capture with a simulated arm; without noise unless asked for.

    Poses start at random within the limits and reach their point by least-norm steps, so that the poses of a redundant
    arm differ in all joints. The same seed gives the same capture.

    Args:
        arm: One arm.
        sockets: Socket name -> position ``(3,)`` in the base frame, mm.
        poses: Number of poses in each socket, or socket name -> number.
        lengths: `ReferenceLength` objects, taken as they are; or ``("A", "B")`` and ``("A", "B", u)``, whose certified
            value is the true distance plus an error drawn with standard deviation u, mm.
        noise: Standard deviations of the readings, for all encoders or one a joint, and of the seat; of prismatic
            joints too (``Noise.linear_encoder``).
        encoder_arcsec: Short form of ``Noise(encoder_arcsec=...)``.
        seating: Short form of ``Noise(seating=...)``, mm.
        resolution_arcsec: Readings are rounded to multiples of it; 0 for none. A second number is that of prismatic
            joints, mm.
        limits: Lowest and highest reading of each joint, ``(n, 2)``, rad, or mm of prismatic joints; by default the
            arm's own, else +-pi (a prismatic joint has no default).
        observations: Other observations to record (`data.observations`), with their true geometry.
        chains: Of a robot, by socket or observation the chain that is there, or those that take turns; by default all
            chains take turns.
        temperature: Of an arm with a thermometer, C: one for all poses, by default 20, or the lowest and the highest,
            between which each pose's is drawn; the last column of the readings.
        load: Of an arm with a load, kg: one for all poses, by default 0, or the lowest and the highest. Of an arm with
            directions, each joint is moved to each pose from a random side.
        seed: Seed of poses and noise.

    Returns:
        The capture: readings in rad, lengths in mm, temperatures in C.

    Raises:
        InputError: For a point out of reach, negative noise, and noise given in both forms.

    Example:
        >>> ideal = aj.simulate(true, {"A": (400, 200, 300), "B": (700, 500, 500)}, poses=2, lengths=[("A", "B")])
        >>> print(true.position(ideal.sockets["A"]).round(6))
        [[400. 200. 300.]
         [400. 200. 300.]]
        >>> print(f"{ideal.lengths[0].value:.4f} mm")
        469.0416 mm
    """
    short = {"encoder_arcsec": encoder_arcsec, "seating": seating}
    given = {name: value for name, value in short.items() if value is not None}
    if noise is not None and given:
        raise InputError(
            f"simulate is given both noise and {' and '.join(given)}; state all standard deviations in noise."
        )
    noise = Noise(**given) if noise is None else noise
    if not is_single(arm):
        raise InputError("simulate needs a single arm, but this is a batch; select one arm of the batch.")
    check_finite(arm=arm, noise=noise)
    noise.check_joints(arm.joints)
    drawn = {"thermometer": _ends(arm, temperature, "thermometer"), "load": _ends(arm, load, "load")}
    check_temperatures("the simulation", drawn["thermometer"])
    simulated = items_of(observations, "observations")
    if not isinstance(sockets, Mapping) or not (sockets or simulated):
        raise InputError("simulate needs at least one socket with its position, or one observation.")
    limits_array = np.asarray(joint_limits(arm, limits))
    arm, noise = to_numpy((arm, noise))
    points = {name: socket_point(name, point) for name, point in sockets.items()}
    counts = _counts(points, poses)
    angular, linear = np.append(np.asarray(checked(resolution_arcsec, _RESOLUTION, "resolution_arcsec")), 0.0)[:2]
    slides = np.zeros(arm.joints, dtype=bool) if arm.geometry.kinds is None else arm.geometry.kinds.mask()
    step = np.where(slides, linear, angular * ARCSEC)
    recorder = _Recorder(arm, noise, limits_array, step, drawn, random_generator(seed))
    reach_key, seat_key, encoder_key, length_key = jax.random.split(random_key(seed), 4)
    places = np.array([np.asarray(point) for point in points.values()]).reshape(-1, 3)
    exact = np.repeat(places, list(counts.values()), axis=0)
    references = _reference_lengths(points, lengths, length_key)
    labels = np.repeat([f"socket '{name}'" for name in counts], list(counts.values())).tolist()
    taken = _chain_numbers(arm, chains, {**counts}, [thing.name for thing in simulated])
    of_poses = np.concatenate([np.resize(taken[name], count) for name, count in counts.items()] or [np.zeros(0, int)])
    angles = recorder.read(recorder.configurations(arm, exact, reach_key, seat_key, labels, of_poses), encoder_key)
    ends = np.cumsum(list(counts.values()))
    readings = {name: angles[end - count : end] for (name, count), end in zip(counts.items(), ends, strict=True)}
    keys = [jax.random.fold_in(random_key(seed), number) for number in range(len(simulated))]
    pairs = zip(simulated, keys, strict=True)
    others = []
    for thing, key in pairs:
        if isinstance(thing, AbstractSimulatedContact):
            observation, of_sockets = recorder.contacts(thing, key)
            readings |= of_sockets
        else:
            observation = recorder.recorded(thing, key, taken.get(getattr(thing, "name", "")))
        others.append(observation)
    return Capture(readings, references, others)


class _Recorder(NamedTuple):
    """How a simulated arm holds points, and what its encoders show."""

    arm: Arm
    noise: Noise
    limits: Float[np.ndarray, "n 2"]
    step: Float[np.ndarray, " n"]  # readings are multiples of it, rad and mm; 0 for exact ones
    drawn: dict[str, Float[np.ndarray, " 2"]]  # the lowest and the highest temperature, C, and load, kg
    random: np.random.Generator  # of what is drawn, and of directions

    def configurations(
        self,
        holding: Arm,
        points: Float[np.ndarray, "m 3"],
        reach_key: Array,
        seat_key: Array,
        labels: Sequence[str],
        chain: Float[np.ndarray, " m"] | Int[np.ndarray, " m"],
        held: Float[np.ndarray, "m n"] | None = None,
        enough: int | None = None,
    ) -> Float[np.ndarray, "m columns"]:
        """Random configurations of an arm at points, where the seat lets it be, with what is recorded beside them;
        ``held`` and ``enough`` are those of `random_configurations`."""
        targets = points + self.noise.seating * random_numbers("normal", seat_key, points.shape)
        beside, q = holding.beside, self.rows(chain)
        scaled = targets / length_scale(holding.geometry, q)[:, None]
        of_poses = q[:, holding.joints : beside.own]
        found = random_configurations(holding, scaled, reach_key, self.limits, labels, of_poses, held, enough)
        q[:, : holding.joints] = found
        if "torques" in beside.possible:
            q[:, beside.slices(q.shape[1])["torques"]] = holding_torques(holding, q)
        if {"directions", "load"} & set(beside.possible):
            q, _ = project_to_targets(holding, q, targets, kept=None if held is None else ~np.isnan(held))
        return q

    def rows(self, chain: Float[np.ndarray, " m"] | Int[np.ndarray, " m"]) -> Float[np.ndarray, "m columns"]:
        """Readings of 0 of poses of these chains, with what is drawn beside them."""
        beside = self.arm.beside
        q = np.zeros((len(chain), beside.width(beside.possible)))
        columns = {name: q[:, part] for name, part in beside.slices(q.shape[1]).items()}
        for name, (low, high) in self.drawn.items():
            columns[name][:] = self.random.uniform(low, high, columns[name].shape)
        if beside.chains:
            q[:, self.arm.joints] = chain
        columns["directions"][:] = self.random.choice([-1.0, 1.0], columns["directions"].shape)
        return q

    def read(self, q: Float[np.ndarray, "m columns"], key: Array) -> Float[np.ndarray, "m columns"]:
        """What the encoders show; what is recorded beside them is exact."""
        angles, beside = q[:, : self.arm.joints], q[:, self.arm.joints :]
        shown = angles + self.noise.of_readings(self.arm.geometry.kinds) * random_numbers("normal", key, angles.shape)
        step = np.where(self.step > 0, self.step, 1.0)
        return np.concatenate([np.where(self.step > 0, np.round(shown / step) * step, shown), beside], axis=1)

    def recorded(
        self, simulated: AbstractSimulated, key: Array, chain: Int[np.ndarray, " c"] | None
    ) -> AbstractObservation:
        """One simulated observation."""
        if not isinstance(simulated, AbstractSimulated):
            raise InputError(
                f"{simulated!r} cannot be simulated; give a simulated observation from aj.data.observations, such "
                "as SimulatedSphere."
            )
        reach_key, seat_key, encoder_key, own_key = jax.random.split(key, 4)
        random = np.random.default_rng(np.asarray(jax.random.key_data(own_key)))
        holding = self.arm if simulated.offset is None else to_numpy(self.arm.replace(probe=simulated.offset))
        exact = simulated.tips(random)
        labels = [f"observation '{simulated.name}'"] * len(exact)
        of_poses = np.resize(np.zeros(1, int) if chain is None else chain, len(exact))
        angles = self.configurations(holding, exact, reach_key, seat_key, labels, of_poses)
        # An instrument sees the tip where it is: the seat's error moves the tip, and not what it is compared with.
        transforms = np.asarray(holding.pose(angles)).copy()
        transforms[:, :3, 3] = exact
        return simulated.recorded(self.read(angles, encoder_key), transforms, random)

    def contacts(
        self, contact: AbstractSimulatedContact, key: Array
    ) -> tuple[AbstractObservation, dict[str, Float[np.ndarray, "1 columns"]]]:
        """Contacts, and the poses of the chain that touches, each a socket of its own. Joints that move both bodies
        are in both poses where they are, and as they were read."""
        carry_key, lean_key, reach_key, seat_key, read_key, touch_key, own_key = jax.random.split(key, 7)
        random = np.random.default_rng(np.asarray(jax.random.key_data(own_key)))
        touching, carrying = _numbers(self.arm, (contact.touching, contact.carrying))
        many, n, kinds = contact.changed(poses=_TRIED * contact.poses), self.arm.joints, self.arm.geometry.kinds
        labels = [f"observation '{contact.name}'"] * many.poses
        with naming(labels[0]):
            body = chains_of(self.arm)[contact.carrying].body(contact.link)
        at_tip = many.tips(random)
        if body == carrying:
            angles = self.configurations(self.arm, at_tip, carry_key, lean_key, labels, np.full(many.poses, body))
        else:
            angles = self._within(np.sort(contact.region, axis=0), body, labels)
        transforms = np.asarray(self.arm.pose(angles)).copy()
        seats = self.noise.seating * random_numbers("normal", lean_key, at_tip.shape)
        transforms[:, :3, 3] = at_tip if body == carrying else transforms[:, :3, 3] + seats
        assert kinds is not None
        both = kinds.members(np.array([touching, body]))[:, :n].all(axis=0)
        held = np.where(both, angles[:, :n], np.nan)
        numbers, points = np.full(many.poses, touching), many.touched(transforms, random)
        labels = [f"contact '{name}'" for name in many.sockets]
        q = self.configurations(self.arm, points, reach_key, seat_key, labels, numbers, held, contact.poses)
        chosen = np.flatnonzero(np.isfinite(q).all(axis=1))[: contact.poses]
        read, touched = self.read(angles[chosen], read_key), self.read(q[chosen], touch_key)
        touched[:, :n] = np.where(both, read[:, :n], touched[:, :n])
        observation = contact.recorded(read, transforms[chosen], random)
        return observation, dict(zip(contact.sockets, touched[:, None], strict=True))

    def _within(
        self, box: Float[np.ndarray, "2 3"], body: float, labels: Sequence[str]
    ) -> Float[np.ndarray, "m columns"]:
        """Random configurations with the origin of a link in a box."""
        found, arm = [], self.arm
        for _ in range(_ROUNDS):
            q = self.rows(np.full(_DRAWN, body))
            q[:, : arm.joints] = self.random.uniform(self.limits[:, 0], self.limits[:, 1], (_DRAWN, arm.joints))
            origins = np.asarray(arm.position(q))
            found += list(q[np.all((box[0] <= origins) & (origins <= box[1]), axis=1)])
            if len(found) >= len(labels):
                return np.array(found[: len(labels)])
        raise InputError(f"{labels[0]} has a link that is almost never in its region; give a region where the link is.")


def _chain_numbers(
    arm: Arm, given: Mapping[str, str | Sequence[str]] | None, sockets: Mapping[str, int], others: Sequence[str]
) -> dict[str, Int[np.ndarray, " c"]]:
    """Numbers of the chains that take turns at each socket and observation, by default all."""
    taken = {name: np.arange(tips_of(arm)) for name in (*sockets, *others)}
    for where, names in (given or {}).items():
        if where not in taken:
            raise InputError(f"chains are given for '{where}', which is not simulated{nearest(where, taken)}")
        taken[where] = _numbers(arm, (names,) if isinstance(names, str) else tuple(names))
    return taken


def _numbers(arm: Arm, names: Sequence[str]) -> Int[np.ndarray, " c"]:
    """Numbers of chains by their names."""
    numbers = {name: number for number, (name, _) in enumerate(arm.chains)}
    for name in names:
        if name not in numbers:
            raise InputError(f"the robot has no chain '{name}'{nearest(str(name), numbers)}")
    return np.array([numbers[name] for name in names])


def _ends(arm: Arm, given: Numbers | None, name: str) -> Float[np.ndarray, " 2"]:
    """The lowest and the highest temperature or load of an arm whose readings have it."""
    what, unit = ("temperature", "C") if name == "thermometer" else (name, "kg")
    if given is not None and name not in arm.beside.possible:
        raise InputError(f"a {what} is given, but the arm has no {name}; create the arm with {name}=True.")
    usual = REFERENCE_TEMPERATURE if name == "thermometer" else 0.0
    values = np.asarray(as_floats(usual if given is None else given, what))
    if values.shape not in ((), (2,)) or np.any(np.diff(np.atleast_1d(values)) < 0):
        raise InputError(f"{what} must be one number, or the lowest and the highest {what}, in {unit}.")
    return np.broadcast_to(values, (2,))


def socket_point(name: str, point: Numbers) -> Float[AnyArray, " 3"]:
    """A socket's position, mm, or `InputError` that names the socket."""
    array = as_floats(point, f"position of socket '{name}'")
    if array.shape != (3,):
        raise InputError(
            f"position of socket '{name}' has shape {array.shape}; give its three coordinates (x, y, z) in mm."
        )
    return array


def _counts(points: Mapping[str, AnyArray], poses: int | Mapping[str, int]) -> dict[str, int]:
    counts = {name: poses.get(name, 0) if isinstance(poses, Mapping) else poses for name in points}
    for name in poses if isinstance(poses, Mapping) else ():
        if name not in points:
            raise InputError(f"poses are given for the unknown socket '{name}'{nearest(name, points)}")
    for name, count in counts.items():
        checked(count, Annotated[int, Range(least=1, most=MOST_POSES)], f"number of poses of socket '{name}'")
    return counts


def _reference_lengths(points: Mapping[str, AnyArray], lengths: Iterable, key: Array) -> list[ReferenceLength]:
    drawn = []
    for number, length in enumerate(items_of(lengths, "lengths")):
        if isinstance(length, ReferenceLength):
            drawn.append(length)
            continue
        if not isinstance(length, tuple | list) or len(length) not in (2, 3):
            raise InputError(
                f"reference length {shown(length)} must be (socket, socket) or (socket, socket, u), with u in mm."
            )
        (start, end), u = length[:2], length[2] if len(length) == 3 else 0.0
        where = f"reference length '{start}' to '{end}'"
        for name in (start, end):
            if not isinstance(name, str) or name not in points:
                raise InputError(f"{where} names the unknown socket '{name}'{nearest(str(name), points)}")
        real_number(u, f"u of {where}")
        draw = float(random_numbers("normal", jax.random.fold_in(key, number), ()))
        true = float(np.linalg.norm(np.asarray(points[start]) - np.asarray(points[end])))
        drawn.append(ReferenceLength(start, end, true + u * draw, u))
    return drawn
