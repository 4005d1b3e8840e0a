"""Robots of several chains: one arm with the joints of all chains, made of plain arms and divided into them again.

Joints that chains have in common are the same rows of Denavit-Hartenberg parameters, so that their parameters are tied.
A joint after which chains separate is a row of zeros: the link to each branch is the row of a fixed joint, with which
the branch begins. The base of an arm that has no joint in common with the first one is carried by three fixed joints:

    T = Tz(z) Tx(x)  Rz(pi/2) Tx(y) Rx(alpha') Ry(beta')  Rz(theta) Rx(alpha) Ry(beta)

with x, y, z, theta and small angles alpha and beta free, and the other angles constant, so that all six freedoms of a
base are determined, however the arm is mounted.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import to_numpy
from .arm import Arm, arm_of, joint_limits, parameter_names, probe_names, value_of, without_corrections
from .axes_to_dh import Transform, dh_link, rotation
from .chain import Corrections, KnownFunctions
from .correction_kinds import Term
from .joint_kinds import body_of
from .recorded_kinds import HANGS

_ROW = ("theta", "d", "a", "alpha", "beta")
_STEP = 1e-4  # mm and rad, of derivatives
_SAME = 1e-9  # mm and rad: tied parameters that differ by more are different
_MOUNT = (("d", "a"), ("a",), ("theta", "alpha", "beta"))  # the free parameters of the fixed joints below a base


class ChainOf(NamedTuple):
    """A chain of a robot as an arm of its own, and what is what: parameters, readings and base.

    Example:
        >>> arms = {"left": aj.load_arm("panda"), "right": aj.load_arm("panda")}
        >>> robot = aj.kinematics.together(arms, bases={"right": (0.0, -800.0, 0.0)})
        >>> chain = aj.kinematics.chain_of(robot, "right")
        >>> print(chain.readings([0.0] * 7).shape, chain.names["a_3"], chain.names["probe_z"])
        (1, 18) a_13 probe2_z
    """

    arm: Arm
    base: Transform  # its base in that of the robot, mm
    number: int  # of the chain, from 0
    joints: tuple[int, ...]  # of the robot, from 1: the joint whose reading each joint of the arm has
    mount: tuple[int, ...]  # fixed joints of the robot that carry the base
    names: Mapping[str, str]  # of the robot's parameter that each parameter of the arm is
    robot_joints: int  # of the robot

    def readings(self, q: Numbers, link: int | None = None) -> Float[np.ndarray, "N columns"]:
        """The robot's readings, with the number of the chain, at readings of the chain ``(N, n)``; other joints at 0.

        With a ``link``, the poses are those of the frame after this joint of the chain, from 1, instead of its tip's.
        """
        given = np.atleast_2d(np.asarray(q, dtype=float))
        if given.shape[-1] != len(self.joints):
            raise InputError(f"q has {given.shape[-1]} columns, but the chain has {len(self.joints)} joints.")
        return np.column_stack([self.spread(given), np.full(len(given), self.body(link))])

    def body(self, link: int | None = None) -> float:
        """The number that poses of the chain's tip have in the column after the joints, or those of a link."""
        if link is None:
            return self.number
        if not 1 <= link <= len(self.joints):
            raise InputError(
                f"link {link} does not exist; give the number of a link of the chain, 1 to {len(self.joints)}."
            )
        return body_of(self.number, self.frames[link])

    def spread(self, values: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N joints"]:
        """Numbers of the chain's joints as those of the robot's; 0 of others."""
        whole = np.zeros((len(values), self.robot_joints))
        whole[:, np.array(self.joints) - 1] = values
        return whole

    @property
    def frames(self) -> tuple[int, ...]:
        """The frame of the robot that each frame of the arm is: of its base, and after each of its joints."""
        after = (int(self.names[f"a_{i}"].removeprefix("a_")) for i in range(1, self.arm.joints + 1))
        return ((0, *self.mount)[-1], *after)

    def of_robot(self, q: Numbers) -> Float[np.ndarray, "N n"]:
        """The readings of the chain among those of the robot."""
        return np.asarray(q)[..., np.array(self.joints) - 1]


def chain_of(robot: Arm, name: str) -> ChainOf:
    """A chain of a robot as an arm of its own, which is exact.

    Links that are fixed joints of the robot are part of the joint before them. Joint corrections of the chain are those
    of the arm, gravity in its own base frame. `InputError` for a chain that does not exist, or that is no arm of its
    own: where a joint follows one of another chain, or links of known masses are part of others.

    Args:
        robot: An arm with chains.
        name: Name of the chain.

    Example:
        >>> left, right = aj.Arm(alpha=[1.57, 0], a=[0, 300], d=[90, 0]), aj.Arm(alpha=[1.57, 0], a=[0, 200], d=[80, 0])
        >>> robot = aj.kinematics.together({"left": left, "right": right}, bases={"right": (500, 0, 0)})
        >>> chain = aj.kinematics.chain_of(robot, "right")
        >>> print(chain.arm.a, chain.joints, chain.base[:3, 3])
        [  0. 200.] (6, 7) [500.   0.   0.]
    """
    numbers = [chain for chain, _ in robot.chains]
    if name not in numbers:
        raise InputError(f"the robot has no chain '{name}'{nearest(str(name), numbers)}")
    number, (_, joints) = numbers.index(name), robot.chains[numbers.index(name)]
    rows = _rows_of(robot)
    start = next(place for place, joint in enumerate(joints) if joint not in robot.fixed)
    base = _product(rows, joints[:start])
    links, moving, owner = [], [], []
    for joint in joints[start:]:
        theta, d, a, alpha, beta = row = rows[joint - 1]
        if joint in robot.fixed and not np.any(links[-1][2:]):
            links[-1] = np.array([theta + links[-1][0], d + links[-1][1], a, alpha, beta])
            owner[-1] = joint
        else:
            links.append(row)
            moving.append(joint)
            owner.append(joint)
    place = {joint: i for i, joint in enumerate(moving, start=1)}
    limits = None if robot.limits is None else [robot.limits[joint - 1] for joint in moving]
    following = [row for row in robot.mimic if row[0] in place]
    for joint, source, *_ in following:
        if source not in place:
            raise InputError(
                f"joint {joint} of chain '{name}' mimics joint {source}, which is of another chain, so the chain "
                "is not an arm of its own."
            )
    values = dict(zip(_ROW, np.array(links).T, strict=True))
    arm = Arm(
        **(values if robot.beta is not None else {kind: values[kind] for kind in _ROW[:-1]}),
        probe=np.asarray(robot.probe)[3 * number : 3 * number + 3],
        limits=limits,
        prismatic=[place[joint] for joint in moving if joint in robot.prismatic],
        fixed=[place[joint] for joint in moving if joint in robot.fixed],
        mimic=[(place[joint], place[source], factor, zero) for joint, source, factor, zero in following],
    )
    arm = _with_corrections(robot, arm, name, number, moving, owner, base)
    kinds = _ROW if robot.beta is not None else _ROW[:-1]
    names = {f"{kind}_{i}": f"{kind}_{joint}" for i, joint in enumerate(owner, start=1) for kind in kinds}
    probes = probe_names(len(robot.chains))[3 * number : 3 * number + 3]
    names |= dict(zip(probe_names(1), probes, strict=True))
    names |= {own: of_robot for own, of_robot in zip(_coefficients(arm), _kept(robot, moving, owner), strict=True)}
    return ChainOf(arm, base, number, tuple(moving), tuple(joints[:start]), names, robot.joints)


def _kept(robot: Arm, moving: Sequence[int], owner: Sequence[int]) -> dict[str, Term]:
    """The corrections of a robot that are those of a chain, by their names, as terms of the chain's arm."""
    place = {0: 0} | {joint: i for i, joint in enumerate(moving, start=1)}
    kept = {}
    for term in () if robot.corrections is None else robot.corrections.functions.terms:
        of_link, number = term.kind.rows == 3 and term.number > 0, term.number
        if of_link:
            number = owner.index(number) + 1 if number in owner else 0
        elif term.kind.of_other_reading:
            number = place.get(number, 0)
        if term.joint in place and (number or not term.number):
            kept[term.name] = term._replace(number=number, joint=place[term.joint])
    return kept


def _coefficients(arm: Arm) -> tuple[str, ...]:
    return () if arm.corrections is None else arm.corrections.functions.names


def _with_corrections(
    robot: Arm, arm: Arm, name: str, number: int, moving: list[int], owner: list[int], base: Transform
) -> Arm:
    """The arm of a chain with the corrections of the robot that are its own."""
    kept = _kept(robot, moving, owner)
    if robot.corrections is None or not kept:
        return arm
    loads = next((term.loads for term in kept.values() if term.loads is not None), None)
    if loads is not None:
        raise InputError(
            f"joint corrections of chain '{name}' use the masses of all links of the robot, so the chain is not an arm "
            "of its own; remove these corrections."
        )
    if any(term.word == HANGS for term in kept.values()) and abs(base[2, 2] - 1) > _SAME:
        raise InputError(
            f"the base of chain '{name}' is tilted, but backlash=gravity is for a base that stands upright, so the "
            "chain is not an arm of its own; remove these corrections."
        )
    assert robot.coefficients is not None
    places = [robot.corrections.functions.names.index(of_robot) for of_robot in kept]
    nominal = chain_of(arm_of(robot.corrections.nominal), str(number + 1)).arm.geometry
    return arm.replace(
        corrections=Corrections(KnownFunctions(tuple(kept.values())), nominal),
        coefficients=np.asarray(robot.coefficients)[places],
        gravity=base[:3, :3].T @ np.asarray(robot.gravity),
        load_centre=robot.load_centre and robot.load_centre[3 * number : 3 * number + 3],
        **dict.fromkeys(robot.recorded, True),
    )


def chains_taken(robot: Arm, q: Float[np.ndarray, "N columns"]) -> tuple[str, ...]:
    """The names of the chains that poses are of; empty for an arm without chains."""
    return tuple(robot.chains[int(number)][0] for number in q[:, robot.joints]) if robot.chains else ()


def chains_of(robot: Arm) -> dict[str, ChainOf]:
    """All chains of a robot by name, without joint corrections; a joint that follows one of another chain moves by
    itself in them, so that they say where the links are, and not which poses there are."""
    plain = without_corrections(robot) if robot.corrections is not None else robot
    within = [row for row in plain.mimic if all(row[1] in joints for _, joints in plain.chains if row[0] in joints)]
    plain = plain.replace(mimic=within) if len(within) < len(plain.mimic) else plain
    return {name: chain_of(plain, name) for name, _ in robot.chains}


def _rows_of(arm: Arm) -> Float[np.ndarray, "n 5"]:
    beta = np.zeros(arm.joints) if arm.beta is None else arm.beta
    return np.array([np.asarray(x) for x in (arm.theta, arm.d, arm.a, arm.alpha, beta)]).T


def chain_facts(arm: Arm) -> dict[str, list]:
    """What a file states of an arm's fixed and following joints, and of its chains; those that are empty are left
    out."""
    further = np.asarray(arm.probe)[3:].reshape(-1, 3).tolist()
    facts = {"fixed": list(arm.fixed), "mimic": [list(row) for row in arm.mimic], "further_probes": further}
    facts["chains"] = [{"name": name, "joints": list(joints)} for name, joints in arm.chains]
    return {name: fact for name, fact in facts.items() if fact}


def together(
    arms: Mapping[str, Arm],
    *,
    joints: Mapping[str, Sequence[str]] | None = None,
    bases: Mapping[str, Numbers] | None = None,
    mimic: Mapping[str, tuple[str, float, float]] | None = None,
) -> Arm:
    """A robot of several arms: one arm with the joints of all, each arm one of its chains.

    Joints of the same name, which chains begin with, are the same joint, whose parameters are tied. The first arm's
    base is that of the robot; arms whose first joint is another one stand on a base of their own, with six parameters.
    `InputError` where tied parameters have different values, chains that have separated have a joint in common again,
    or an arm is not a plain one.

    Args:
        arms: Arms by the name of their chain.
        joints: Names of the joints of each chain; by default chains have none in common.
        bases: Base of each arm, but for the first one, in that of the first: a transform ``(4, 4)`` or a position, mm.
        mimic: By name of a joint the name of the joint that it follows, the factor, and the offset in rad, or mm.

    Example:
        >>> arms = {"left": aj.load_arm("panda"), "right": aj.load_arm("panda")}
        >>> robot = aj.kinematics.together(arms, bases={"right": (0.0, -800.0, 0.0)})
        >>> print(robot.joints, robot.fixed, len(aj.Parameters.free_of(robot).names))
        17 (8, 9, 10) 56
    """
    arms = {str(name): to_numpy(arm) for name, arm in arms.items()}
    for name, arm in arms.items():
        if arm.chains or arm.fixed or arm.mimic or arm.corrections is not None or arm.alpha.ndim > 1:
            raise InputError(f"arm '{name}' must be one plain arm without corrections; give its parameters alone.")
    of_chain = {name: [f"{name}\0{i}" for i in range(arm.joints)] for name, arm in arms.items()}
    for name, given in (joints or {}).items():
        if name not in arms:
            raise InputError(f"joints of '{name}' are given, but there is no such arm{nearest(name, list(arms))}")
        of_chain[name] = list(given)
        if len(set(given)) != len(of_chain[name]) or len(of_chain[name]) != arms[name].joints:
            raise InputError(f"joints of '{name}' must be {arms[name].joints} different names, one per joint.")
    after: dict[str, set[str]] = {}  # what comes next in some chain
    before: dict[str, str] = {}
    for name, chain in of_chain.items():
        for last, joint in zip(["", *chain], [*chain, f"\0{name}"], strict=True):
            after.setdefault(last, set()).add(joint)
            if before.setdefault(joint, last) != last:
                raise InputError(
                    f"joint '{joint}' comes after different joints in two chains; chains that have separated cannot "
                    "meet again."
                )
    first = next(iter(of_chain.values()))[0]
    place: dict[str, int] = {}  # number of each joint, from 1; of links that are fixed joints, by "before > after"
    rows: list[np.ndarray] = []
    limits: list[tuple[float, float]] = []
    fixed: list[int] = []
    chains: dict[str, list[int]] = {}

    def number_of(key: str, row: Iterable[float], what: str, limit: Sequence[float] = (0.0, 0.0)) -> int:
        values = np.array([*row], dtype=float)
        if key not in place:
            place[key] = len(rows) + 1
            rows.append(values)
            limits.append((limit[0], limit[1]))
        elif (wrong := np.flatnonzero(np.abs(rows[place[key] - 1] - values) > _SAME)).size:
            kind = _ROW[wrong[0]]
            raise InputError(
                f"joint '{what}' has different values of {kind} in two chains, {rows[place[key] - 1][wrong[0]]:.9g} "
                f"and {values[wrong[0]]:.9g}; tied parameters must have the same value."
            )
        return place[key]

    prismatic: set[int] = set()
    for name, chain in of_chain.items():
        arm, numbers = arms[name], []
        if chain[0] != first:
            base = as_transform((bases or {}).get(name, np.zeros(3)), f"the base of '{name}'")
            for i, row in enumerate(mount_rows(base)):
                numbers.append(number_of(f"{chain[0]} < {i}", row, chain[0]))
                fixed.append(numbers[-1])
        reach = joint_limits(arm, None).tolist()
        for i, (joint, row) in enumerate(zip(chain, _rows_of(arm), strict=True)):
            branches = len(after[joint]) > 1
            numbers.append(number_of(joint, np.zeros(5) if branches else row, joint, reach[i]))
            if i + 1 in arm.prismatic:
                prismatic.add(numbers[-1])
            if branches:
                following = chain[i + 1] if i + 1 < len(chain) else f"\0{name}"
                numbers.append(number_of(f"{joint} > {following}", row, joint))
                fixed.append(numbers[-1])
        chains[name] = numbers
    for joint, (source, *_) in (mimic or {}).items():
        for other in (joint, source):
            if other not in place:
                raise InputError(
                    f"'{joint}' mimics '{source}', but the robot has no joint '{other}'; correct the name."
                )
    values = dict(zip(_ROW, np.array(rows).T, strict=True))
    if not np.any(values["beta"]) and all(arm.beta is None for arm in arms.values()) and not any(map(_is_mount, place)):
        del values["beta"]
    loads = [arm.probe if arm.load_centre is None else arm.load_centre for arm in arms.values()]
    return Arm(
        **values,
        probe=np.concatenate([np.asarray(arm.probe) for arm in arms.values()]),
        load_centre=None if all(arm.load_centre is None for arm in arms.values()) else np.concatenate(loads),
        limits=limits,
        prismatic=prismatic,
        fixed=fixed,
        mimic=[(place[name], place[source], factor, zero) for name, (source, factor, zero) in (mimic or {}).items()],
        chains=chains,
    )


def _is_mount(key: str) -> bool:
    return " < " in key


def as_transform(value: Numbers, what: str) -> Transform:
    """A transform ``(4, 4)``, or one of a position; `InputError` where it is neither."""
    array = np.asarray(as_floats(value, what))
    transform = np.eye(4)
    if array.shape == (3,):
        transform[:3, 3] = array
        return transform
    turn = array[:3, :3] if array.shape == (4, 4) else np.zeros((3, 3))
    if not (np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) and np.linalg.det(turn) > 0):
        raise InputError(f"{what} must be a position (3) or a rigid transform (4, 4), mm.")
    return array


