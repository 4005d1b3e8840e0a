"""Where the tip can be in a live capture, and the capture that its poses make.

Everything is a `Place` of something that can be simulated (`data.observations.simulated`): a socket, a point of an
artefact, or an instrument that sees the tip wherever it is. The observation that the poses give is the one that the
simulated thing would record, with the readings and measured values in place of its own.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..data.capture import Capture, join_sessions
from ..data.capture_data import ReferenceLength
from ..data.noise import ArmNoise
from ..data.observations.held import SimulatedArtefact, SimulatedSocket
from ..data.observations.measured import AbstractInBox
from ..data.observations.observation import AbstractObservation
from ..data.observations.pixels import Pixels
from ..data.observations.simulated import AbstractSimulated
from ..data.observations.simulated_pixels import SimulatedPixels
from ..data.targets import AbstractTarget
from ..kinematics.arm import Arm
from ..kinematics.beside import BY_JOINT
from ..kinematics.parameters import ArmSpecification
from ..planning.kit_placement import KitItem

COLUMNS = {"torques": "torque_{}", "directions": "direction_{}", "load": "load_kg", "thermometer": "temperature_C"}
_NEUTRAL = {"thermometer": 20.0}
FREE = ("points", "transforms", "pixels", "distances")
_WANTED = 8  # poses in each place of which a plan says nothing


class Place(NamedTuple):
    """One place where poses are taken.

    Args:
        name: As people read it: of a point of an artefact ``artefact/point``.
        thing: What is there, roughly where it stands.
        point: Of an artefact or of two planes, the point or side.
        position: Where the tip is expected, in the base frame ``(3,)``, mm; None where it may be anywhere.
        wanted: How many poses a plan has here.
        item: The item of the kit that it belongs to, with its cone.

    Example:
        >>> specification = aj.files.load_specification("cheng2018-simulation")
        >>> noise = aj.files.load_noise("cheng2018-simulation")
        >>> cone = aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5)
        >>> setup = aj.live.setup_of(specification, noise, [cone])
        >>> place = setup.places[0]
        >>> print(place.name, place.kind, place.position, place.wanted)
        A socket [400. 200. 300.] 5
    """

    name: str
    thing: AbstractSimulated
    point: str
    position: Float[np.ndarray, " 3"] | None
    wanted: int
    item: KitItem

    @property
    def kind(self) -> str:
        """``socket``, ``artefact``, ``points`` and so on: the name of its tables in a kit."""
        return self.thing.table

    @property
    def is_free(self) -> bool:
        """Whether the tip may be anywhere: an instrument sees it."""
        return self.kind in FREE


class TakenPose(NamedTuple):
    """A pose as it was taken: mean readings of a moment of rest.

    Example:
        >>> pose = aj.live.TakenPose(1, "A", 0.0, np.zeros(6), np.full(6, 1e-5))
        >>> print(pose.place, pose.session, pose.excluded)
        A 1 False
    """

    number: int
    place: str
    time: float  # s since 1970
    q: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]  # standard deviation of the readings while at rest
    columns: Mapping[str, float] = {}
    measured: Mapping[str, np.ndarray] = {}
    session: int = 1
    excluded: bool = False


class Setup(NamedTuple):
    """What a live capture is of: the arm, the places, the certified lengths between sockets, and a plan, if any.

    Example:
        >>> from pathlib import Path
        >>> _ = Path("cone.toml").write_text('socket = [{ name = "A", point = [400, 200, 300] }]')
        >>> setup = aj.live.read_setup("cheng2018-simulation", kit="cone.toml")
        >>> print(setup.specification.arm.joints, setup.place("A").kind)
        6 socket
    """

    specification: ArmSpecification
    noise: ArmNoise
    places: tuple[Place, ...]
    lengths: tuple[ReferenceLength, ...] = ()
    planned: tuple[tuple[str, Float[np.ndarray, " n"]], ...] = ()  # name of the place and readings, in order
    targets: Mapping[str, AbstractTarget] = {}  # that cameras see, by name

    def place(self, name: str) -> Place:
        """The place of a name; `InputError` where there is none."""
        found = next((place for place in self.places if place.name == name), None)
        if found is None:
            raise InputError(f"there is no place '{name}'; the places are {', '.join(p.name for p in self.places)}.")
        return found


def setup_of(
    specification: ArmSpecification,
    noise: ArmNoise,
    kit: Iterable[KitItem | AbstractSimulated],
    lengths: Iterable[ReferenceLength] = (),
    planned: Iterable[tuple[str, Any]] = (),
) -> Setup:
    """The places of a kit: each socket, each point of each placement of an artefact, and each instrument.

    Args:
        specification: The arm, as `files.load_specification` reads it.
        noise: What is usual for it, as `files.load_noise` reads it.
        kit: Observations to simulate, where they stand, or `planning.KitItem`, whose placements are found live.
        lengths: Certified lengths between sockets.
        planned: Name of the place and readings, rad, or mm of prismatic joints, of each pose of a plan.

    Raises:
        InputError: The kit is empty, or the arm is a robot of several chains.

    Example:
        >>> bar = aj.data.observations.SimulatedArtefact("bar", {"1": (400, 0, 200), "2": (700, 0, 200)}, 5, u=0.001)
        >>> specification = aj.files.load_specification("cheng2018-simulation")
        >>> setup = aj.live.setup_of(specification, aj.files.load_noise("cheng2018-simulation"), [bar])
        >>> print([place.name for place in setup.places])
        ['bar/1', 'bar/2']
    """
    if specification.arm.chains:
        chains = ", ".join(name for name, _ in specification.arm.chains)
        raise InputError(
            f"a live capture is of one chain, but this robot has {len(specification.arm.chains)} ({chains}); name the "
            "tip of one (--tip), and capture each on its own."
        )
    planned, places = list(planned), list[Place]()
    counts = Counter(name for name, _ in planned)
    for given in kit:
        item = given if isinstance(given, KitItem) else KitItem(given, places=0)
        thing: AbstractSimulated = item.simulated
        names = [f"{thing.name}/{i + 1}" for i in range(item.places)] if item.places > 1 else [thing.name]
        for placed in (thing.changed(name=name) for name in names):
            labels, tips = _labels_and_tips(placed)
            known = isinstance(thing, SimulatedSocket | SimulatedArtefact) and not item.places
            for label, tip in zip(labels, tips, strict=True):
                name = f"{placed.name}/{label}" if label else placed.name
                wanted = counts[name] or thing.poses or _WANTED
                places.append(Place(name, placed, label, tip if known else None, wanted, item))
    if not places:
        raise InputError("there is no place for poses; give a kit with a socket, an artefact or an instrument.")
    return Setup(
        specification,
        noise,
        tuple(places),
        tuple(lengths),
        tuple((name, np.asarray(q, dtype=float)) for name, q in planned),
    )


def _labels_and_tips(thing: AbstractSimulated) -> tuple[list[str], Float[np.ndarray, "m 3"]]:
    """The points or sides of a thing that has several, else one that is empty; and one tip in each."""
    if isinstance(thing, AbstractInBox | SimulatedPixels):
        return [""], np.full((1, 3), np.nan)
    template, tips = _template(thing)
    label = label_of(template)
    return ([""], tips[:1]) if label is None else (list(template.stored()[label]), tips)


def label_of(observation: AbstractObservation) -> str | None:
    """The entry that names the point or side of each pose; None where there is none."""
    names = [e.name for e in observation.entries if e.content == "text" and e.of_poses and e.name != "images"]
    return names[0] if names else None


def _template(thing: AbstractSimulated) -> tuple[AbstractObservation, Float[np.ndarray, "m 3"]]:
    """What a thing records of one pose in each of its points, without errors of readings."""
    one = thing.changed(poses=1)
    tips = one.tips(np.random.default_rng(0))
    transforms = np.tile(np.eye(4), (len(tips), 1, 1))
    transforms[:, :3, 3] = tips
    return one.recorded(np.zeros((len(tips), 1)), transforms, np.random.default_rng(0)), tips


def row_of_readings(arm: Arm, pose: TakenPose) -> Float[np.ndarray, " columns"]:
    """Readings of a pose as an arm takes them: with what it wants recorded beside them."""
    parts = [pose.q]
    for name in arm.beside.possible:
        keys = [COLUMNS[name].format(i + 1) for i in range(arm.joints)] if name in BY_JOINT else [COLUMNS[name]]
        parts.append(np.array([pose.columns.get(key, _NEUTRAL.get(name, 0.0)) for key in keys]))
    return np.concatenate(parts)


def capture_of(setup: Setup, poses: Sequence[TakenPose]) -> tuple[Capture, list[int]]:
    """The capture of some poses, and the number of the pose in each of its rows, in the order of `Capture.readings`.

    Poses that are excluded do not count; sessions are joined with a probe each.

    Args:
        setup: The arm and the places.
        poses: The poses, in any order.

    Raises:
        InputError: There is no pose, or one lacks what an instrument should have measured.

    Example:
        >>> specification = aj.files.load_specification("cheng2018-simulation")
        >>> noise = aj.files.load_noise("cheng2018-simulation")
        >>> cone = aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5)
        >>> setup = aj.live.setup_of(specification, noise, [cone])
        >>> poses = [aj.live.TakenPose(i, "A", 0.0, np.full(6, 0.1 * i), np.zeros(6)) for i in (1, 2)]
        >>> capture, numbers = aj.live.capture_of(setup, poses)
        >>> print(capture.names, capture.sizes, numbers)
        ('A',) (2,) [1, 2]
    """
    kept = [pose for pose in poses if not pose.excluded]
    if not kept:
        raise InputError("no pose has been taken yet; take a pose first.")
    sessions = sorted({pose.session for pose in kept})
    captures, numbers = {}, {}
    for session in sessions:
        own = [pose for pose in kept if pose.session == session]
        captures[f"session {session}"], numbers[session] = _of_one_session(setup, own)
    if len(sessions) == 1:
        capture, order = captures[f"session {sessions[0]}"], numbers[sessions[0]]
        return capture, order[0] + order[1]
    # Sockets of later sessions have another tip, so they follow as observations.
    joined = join_sessions(captures)
    first = numbers[sessions[0]]
    rest = [number for session in sessions[1:] for part in numbers[session] for number in part]
    return joined, first[0] + first[1] + rest


def _of_one_session(setup: Setup, poses: Sequence[TakenPose]) -> tuple[Capture, tuple[list[int], list[int]]]:
    arm = setup.specification.arm
    sockets: dict[str, Any] = {}
    observations: list[AbstractObservation] = []
    of_sockets: list[int] = []
    of_others: list[int] = []
    for name, places in by_thing(setup).items():
        thing = places[0].thing
        own = _different([pose for place in places for pose in poses if pose.place == place.name])
        if not own:
            continue
        q = np.array([row_of_readings(arm, pose) for pose in own])
        if isinstance(thing, SimulatedSocket) and not thing.target:
            sockets[name] = q
            of_sockets += [pose.number for pose in own]
        else:
            observations.append(observation_of(thing, q, own, {place.name: place.point for place in places}))
            of_others += [pose.number for pose in own]
    lengths = [length for length in setup.lengths if length.start in sockets and length.end in sockets]
    return Capture(sockets, lengths, observations), (of_sockets, of_others)


def _different(poses: Sequence[TakenPose]) -> list[TakenPose]:
    """Poses without copies that are equal to the bit, as coarse encoders give, which a `Capture` counts once."""

    def key(pose: TakenPose) -> tuple[Any, ...]:
        return (pose.place, pose.q.tobytes(), *(np.asarray(value).tobytes() for value in pose.measured.values()))

    return list({key(pose): pose for pose in reversed(poses)}.values())[::-1]


def by_thing(setup: Setup) -> dict[str, list[Place]]:
    """The places of each thing by its name."""
    things: dict[str, list[Place]] = {}
    for place in setup.places:
        things.setdefault(place.thing.name, []).append(place)
    return things


def observation_of(
    thing: AbstractSimulated, q: np.ndarray, poses: Sequence[TakenPose], points: Mapping[str, str]
) -> AbstractObservation:
    """The observation of poses in one thing; ``points``: the point or side of each place."""
    if isinstance(thing, SimulatedPixels):
        return _pixels(thing, q, poses)
    template = _template(thing)[0]
    stored, label = template.stored(), label_of(template)
    labels = [""] if label is None else list(stored[label])
    rows = [labels.index(points[pose.place]) if label else 0 for pose in poses]
    values: dict[str, Any] = {}
    for entry in template.entries:
        if entry.name in stored:
            value = stored[entry.name]
            values[entry.name] = np.asarray(value)[rows] if entry.of_poses and entry.name != "q" else value
    values["q"] = q
    for entry in template.entries:
        if entry.of_poses and entry.required and entry.name not in ("q", label):
            missing = [pose.number for pose in poses if entry.name not in pose.measured]
            if missing:
                raise InputError(f"pose {missing[0]} in '{thing.name}' has no {entry.says}; exclude the pose.")
            values[entry.name] = np.array([pose.measured[entry.name] for pose in poses])
    return type(template).rebuilt(thing.name, values)


def _pixels(thing: SimulatedPixels, q: np.ndarray, poses: Sequence[TakenPose]) -> Pixels:
    """Corners of poses, which may differ in number."""
    most = max(len(pose.measured.get("ids", ())) for pose in poses)
    corners, ids = np.zeros((len(poses), most, 2)), np.full((len(poses), most), -1)
    for row, pose in enumerate(poses):
        if not len(found := pose.measured.get("ids", ())):
            raise InputError(f"pose {pose.number} in '{thing.name}' has no corners; exclude the pose.")
        ids[row, : len(found)], corners[row, : len(found)] = found, pose.measured["corners"]
    return Pixels(
        thing.name, q, corners, np.asarray(thing.points)[np.maximum(ids, 0)], ids, max(thing.u, 1e-6), thing.camera,
        thing.board, on_arm=thing.on_arm, model=thing.model, u_scale=thing.u_scale, image_size=thing.image_size,
        intrinsics=thing.intrinsics if thing.stated is None else thing.stated, u_intrinsics=thing.u_intrinsics,
    )  # fmt: skip
