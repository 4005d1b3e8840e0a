"""Which parameters of an arm are free, within what bounds, and what the file of an arm proposes for both."""

import re
from collections.abc import Iterable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Annotated, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..core.arguments import NotNegative, Range, checked_arguments, checked_fields
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace, to_jax
from ..core.random_keys import random_key
from .arm import (
    Arm,
    correction_names,
    is_length,
    is_single,
    locate,
    located,
    natural_steps,
    parameter_names,
    tips_of,
    with_arrays,
    with_values,
)
from .chain import Geometry
from .independence import generic_poses, independent_names
from .inverse_kinematics import SocketPoses
from .jacobian import Indices
from .priors import Prior
from .robots import default_names, plain_held

_MJCF = re.compile(r"(?:[^<]++|(?><!--.*?-->)|(?><\?.*?\?>))*+<mujoco\b", re.DOTALL)
_HalfWidth = Annotated[float, Range(least=0, infinite=True)]


class Parameters(eqx.Module):
    """The free parameters of an arm, in order, and the arm that supplies the fixed ones.

    ``vector(arm)`` reads them into ``(p,)`` (mm and rad mixed); ``arm(vector)`` writes them back. An `InputError` names
    a parameter that is there twice, or that the arm does not have.

    Example:
        >>> some = aj.Parameters.free_of(arm, held=("d_1", "a_2"))
        >>> print(len(some.names), some.names[:3])
        25 ('alpha_1', 'alpha_2', 'alpha_3')
        >>> print(some.vector(true)[:3].round(4))
        [-1.5715 -1.5711 -1.5706]
        >>> print(some.arm(some.vector(true)).position(q).round(3))
        [  36.437  104.848 -111.66 ]
    """

    base: Arm  # from which fixed parameters are taken
    names: tuple[str, ...] = eqx.field(static=True)  # of the free ones; none where only geometry is identified

    def __check_init__(self):
        checked_fields(self)
        _unique_names(self.base, self.names, "names")

    @classmethod
    @checked_arguments
    def free_of(
        cls, arm: Arm, *, held: str | Iterable[str] | None = None, free: str | Iterable[str] = ()
    ) -> "Parameters":
        """Free parameters by name: by default the 4n - 3 of Cheng et al. 2018, in their order.

        These are all but ``d_1``, ``theta_1`` (they move the base frame), ``a_n``, ``alpha_n`` (redundant with the
        probe), ``probe_x`` and ``probe_y``. Of a prismatic joint i only the direction matters, since neighbouring links
        do not rotate against each other: three of the lengths about it say where the next axis is, and a_i and d_(i+1)
        are fixed too (``theta_n`` and ``probe_z`` for the last joint). Each prismatic joint leaves two parameters less
        (Everett and Hollerbach 1988). `InputError` where the arm has no such parameter, or one is named as held and as
        free.

        Args:
            arm: The arm; it supplies the values of the fixed parameters.
            held: Names of the fixed parameters, instead of those above; beta and the direction of
                gravity are fixed unless in ``free``.
            free: Names that are free in addition, beta and gravity included.
        """
        free = _unique_names(arm, free, "free")
        if held is None:
            usual = default_names(arm) if arm.chains else ()
            held = set(parameter_names(arm)) - set(usual) if arm.chains else plain_held(arm)
            free = tuple(dict.fromkeys((*free, *(name for name in usual if name.startswith("beta_")))))
            held = held - set(free)
        held = _unique_names(arm, held, "held")
        for name in free:
            if name in held:
                raise InputError(
                    f"parameter '{name}' is named both as held and as free; give the parameter in only one of the two."
                )
        if arm.beta is None and any(name.startswith("beta_") for name in (*held, *free)):
            arm = arm.replace(beta=jnp.zeros_like(arm.alpha))
        usual = [name for name in parameter_names(arm) if name in free or not name.startswith(("beta_", "gravity_"))]
        wanted = tuple(name for name in usual if name not in held)
        return cls(base=arm, names=wanted)

    @classmethod
    def independent(cls, arm: Arm, capture: SocketPoses | None = None) -> "Parameters":
        """A largest set of parameters that a capture determines well; redundant ones are fixed at their nominal values.

        Fixed too is one parameter of every near-degenerate combination (`independence`). For the paper's arm with a
        reference length these are its 21; without one, the longest link is fixed too. Where neighbouring axes are
        nearly parallel, d of the first is fixed and Hayati's beta is free instead. Observations besides sockets count
        as positions of the tip in an unknown frame, which is the most that spheres, planes and distances may say;
        `observability` tells what each kind determines. `InputError` where the capture has another number of joints, or
        determines nothing.

        Args:
            arm: The nominal arm.
            capture: The poses, reference lengths and other observations; by default poses over the whole workspace with
                one reference length.
        """
        base, names = independent_names(arm, generic_poses(arm) if capture is None else capture)
        if not names:
            raise InputError("the capture does not determine any parameter; record more poses in its sockets.")
        return cls(base=base, names=tuple(name for name in parameter_names(base) if name in names))

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the parameters that are not free."""
        return tuple(name for name in parameter_names(self.base) if name not in self.names)

    @property
    def lengths(self) -> np.ndarray:
        """Boolean mask ``(p,)``: which free parameters are lengths."""
        return np.array([is_length(name) for name in self.names])

    @property
    def scale(self) -> Float[AnyArray, " p"]:
        """Natural step of each free parameter ``(p,)``: 1 mm for a length, 1 mrad for an angle."""
        return namespace(self.base).asarray(natural_steps(self.names))

    def indices(self) -> Indices:
        """Kind and 0-based index of each free parameter."""
        return _located(self.base.joints, correction_names(self.base), self.names, tips_of(self.base))

    def index(self, name: str) -> int:
        """Position of a free parameter in the vector; raises `InputError` if it is not free."""
        if name not in self.names:
            locate(self.base, name)
            raise InputError(
                f"parameter '{name}' is held, not free; free this parameter, or name a free parameter such as "
                f"'{self.names[0]}'."
            )
        return self.names.index(name)

    def vector(self, arm: Arm | None = None) -> Float[AnyArray, "... p"]:
        """The free parameters of an arm (default: the base arm) as ``(..., p)``, mm and rad; `InputError` where it has
        another number of joints."""
        arm = self.base if arm is None else arm
        if arm.joints != self.base.joints:
            raise InputError(
                f"the arm has {arm.joints} joints, but these are parameters of an arm with {self.base.joints} "
                "joints; choose the free parameters of this arm (Parameters.free_of)."
            )
        # Where values are known by NumPy, since every operation of JAX outside jit is a program to compile.
        tools: Any = np if is_concrete(*jax.tree.leaves(arm.geometry)) else jnp
        kinds = {kind: getattr(arm, kind) for kind, _ in self.indices()}
        values = {kind: tools.asarray(0.0 * arm.alpha if array is None else array) for kind, array in kinds.items()}
        rows = tools.broadcast_arrays(*(values[kind][..., i] for kind, i in self.indices()))
        vector = tools.stack(rows, axis=-1) if rows else tools.zeros((*arm.alpha.shape[:-1], 0))
        return vector if namespace(arm) is np else to_jax(vector)

    def arm(self, vector: Numbers) -> Arm:
        """The base arm with its free parameters taken from ``(..., p)`` values in the order of ``names``, mm and rad;
        leading axes give a batch of arms. `InputError` where there are not p values."""
        geometry = self.geometry(self.checked_vector(vector, "vector"))
        return with_arrays(self.base, **{kind: getattr(geometry, kind) for kind, _ in self.indices()})

    def checked_vector(self, vector: Numbers, what: str) -> Float[AnyArray, "... p"]:
        """Values of the free parameters as an array, or `InputError`; NaN passes, as of an iteration that diverged."""
        array = as_array(vector, what, like=self.base)
        if array.shape[-1:] != (len(self.names),):
            raise InputError(
                f"{what} has shape {array.shape}, but {len(self.names)} parameters are free; give one value per "
                "free parameter."
            )
        return array

    def geometry(self, vector: Float[AnyArray, "... p"]) -> Geometry:
        """The geometry of ``arm(vector)``, unchecked: what an iteration evaluates."""
        base, indices = self.base.geometry, self.indices()
        if base.beta is None and any(kind == "beta" for kind, _ in indices):
            base = base._replace(beta=0.0 * base.alpha)
        return base._replace(**with_values(base, vector, indices))


@lru_cache(maxsize=256)
def _located(joints: int, corrections: tuple[str, ...], names: tuple[str, ...], tips: int) -> Indices:
    return tuple(located(joints, corrections, name, tips) for name in names)


def _unique_names(arm: Arm, names: Iterable[str], what: str) -> tuple[str, ...]:
    names = (names,) if isinstance(names, str) else tuple(names)
    _located(arm.joints, correction_names(arm), names, tips_of(arm))
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"parameter '{name}' is given twice in {what}; give each parameter once.")
    return names


def based_on(space: Parameters, arm: Arm) -> Parameters:
    """The free parameters with the fixed values of the arm that is calibrated, and not of the space's base."""
    if arm.beta is None and space.base.beta is not None:
        arm = arm.replace(beta=jnp.zeros_like(arm.alpha))
    return Parameters(base=arm, names=space.names)