def mount_rows(base: Transform) -> list[tuple[float, ...]]:
    """theta, d, a, alpha and beta of the three fixed joints that carry a base."""
    turn = (rotation(2, -math.pi / 2) @ base)[:3, :3]  # Rx(alpha) Ry(beta) Rz(theta)
    level = math.hypot(turn[0, 0], turn[0, 1])  # 0 with the axis along y, where alpha and theta turn about one line
    alpha = math.atan2(-turn[1, 2], turn[2, 2]) if level > 1e-9 else 0.0
    rest = rotation(0, -alpha)[:3, :3] @ turn  # theta from it, as near this line alpha is not exact
    beta, theta = math.atan2(rest[0, 2], rest[2, 2]), math.atan2(rest[1, 0], rest[1, 1])
    x, y, z = base[:3, 3]
    return [(0.0, z, x, 0.0, 0.0), (math.pi / 2, 0.0, y, alpha, beta), (theta, 0.0, 0.0, 0.0, 0.0)]


def mount_names(chain: ChainOf) -> list[str]:
    """The six parameters of the robot that say where the base of a chain is; none of the robot's own base."""
    free = zip(chain.mount, _MOUNT, strict=True) if chain.mount else ()
    return [f"{kind}_{joint}" for joint, kinds in free for kind in kinds]


