"""The arm: a serial chain of joints in standard Denavit-Hartenberg form, with a probe on its last frame."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Annotated, Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from ..core.arguments import NOT_EMPTY, Range, checked, items_of
from ..core.arrays import Numbers, as_floats
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, in_chunks, namespace, numpy_if_known, to_jax, to_numpy
from .arm_names import AXES, LENGTHS, located, natural_steps, probe_names
from .arm_names import is_length as is_length
from .beside import COLUMNS, Beside
from .chain import Corrections, Geometry, JointKinds, tip_pose
from .jacobian import Indices, tip_jacobian, tip_position
from .joint_checks import Limits, checked_chains, checked_limits, checked_mimic, checked_readings
from .joint_checks import check_chain as check_chain
from .joint_checks import check_columns as check_columns
from .joint_checks import with_chains as with_chains

DOWN = (0.0, 0.0, -1.0)
JointLimits = Float[np.ndarray, "n 2"]
NEARLY_PARALLEL = 0.02  # |sin alpha|, about 1 degree, below which Denavit-Hartenberg parameters are nearly singular
_LOAD_CENTRES = Float[np.ndarray, " numbers"]
_BY_JOINT, _BY_TERM, _VECTOR = (Float[Array, shape] for shape in ("... joints", "... coefficients", "... 3"))
_LARGEST = 20_000  # configurations: up to here NumPy is sooner done than a compiler


class Arm(eqx.Module):
    """A serial arm with a probe; T = Rz(q + theta) Tz(d) Tx(a) Rx(alpha) [Ry(beta)] of each joint, revolute by default.

    A prismatic joint slides along its axis: T = Rz(theta) Tz(q + d) Tx(a) Rx(alpha) [Ry(beta)], with readings in mm.
    Every parameter is ``(..., n)`` for n joints; leading shapes are a batch of arms and broadcast against those of q.
    Source: Denavit and Hartenberg 1955; Cheng et al. 2018, eq. 1. `InputError` where shapes do not fit together, a
    value is not finite, or there is no joint of such a number.

    Args:
        alpha: Link twists ``(..., n)``, rad.
        a: Link lengths ``(..., n)``, mm.
        d: Link offsets ``(..., n)``, mm; of a prismatic joint, its zero offset.
        theta: Zero offsets of the joints ``(..., n)``, rad; by default 0. Of a prismatic joint, a constant angle.
        beta: Hayati and Mirmirani's (1985) angles for nearly parallel axes ``(..., n)``, rad; by default unused.
        probe: Tip in the last frame ``(..., 3)``, mm.
        limits: Lowest and highest reading of each joint, n pairs, rad, or mm of prismatic joints; not calibrated, but
            respected when poses are made.
        prismatic: Numbers of the prismatic joints, from 1: ``(1,)`` for an arm on a linear axis.
        coefficients: Of the corrections' functions ``(..., k)``; by default 0.
        gravity: Direction of gravity in the base frame ``(..., 3)``, for corrections by its moments; by default down.
        corrections: What joints do besides their readings; `kinematics.with_corrections` makes them.
        torques: Whether readings have n more columns after those of the joints: the torques of their drives, N m (N of
            prismatic joints), of which only corrections by torques make use. Not of an arm with a single joint.
        fixed: Numbers of joints that do not move, from 1: rigid links of a robot, before a branch or below a base.
            Their column of the readings is not used.
        mimic: Joints that follow another one: ``(joint, followed joint, factor, offset)``, numbers from 1, the offset
            in rad, or mm. Their column of the readings is not used.
        chains: Joints of each chain of a robot by name, from the base to the tip, numbers from 1. The column after
            those of the joints is then the number of the chain that a pose is of, from 0; joints of other chains do not
            matter for it. 1.004 is the frame after joint 4 instead of the tip of chain 1. ``probe`` has the tips of all
            chains in turn, ``(..., 3 c)``: ``probe_x`` of the first chain, ``probe2_x`` of the second.
        directions: Whether n more columns follow: 1 where the joint reached the pose with rising readings, -1 with
            falling ones, 0 where it is unknown; for backlash.
        load: Whether one more column follows: the mass of a load, kg, besides that of the arm and its tool; 0 where it
            is missing.
        load_centre: Centre of mass of the load in the last frame ``(3,)``, mm, as the probe is; by default the tip.
        thermometer: Whether readings have one more, last column: the temperature of the arm, C, of which only thermal
            expansion makes use. Where it is missing, the arm is taken to be at 20 C.

    Example:
        >>> two_joints = aj.Arm(alpha=[0.0, 0.0], a=[300.0, 200.0], d=[0.0, 0.0], probe=(0.0, 0.0, 50.0))
        >>> print(two_joints.position([0.0, np.pi / 2]))
        [300. 200.  50.]
        >>> print(two_joints.pose(np.zeros((100, 2))).shape)
        (100, 4, 4)
    """

    alpha: Float[AnyArray, "... n"]
    a: Float[AnyArray, "... n"]
    d: Float[AnyArray, "... n"]
    theta: Float[AnyArray, "... n"]
    beta: Float[AnyArray, "... n"] | None
    probe: Float[AnyArray, "... 3"]
    limits: tuple[tuple[float, float], ...] | None = eqx.field(static=True)
    prismatic: tuple[int, ...] = eqx.field(static=True)
    coefficients: Float[AnyArray, "... k"] | None
    gravity: Float[AnyArray, "... 3"] | None
    corrections: Corrections | None
    recorded: tuple[str, ...] = eqx.field(static=True)  # which of `beside.COLUMNS` readings are stated to have
    fixed: tuple[int, ...] = eqx.field(static=True)
    mimic: tuple[tuple[int, int, float, float], ...] = eqx.field(static=True)
    chains: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)
    load_centre: tuple[float, ...] | None = eqx.field(static=True)  # of each chain

    def __init__(
        self,
        *,
        alpha: Numbers,
        a: Numbers,
        d: Numbers,
        theta: Numbers | None = None,
        beta: Numbers | None = None,
        probe: Numbers = (0.0, 0.0, 0.0),
        limits: Limits | None = None,
        prismatic: Iterable[int] = (),
        coefficients: Numbers | None = None,
        gravity: Numbers | None = None,
        corrections: Corrections | None = None,
        torques: bool = False,
        directions: bool = False,
        load: bool = False,
        thermometer: bool = False,
        fixed: Iterable[int] = (),
        mimic: Iterable[tuple[int, int, float, float]] = (),
        chains: Mapping[str, Sequence[int]] | Iterable[tuple[str, Sequence[int]]] = (),
        load_centre: Numbers | None = None,
    ):
        sizes: dict[str, int] = {}
        self.alpha = checked(alpha, Annotated[_BY_JOINT, NOT_EMPTY], "alpha", sizes)
        self.a, self.d = checked(a, _BY_JOINT, "a", sizes), checked(d, _BY_JOINT, "d", sizes)
        self.theta = checked(np.zeros(self.alpha.shape) if theta is None else theta, _BY_JOINT, "theta", sizes)
        self.beta = None if beta is None else checked(beta, _BY_JOINT, "beta", sizes)
        self.chains = checked_chains(chains, self.joints)
        tips = probe if not self.chains or np.shape(probe) != (3,) else np.tile(probe, len(self.chains))
        self.probe = checked(tips, _tips_annotation(tips_of(self)), "probe")
        self.load_centre = None
        if load_centre is not None:
            centres = np.tile(load_centre, tips_of(self)) if np.shape(load_centre) == (3,) else load_centre
            sizes["numbers"] = 3 * tips_of(self)
            self.load_centre = tuple(checked(centres, _LOAD_CENTRES, "load_centre", sizes).tolist())
        self.corrections, self.coefficients, self.gravity = corrections, None, None
        if corrections is not None:
            sizes["coefficients"] = len(corrections.functions.terms)
            given = np.zeros(sizes["coefficients"]) if coefficients is None else coefficients
            self.coefficients = checked(given, _BY_TERM, "coefficients", sizes)
            self.gravity = checked(DOWN if gravity is None else gravity, _VECTOR, "gravity")
        elif coefficients is not None or gravity is not None:
            raise InputError(
                "coefficients and gravity need an arm with corrections; create the arm with with_corrections()."
            )
        arrays = (self.alpha, self.a, self.d, self.theta, self.beta, self.probe, self.coefficients, self.gravity)
        batches = [array.shape[:-1] for array in arrays if array is not None]
        try:
            np.broadcast_shapes(*batches)
        except ValueError as error:
            shapes = ", ".join(map(str, batches))
            raise InputError(
                f"the parameters have the batch shapes {shapes}, which do not match; give all parameters the same "
                "batch shape."
            ) from error
        numbers = checked(prismatic, Sequence[Annotated[int, Range(1, self.joints)]], "prismatic")
        self.prismatic = tuple(sorted({int(number) for number in numbers}))
        self.fixed = tuple(sorted(set(checked(fixed, Sequence[Annotated[int, Range(1, self.joints)]], "fixed"))))
        self.mimic = checked_mimic(mimic, self.joints, self.fixed)
        self.limits = None if limits is None else checked_limits(limits, self.joints, self.prismatic, self.fixed)
        given = dict(zip(COLUMNS, (torques, directions, load, thermometer), strict=True))
        self.recorded = tuple(name for name in COLUMNS if given[name])
        if "torques" in self.beside.possible and self.joints == 1:
            raise InputError("torques need an arm with at least two joints; create the arm without torques.")

    @property
    def joints(self) -> int:
        """Number of joints, n."""
        return self.alpha.shape[-1]

    @property
    def beside(self) -> Beside:
        """Which columns readings may have after those of the joints: those stated, and those that corrections read."""
        read = () if self.corrections is None else self.corrections.functions.columns
        possible = tuple(name for name in COLUMNS if name in read or name in self.recorded) if read else self.recorded
        return Beside(self.joints, self.recorded, possible, len(self.chains), self.load_centre)

    @property
    def columns(self) -> int:
        """Number of columns of readings, with everything that may be recorded beside the joints."""
        return self.beside.width(self.beside.possible)

    @property
    def possible_columns(self) -> tuple[int, ...]:
        """Numbers of columns that readings may have: what is recorded beside the joints may be missing."""
        return self.beside.widths

    @property
    def geometry(self) -> Geometry:
        """The parameters and the kinds of the joints, without the limits."""
        prismatic = self.prismatic  # read once: Equinox looks attributes up in Python
        kinds = None
        if prismatic or self.chains or self.fixed or self.mimic:
            still = tuple((i - 1, i - 1, 0.0, 0.0) for i in self.fixed)
            following = tuple((i - 1, source - 1, factor, zero) for i, source, factor, zero in self.mimic)
            chains = tuple(tuple(i - 1 for i in joints) for _, joints in self.chains)
            slides = tuple(i in prismatic for i in range(1, self.joints + 1))
            kinds = JointKinds(slides, (*following, *still), chains)
        corrected = (self.coefficients, self.gravity, self.corrections)
        beside = self.beside
        return Geometry(
            *(self.alpha, self.a, self.d, self.theta, self.beta, self.probe, kinds, *corrected),
            beside=beside if beside.possible or beside.chains else None,
        )

    def position(self, q: Numbers) -> Float[AnyArray, "... 3"]:
        """Tip in the base frame, mm, at readings q, rad, or mm of prismatic joints: ``(..., n) -> (..., 3)``."""
        return _evaluated(tip_position, self, q)

    def pose(self, q: Numbers) -> Float[AnyArray, "... 4 4"]:
        """Homogeneous transform of the last frame, with the tip (mm) as its origin: ``(..., n) -> (..., 4, 4)``."""
        return _evaluated(tip_pose, self, q)

    def jacobian(self, q: Numbers, names: Sequence[str] | None = None) -> Float[AnyArray, "... 3 p"]:
        """Exact derivative of the tip by named parameters: analytic, equal to ``jax.jacfwd`` to rounding.

        ``(..., n) -> (..., 3, p)``, mm per mm or mm per rad. ``names`` are parameters (``alpha_1`` ... ``probe_z``) or
        joint readings ``q_1`` ... ``q_n``, or one of them; by default all, in the order of `parameter_names`.
        `InputError` where a name is unknown, or q has another number of joints.
        """
        names = parameter_names(self) if names is None else (names,) if isinstance(names, str) else names
        joints, corrections = self.joints, correction_names(self)
        names = items_of(names, "names")
        indices = tuple(located(joints, corrections, name, tips_of(self), extra=("q",)) for name in names)
        return _evaluated(partial(tip_jacobian, indices=indices), self, q)

    def replace(self, **changes: Any) -> "Arm":
        """The same arm with some values replaced, checked as a new arm is; also on traced values.

        By parameter name (``d_3=750.0``), or a whole argument of the constructor (``probe=(0, 0, 131)``); mm and rad. A
        single parameter is set after whole arguments.
        """
        whole = [field.name for field in dataclasses.fields(self) if field.name != "recorded"]
        arguments: dict[str, Any] = {name: changes.pop(name, getattr(self, name)) for name in whole}
        arguments |= {name: changes.pop(name, name in self.recorded) for name in COLUMNS}
        for name, value in changes.items():
            kind, i = locate(self, name)
            array = np.zeros(self.alpha.shape) if arguments[kind] is None else as_floats(arguments[kind], kind)
            array, value = to_numpy((array, as_floats(math.nan if value is None else value, name)))
            arguments[kind] = namespace(array, value).where(np.arange(array.shape[-1]) == i, value[..., None], array)
        return Arm(**arguments)


def _evaluated(function: Callable, arm: Arm, q: Numbers) -> Any:
    """A function of the geometry and q: by NumPy, which compiles nothing, for a moderate number of known values."""
    geometry = arm.geometry
    in_numpy = to_numpy(geometry)
    q = checked_readings(arm, q, like=in_numpy.alpha)
    shape = np.broadcast_shapes(q.shape[:-1], *(leaf.shape[:-1] for leaf in jax.tree.leaves(geometry)))
    if math.prod(shape) > _LARGEST:
        return function(geometry, q)
    values = function(*to_numpy((in_numpy, q)))
    return values if namespace(geometry, q) is np else to_jax(values)


def joint_limits(arm: Arm, limits: Limits | None) -> JointLimits:
    """Lowest and highest reading of each joint: those given, else the arm's own, else -pi to pi; rad, or mm.
    `InputError` where a prismatic joint has neither."""
    rows = limits if limits is not None else arm.limits
    if rows is None:
        if arm.prismatic:
            raise InputError(
                f"joint {arm.prismatic[0]} is prismatic, but the arm has no joint limits, so the travel of this joint "
                "is not known; give the limits (limits=, or limits in the file of the arm)."
            )
        rows = [(-math.pi, math.pi)] * arm.joints
    return np.asarray(checked_limits(rows, arm.joints, arm.prismatic, arm.fixed))


def arm_of(geometry: Geometry, limits: Limits | None = None) -> Arm:
    """The arm of a geometry."""
    kinds, facts = geometry.kinds, {}
    if kinds is not None:
        facts = {
            "prismatic": [i for i, slides in enumerate(kinds.prismatic, start=1) if slides],
            "fixed": [i + 1 for i, source, _, _ in kinds.followers if i == source],
            "mimic": [(i + 1, source + 1, *rest) for i, source, *rest in kinds.followers if i != source],
            "chains": [(str(c), [i + 1 for i in joints]) for c, joints in enumerate(kinds.chains, start=1)],
        }
    arrays = {name: value for name, value in geometry._asdict().items() if name not in ("kinds", "beside")}
    arm = Arm(**arrays, limits=limits, **facts)
    beside = geometry.beside
    return arm if beside is None else reading_as(arm, beside.recorded).replace(load_centre=beside.load_centre)


def by_joint(arm: Arm, angular: Any, linear: Any) -> list[Any]:
    """One of two values for each joint: that of revolute joints, or that of prismatic ones."""
    prismatic = arm.prismatic
    return [linear if i in prismatic else angular for i in range(1, arm.joints + 1)]


def readings_unit(arm: Arm) -> str:
    """The unit of an array of readings of an arm, in words."""
    return "rad, mm of prismatic joints" if arm.prismatic else "rad"


def reading_as(arm: Arm, recorded: Iterable[str]) -> Arm:
    """The same arm, whose readings have exactly these of `beside.COLUMNS`, and what its corrections read."""
    recorded = tuple(recorded)
    return arm.replace(**{name: name in recorded for name in COLUMNS})


def is_single(arm: Arm) -> bool:
    """Whether this is one arm and not a batch."""
    return all(array.ndim == 1 for array in jax.tree.leaves(arm.geometry))


def without_corrections(arm: Arm) -> Arm:
    """The arm whose joints do what they read; its readings may have the columns that its corrections read."""
    return reading_as(arm.replace(coefficients=None, gravity=None, corrections=None), arm.beside.possible)


def parameter_names(arm: Arm) -> tuple[str, ...]:
    """All parameter names of an arm: alpha, a, d, theta, (beta,) by joint from 1, then probe_x, probe_y, probe_z, and
    those of its corrections.

    Args:
        arm: One arm, or a batch of them.

    Example:
        >>> print(aj.kinematics.parameter_names(arm)[:7])
        ('alpha_1', 'alpha_2', 'alpha_3', 'alpha_4', 'alpha_5', 'alpha_6', 'a_1')
    """
    kinds, numbers = ("alpha", "a", "d", "theta") + (() if arm.beta is None else ("beta",)), range(1, arm.joints + 1)
    of_joints = [f"{kind}_{i}" for kind in kinds for i in numbers]
    return (*of_joints, *probe_names(tips_of(arm)), *correction_names(arm))


@lru_cache
def _tips_annotation(tips: int) -> Any:
    return Float[Array, f"... {3 * tips}"]


def one_chain(arm: Arm, what: str) -> Arm:
    """The same arm; raises `InputError` for a robot of several chains, where ``what`` is for a single one."""
    if arm.chains:
        names = ", ".join(f"'{name}'" for name, _ in arm.chains)
        raise InputError(
            f"{what} is for a single chain, but the robot has the chains {names}; choose one (--chain, or "
            "tip= or --tip of a URDF, or kinematics.chain_of)."
        )
    return arm


def tips_of(arm: Arm) -> int:
    """Number of tips: one, or one of each chain of a robot."""
    return max(1, len(arm.chains))


def correction_names(arm: Arm) -> tuple[str, ...]:
    """Names of the coefficients of an arm's corrections, and of the components of gravity where some depend on it."""
    corrections = arm.corrections
    if corrections is None:
        return ()
    functions = corrections.functions
    return (*functions.names, *(f"gravity_{axis}" for axis in AXES if functions.by_gravity.any()))