class Bounds(eqx.Module):
    """Bounds of the free parameters; `InputError` where a lower bound is above its upper one, or shapes do not fit.

    Example:
        >>> box = aj.Bounds.around(arm, space, length=5.0, angle=0.01, override={"probe_z": 60.0})
        >>> half = (box.upper - box.lower) / 2
        >>> print(space.names[0], half[0].round(3), "rad;", space.names[-1], half[-1].round(3), "mm")
        alpha_1 0.01 rad; probe_z 60.0 mm
    """

    space: Parameters
    lower: Float[AnyArray, " p"]  # mm and rad; may be infinite
    upper: Float[AnyArray, " p"]

    @checked_arguments
    def __init__(self, space: Parameters, lower: Numbers, upper: Numbers):
        self.space = space
        self.lower, self.upper = space.checked_vector(lower, "lower"), space.checked_vector(upper, "upper")
        if is_concrete(self.lower, self.upper):
            low, high = np.broadcast_arrays(np.asarray(self.lower), np.asarray(self.upper))
            for index in np.argwhere(~(low <= high))[:1]:  # also where one is NaN
                at = tuple(index)
                raise InputError(
                    f"bounds of {space.names[at[-1]]} are {low[at]:g} to {high[at]:g}; both bounds must be numbers, "
                    "with the lower bound not above the upper bound."
                )

    @classmethod
    @checked_arguments
    def around(
        cls,
        arm: Arm,
        space: Parameters,
        *,
        length: _HalfWidth = 10.0,
        angle: _HalfWidth = 0.0175,
        override: Mapping[str, _HalfWidth] | None = None,
    ) -> "Bounds":
        """A box centred on an arm; the default half-widths are the paper's, 10 mm and about 1 degree.

        `InputError` where a half-width is negative, a name is not free, or the arm does not fit the parameters.

        Args:
            arm: The arm in the middle of the box, with as many joints as the space's.
            space: The free parameters.
            length: Half-width for lengths, mm.
            angle: Half-width for angles, rad.
            override: Half-widths of single parameters by name, mm or rad.
        """
        widths = np.where(space.lengths, float(length), float(angle))
        for name, width in (override or {}).items():
            widths[space.index(name)] = float(width)
        centre = space.vector(arm)
        centre = np.asarray(centre) if is_concrete(centre) else centre
        return cls(space, centre - widths, centre + widths)

    def active(self, vector: Float[AnyArray, "... p"]) -> Int[AnyArray, "... p"]:
        """Which parameters of ``(..., p)`` are on a bound: -1 on the lower, +1 on the upper, 0 inside."""
        xp = namespace(self.lower, vector)
        return xp.where(vector <= self.lower, -1, xp.where(vector >= self.upper, 1, 0))