def base_derivatives(robot: Arm, chain: ChainOf, names: Sequence[str]) -> Float[np.ndarray, "6 p"]:
    """How the base of a chain moves with parameters of the robot: its position, and a small rotation about the axes of
    the robot's base; mm and rad."""
    derivatives = np.zeros((6, len(names)))
    own = mount_names(chain)
    for place in (place for place, name in enumerate(names) if name in own):
        ends = []
        for step in (_STEP, -_STEP):
            moved = robot.replace(**{names[place]: value_of(robot, names[place]) + step})
            ends.append(_product(_rows_of(moved), chain.mount))
        turn = (ends[0][:3, :3] - ends[1][:3, :3]) @ chain.base[:3, :3].T / (2 * _STEP)
        derivatives[:3, place] = (ends[0][:3, 3] - ends[1][:3, 3]) / (2 * _STEP)
        derivatives[3:, place] = turn[2, 1], turn[0, 2], turn[1, 0]
    return derivatives


def _product(rows: Float[np.ndarray, "n 5"], joints: Sequence[int]) -> Transform:
    """The transform of fixed joints, from 1."""
    return reduce(np.matmul, [dh_link(*rows[joint - 1]) for joint in joints], np.eye(4))


def with_bases(robot: Arm, bases: Mapping[str, Transform]) -> Arm:
    """The robot with the bases of some chains elsewhere, in the base of the robot."""
    chains = chains_of(robot)
    for name, base in bases.items():
        chain = chains[name] if name in chains else chain_of(robot, name)
        if not chain.mount:
            raise InputError(f"chain '{name}' stands on the base of the robot, which does not move.")
        rows = zip(chain.mount, mount_rows(base), strict=True)
        robot = robot.replace(
            **{f"{kind}_{joint}": x for joint, row in rows for kind, x in zip(_ROW, row, strict=True)}
        )
    return robot