def locate(arm: Arm, name: str) -> tuple[str, int]:
    """Kind and 0-based index of a parameter name: ``d_3 -> ("d", 2)``; an `InputError` names the nearest spelling."""
    return located(arm.joints, correction_names(arm), name, tips_of(arm))


def parameter_unit(arm: Arm, name: str) -> str:
    """Unit of a parameter: mm, rad, or of a correction's coefficient its own; "1" of a pure number."""
    kind, i = locate(arm, name)
    if kind == "coefficients" and arm.corrections is not None:
        term = arm.corrections.functions.terms[i]
        return term.unit.replace("rad", "mm") if term.joint in arm.prismatic else term.unit
    return "1" if kind == "gravity" else "mm" if kind in LENGTHS else "rad"


def value_of(arm: Arm, name: str) -> np.ndarray:
    """Value of a named parameter of a concrete arm, mm or rad, with the arm's batch axes."""
    # Read with NumPy: under jit even a constant arm's values become tracers once JAX computes with them.
    kind, i = locate(arm, name)
    return np.asarray(getattr(arm, kind))[..., i]


def jacobian_at(arm: Arm, q: Float[np.ndarray, "N n"], names: Sequence[str]) -> Float[np.ndarray, "N 3 p"]:
    """Derivatives of the tips by named parameters at N configurations."""
    return in_chunks(lambda rows: np.asarray(arm.jacobian(rows, names)), q)


