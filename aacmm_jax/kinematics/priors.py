"""What is known of an arm's parameters before anything is measured: Gaussian priors, of single parameters or groups."""

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Annotated, Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..core.arguments import ANY_NUMBER, Range, checked, checked_arguments, items_of
from ..core.arrays import Numbers, is_concrete
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace, set_at, to_numpy
from .arm import Arm, correction_names, is_length, natural_steps, parameter_names
from .correction_kinds import Harmonics
from .corrections import KINDS, coefficient_of, unit_of_coefficient

MIXED = "mm and mrad"
LEAST_STEPS = 1e-4  # smallest learned standard deviation, in natural steps: 0.1 um, 0.02 arcsec
_BROAD = 10.0  # standard deviation at which the search for a learned one begins, in natural steps
_Deviation = Annotated[Float[Array, ""], ANY_NUMBER, Range(above=0, infinite=True)]


class Prior(eqx.Module):
    """Gaussian priors of parameters: a mean and a standard deviation, as a maker states a nominal value and tolerance.

    A group is "all", "lengths", "angles", a kind of joint correction as a model names it ("gravity", "gear", "coupled",
    "harmonics", or orders of these: "harmonics=2-3"), a kind ("alpha", "probe"), the name of a parameter ("d_3"), or a
    shell pattern of names ("theta_*"). Of several groups that hold a parameter its name comes before a kind or pattern,
    these before "harmonics" and its like, these before "lengths" and "angles", and "all" is last; of equals, the last
    given counts. Fixed parameters need no prior, and are left out. Standard deviations are in mm or rad (of joint
    corrections, in the unit of their coefficients); of a group that holds lengths and angles they count in 1 mm and
    1 mrad.

    A *learned* standard deviation is the one for which the measurement itself is most probable (the evidence, MacKay
    1992; Bishop 2006, section 3.5), one for each group. A group in which the data support no deviation from its mean
    gets the least, 0.1 um or 0.1 urad, with which it stays there. Where ``sd`` names a learned group, its standard
    deviation is *expected* to be about that, to a factor of 4.5 (the log of the variance has the standard deviation 3):
    this keeps groups apart of which the data hardly tell which one acts. `InputError` where no group is given, or a
    standard deviation or mean is no such number.

    Args:
        sd: standard deviation by group, mm or rad, positive; infinite where nothing is known; of a learned group, what
            is expected.
        mean: mean by parameter or group, mm or rad; by default the nominal arm's value.
        learn: groups whose standard deviation is learned, whether or not ``sd`` names them; True for all that ``sd``
            names, or, without ``sd``, for lengths and angles.

    Example:
        >>> tolerances = aj.Prior({"lengths": 0.5, "angles": 0.001, "d_3": 0.1})
        >>> joint = aj.calibrate(arm, capture, bounds, method="joint", prior=tolerances)
        >>> print(joint.stage1.prior_metrics.groups)
        ('lengths', 'angles', 'd_3')
    """

    groups: tuple[str, ...] = eqx.field(static=True)
    learned: tuple[bool, ...] = eqx.field(static=True)
    sd: dict[str, Float[AnyArray, ""]]  # of the groups of which something is known
    mean: dict[str, Float[AnyArray, ""]]

    def __init__(
        self,
        sd: Mapping[str, Numbers] | None = None,
        *,
        mean: Mapping[str, Numbers] | None = None,
        learn: bool | Iterable[str] = False,
    ):
        given: dict[str, Any] = checked(sd or {}, Mapping[str, _Deviation], "sd")
        if isinstance(learn, bool):
            chosen = [*(given or ("lengths", "angles"))] if learn else []
        else:
            chosen = [learn] if isinstance(learn, str) else items_of(learn, "learn")
        self.groups = tuple(dict.fromkeys([*given, *chosen]))
        if not self.groups or not all(isinstance(group, str) and group for group in self.groups):
            raise InputError("a prior needs the names of groups; give at least one, such as Prior({'lengths': 0.5}).")
        self.learned = tuple(group in chosen for group in self.groups)
        self.sd = {group: sd for group, sd in given.items() if not (is_concrete(sd) and np.isposinf(np.asarray(sd)))}
        self.mean = checked(mean or {}, Mapping[str, Float[Array, ""]], "mean")

    def check(self, arm: Arm) -> None:
        """Raise `InputError` for a group that holds no parameter of an arm."""
        names = possible_names(arm)
        for group in (*self.groups, *self.mean):
            if not any(is_of_group(group, name) for name in names):
                corrections = (kind for kind in KINDS if any(is_of_group(kind, name) for name in names))
                stems = (name.rsplit("_", 1)[0] for name in names)
                hint = nearest(group, dict.fromkeys(["all", "lengths", "angles", *corrections, *stems, *names]))
                raise InputError(f"the prior names '{group}', but the arm has no such parameter{hint}")

    def of(self, names: tuple[str, ...], nominal: Float[AnyArray, " p"]) -> "ParameterPrior | None":
        """The prior of the named parameters, mm and rad; None where none of them has one."""
        given, nominal = to_numpy((self, nominal))
        xp, steps = namespace(given, nominal), natural_steps(names)
        # Each parameter belongs to the closest of the groups that hold it, and has its standard deviation.
        owners = [_owner(self.groups, name) for name in names]
        mean, sd, parts = xp.asarray(nominal), xp.asarray(_BROAD * steps), []
        for group, learned in zip(self.groups, self.learned, strict=True):
            indices, stated = tuple(i for i, owner in enumerate(owners) if owner == group), group in self.sd
            if not indices or not (learned or stated):
                continue
            unit, index = _unit([names[i] for i in indices]), np.array(indices)
            if stated:
                factors = steps[index] if unit == MIXED else np.ones(len(index))
                sd = set_at(sd, index, given.sd[group] * xp.asarray(factors))
            parts.append((group, learned, learned and stated, indices, unit))
        if not parts:
            return None
        for i, name in enumerate(names):
            owner = _owner(tuple(self.mean), name)
            if owner is not None:
                mean = set_at(mean, i, given.mean[owner])
        return ParameterPrior(mean, sd, *zip(*parts, strict=True))