@checked_arguments
def perturbed_arm(space: Parameters, *, length: NotNegative, angle: NotNegative, seed: int = 0) -> Arm:
    """The space's base arm with random errors of its free parameters, uniform and independent, as of manufacture.

    `InputError` where a largest error is negative or not finite.

    Args:
        space: The free parameters and their base arm.
        length: Largest error of a length, mm.
        angle: Largest error of an angle, rad.
        seed: Seed of the errors.

    Example:
        >>> as_built = aj.perturbed_arm(space, length=1.0, angle=0.001, seed=1)
        >>> print((as_built.a - arm.a).round(2))
        [ 0.51  0.06 -0.56 -0.04 -0.82  0.  ]
    """
    width = jnp.where(jnp.asarray(space.lengths), length, angle)
    shift = jax.random.uniform(random_key(seed), width.shape, jnp.float64, -1.0, 1.0)
    return space.arm(space.vector() + width * shift)


class UrdfSource(NamedTuple):
    """The URDF or MJCF that an arm was read from: what is needed to write one with the calibrated arm."""

    text: str  # the whole file, and what it includes
    base: str  # name of the link that does not move
    tips: tuple[str, ...]  # names of the links at the ends of the chains: one of an arm, several of a robot
    first: tuple[tuple[float, ...], ...] = ()  # the arm's first frame in the base link, 4 x 4, mm
    link: tuple[float, ...] = ()  # origin of the tip link in the last frame, mm; its axes are those of that frame
    follows: bool = False  # whether an export moves the tip link to the calibrated probe

    @property
    def tip(self) -> str:
        """The link at the end of the chain, of a robot of the first."""
        return self.tips[0]

    @property
    def links(self) -> dict[str, str | list[str]]:
        """``base`` and ``tip`` as files state them."""
        return {"base": self.base, "tip": list(self.tips) if self.tips[1:] else self.tip}

    @property
    def format(self) -> str:
        """``"URDF"`` or ``"MJCF"``, as the root element says."""
        return "MJCF" if _MJCF.match(self.text) else "URDF"