@numpy_if_known
def with_values(
    geometry: Geometry, vector: Float[AnyArray, "... p"], indices: Indices
) -> dict[str, Float[AnyArray, "... n"]]:
    """The arrays, by kind, that change when the parameters at ``indices`` take the values of ``vector``."""
    changed = {}
    for kind in dict.fromkeys(kind for kind, _ in indices):
        before = getattr(geometry, kind)
        sources = np.arange(before.shape[-1])
        for position, (other, i) in enumerate(indices):
            if other == kind:
                sources[i] = before.shape[-1] + position
        batch, xp = np.broadcast_shapes(before.shape[:-1], vector.shape[:-1]), namespace(before, vector)
        both = xp.concatenate([xp.broadcast_to(x, (*batch, x.shape[-1])) for x in (before, vector)], axis=-1)
        # One gather from known positions: a third as many operations to trace and compile as a scatter.
        changed[kind] = both[..., sources] if xp is np else both.at[..., sources].get(mode="promise_in_bounds")
    return changed


def with_arrays(arm: Arm, **changes: AnyArray | None) -> Arm:
    """`Arm.replace` for whole arrays without its checks: in numerical code a diverged iteration may hold NaN."""
    kinds, is_none = tuple(changes), lambda value: value is None
    return eqx.tree_at(lambda arm: [getattr(arm, kind) for kind in kinds], arm, [*changes.values()], is_leaf=is_none)


def neighbouring_arm(arm: Arm, names: Sequence[str]) -> Arm:
    """The arm with the named parameters changed by about 1 mm and 1 mrad, so that nothing is exactly aligned."""
    steps = np.random.default_rng(0).normal(size=len(names)) * natural_steps(names)
    vector = np.array([value_of(arm, name) for name in names]) + steps
    arm = to_numpy(arm)
    return with_arrays(arm, **with_values(arm.geometry, vector, tuple(locate(arm, name) for name in names)))