class ParameterPrior(eqx.Module):
    """The prior of a vector of free parameters."""

    mean: Float[AnyArray, " p"]  # mm and rad
    sd: Float[AnyArray, " p"]  # that of learned groups before anything is learned; of no meaning without a prior
    groups: tuple[str, ...] = eqx.field(static=True)  # that hold free parameters
    learned: tuple[bool, ...] = eqx.field(static=True)
    expected: tuple[bool, ...] = eqx.field(static=True)  # learned, with ``sd`` as what is expected
    members: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of each group, indices of its parameters
    units: tuple[str, ...] = eqx.field(static=True)  # of each group's standard deviation

    @property
    def index(self) -> np.ndarray:
        """Indices of the parameters that have a prior, group after group."""
        return np.concatenate([np.array(indices, dtype=int) for indices in self.members])

    @property
    def membership(self) -> Float[np.ndarray, "g k"]:
        """1 where a parameter of ``index`` belongs to a group."""
        owner = np.repeat(np.arange(len(self.members)), [len(indices) for indices in self.members])
        return (owner[None, :] == np.arange(len(self.members))[:, None]).astype(float)


def is_of_group(group: str, name: str) -> bool:
    """Whether a group holds a parameter."""
    if group in ("lengths", "angles"):
        return is_length(name) == (group == "lengths")
    kind, _, option = group.partition("=")
    if kind in KINDS:  # all its coefficients, or those of the orders that an option names
        term = coefficient_of(name)
        if term is None or term.kind.model != kind:
            return False
        return not option or (kind == Harmonics.model and term.number in (Harmonics.orders_of(option) or ()))
    return group in ("all", name, name.rsplit("_", 1)[0]) or fnmatchcase(name, group)


def _owner(groups: tuple[str, ...], name: str) -> str | None:
    """The closest of the groups that hold a parameter; of equals, the last."""
    closeness = {name: 4, "all": 0, "lengths": 1, "angles": 1, **dict.fromkeys(KINDS, 2)}
    holders = [(closeness.get(group, 3), i) for i, group in enumerate(groups) if is_of_group(group, name)]
    return groups[max(holders)[1]] if holders else None


def possible_names(arm: Arm) -> tuple[str, ...]:
    """Names that a prior may have: every parameter of an arm, Hayati's beta too."""
    return tuple(dict.fromkeys([*parameter_names(arm), *(f"beta_{i + 1}" for i in range(arm.joints))]))


def unit_of_group(group: str, names: Iterable[str]) -> str:
    """The unit of a group's standard deviation: "mm", "rad", `MIXED`, or that of coefficients of one kind."""
    return _unit([name for name in names if is_of_group(group, name)])


def _unit(names: list[str]) -> str:
    units, lengths = {unit_of_coefficient(name) for name in names}, {is_length(name) for name in names}
    if len(units) == 1 and "" not in units:
        return units.pop()
    return MIXED if len(lengths) == 2 else "mm" if True in lengths else "rad"


@checked_arguments
def default_prior(arm: Arm) -> Prior:
    """The prior with which an arm with joint corrections is calibrated where no other is given.

    Learned from the data, each expected to a factor of 4.5: lengths (1 mm), angles (1 mrad), gravity (1 mrad for links
    with levers of 1 m, or for 100 N m), gear and coupled (0.02 %), thermal expansion (20 um/(m K)), and one group for
    each octave of harmonics (0.05 mrad), of which all joints share one scale: the error of an encoder or a gear is a
    function whose harmonics fade with their order at a rate that is not known beforehand. A scale for each joint fails
    where a joint moves little, since high orders imitate anything there (`benchmarks/NOTES.md`).

    Args:
        arm: The nominal arm, with the corrections that are calibrated; the prior has the groups that it has.

    Example:
        >>> bending = aj.kinematics.with_corrections(aj.load_arm("ur10e"), "gravity,harmonics=1")
        >>> prior = aj.kinematics.default_prior(bending)
        >>> print(prior.groups)
        ('lengths', 'angles', 'gravity', 'harmonics=1')
    """
    terms = () if arm.corrections is None else arm.corrections.functions.terms
    usual: dict[str, float] = {}
    for model, kind in KINDS.items():
        usual |= kind.usual([term for term in terms if term.kind.model == model])
    for kind in KINDS.values():
        if kind.usual_of_slide is not None:
            # Coefficients of a slide are in mm, so that they cannot share a scale with those of joints that turn.
            usual |= {f"{word}*_{joint}": kind.usual_of_slide for joint in arm.prismatic for word in kind.words}
    names = correction_names(arm)
    groups = {group: sd for group, sd in usual.items() if any(is_of_group(group, name) for name in names)}
    return Prior({"lengths": 1.0, "angles": 1e-3} | groups, learn=True)