def with_chain(robot: Arm, name: str, arm: Arm) -> Arm:
    """The robot with the parameters of a chain from the arm that `chain_of` gave, changed."""
    chain = chain_of(robot, name)
    pairs = [(chain.names[own], value_of(arm, own), value_of(chain.arm, own)) for own in chain.names]
    return robot.replace(**{name: value_of(robot, name) + new - old for name, new, old in pairs if new != old})


def default_names(robot: Arm) -> tuple[str, ...]:
    """The free parameters of a robot where nothing is said: those of each chain that `plain_held` leaves, once, with
    one base for the whole robot, and those of the bases of other chains."""
    held: set[str] = set()
    free: set[str] = set()
    seen: set[int] = set()
    for chain in chains_of(robot).values():
        arm = chain.arm
        gauges = [i for i in arm.prismatic if chain.joints[i - 1] not in seen]
        fixed = plain_held(arm, base=chain.number == 0 or bool(chain.mount), slides=gauges)
        own = [parameter for parameter in parameter_names(arm) if not parameter.startswith("beta_")]
        held |= {chain.names[parameter] for parameter in own if parameter in fixed}
        free |= {chain.names[parameter] for parameter in own} | set(mount_names(chain))
        seen |= set(chain.joints)
    return tuple(name for name in parameter_names(robot) if name in free - held)


def plain_held(arm: Arm, *, base: bool = True, slides: Iterable[int] | None = None) -> set[str]:
    """The parameters that `Parameters.free_of` holds: of the ``base``, of prismatic joints, and of the last link."""
    n, prismatic = arm.joints, arm.prismatic if slides is None else tuple(slides)
    held = {f"a_{n}", f"alpha_{n}", "probe_x", "probe_y"} | ({"theta_1", "d_1"} if base else set())
    held |= {f"a_{i}" for i in prismatic} | {f"d_{i + 1}" for i in prismatic if i < n}
    return held | ({f"theta_{n}", "probe_z"} if n in prismatic else set())