class ArmSpecification(NamedTuple):
    """An arm as a file states it, with the identification that the file proposes.

    Example:
        >>> specification = aj.kinematics.ArmSpecification(arm, "my arm", length=5.0, override={"probe_z": 60.0})
        >>> space, bounds = specification.space(), specification.bounds()
        >>> print(specification.name, len(space.names), bounds.upper[-1] - arm.probe[2])
        my arm 21 60.0
    """

    arm: Arm  # the nominal one
    name: str = ""  # what people call it
    held: tuple[str, ...] | None = None  # names of the fixed parameters; None for the default of `Parameters.free_of`
    length: float = 10.0  # half-width of the bounds of lengths, mm
    angle: float = 0.0175  # half-width of the bounds of angles, rad
    override: Mapping[str, float] = MappingProxyType({})  # half-widths of single parameters by name, mm or rad
    free: tuple[str, ...] = ()  # names that are free in addition, such as Hayati's ``beta_2``
    urdf: UrdfSource | None = None  # that the arm was read from; None for others
    prior: Prior | None = None  # of the parameters; None where the file states none
    stated: tuple[str, ...] = ()  # "parameters", "bounds": those that a person chose, which no default changes

    def space(self) -> Parameters:
        """The free parameters that the file proposes."""
        return Parameters.free_of(self.arm, held=self.held, free=self.free)

    def bounds(self) -> Bounds:
        """The bounds that the file proposes."""
        return Bounds.around(self.arm, self.space(), length=self.length, angle=self.angle, override=self.override)


def single(arm: Arm) -> Arm:
    """The same arm; raises `InputError` for a batch of arms, since a file holds one."""
    if not is_single(arm):
        raise InputError("a file contains one arm, but this is a batch; select one arm of the batch.")
    return arm


def with_tool(arm: Arm, tool: Numbers) -> Arm:
    """The same arm with a tool at its tip, or at all tips of a robot, in the frame of the last joint, mm."""
    checked = Arm(alpha=[0.0], a=[0.0], d=[0.0], probe=tool).probe
    return arm.replace(probe=np.asarray(arm.probe) + np.resize(checked, np.shape(arm.probe)))
