"""What is known of an arm's parameters before anything is measured: Gaussian priors, of single parameters or groups."""

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..core.arguments import items_of, shown
from ..core.arrays import Numbers, as_array, is_concrete
from ..core.errors import InputError, nearest
from ..core.numpy_or_jax import AnyArray, namespace, set_at, to_numpy
from .arm import Arm, is_length, natural_steps, parameter_names
from .corrections.harmonics import Harmonics, orders_of
from .corrections.kinds import all_kinds, coefficient_of, is_kind, unit_of_coefficient

_BROAD = 10.0  # standard deviation at which the search for a learned one begins, in natural steps
LEAST_STEPS = 1e-4  # smallest learned standard deviation, in natural steps: 0.1 um, 0.02 arcsec


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
    this keeps groups apart of which the data hardly tell which one acts.

    Args:
        sd: standard deviation by group, mm or rad, positive; infinite where nothing is known; of a learned group, what
            is expected.
        mean: mean by parameter or group, mm or rad; by default the nominal arm's value.
        learn: groups whose standard deviation is learned, whether or not ``sd`` names them; True for all that ``sd``
            names, or, without ``sd``, for lengths and angles.

    Raises:
        InputError: no group is given, or a standard deviation or mean is no such number.

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
        for what, given in (("sd", sd), ("mean", mean)):
            if given is not None and not isinstance(given, Mapping):
                raise InputError(f"{what} is {shown(given)}; give a dictionary, such as {{'lengths': 0.5}}.")
        given = {group: _number(value, f"the standard deviation of {group}") for group, value in (sd or {}).items()}
        if isinstance(learn, bool):
            chosen = [*(given or ("lengths", "angles"))] if learn else []
        else:
            chosen = [learn] if isinstance(learn, str) else items_of(learn, "learn")
        self.groups = tuple(dict.fromkeys([*given, *chosen]))
        if not self.groups or not all(isinstance(group, str) and group for group in self.groups):
            raise InputError("a prior needs the names of groups; give at least one, such as Prior({'lengths': 0.5}).")
        self.learned = tuple(group in chosen for group in self.groups)
        self.sd = {
            group: value
            for group, value in given.items()
            if not (is_concrete(value) and np.isposinf(np.asarray(value)))
        }
        self.mean = {group: _number(value, f"the mean of {group}") for group, value in (mean or {}).items()}
        for group, value in given.items():
            if is_concrete(value) and not float(value) > 0:
                raise InputError(
                    f"the standard deviation of {group} is {float(value):g}; it must be positive (fix a parameter that "
                    "is known exactly)."
                )
        for group, value in self.mean.items():
            if is_concrete(value) and not np.isfinite(float(value)):
                raise InputError(f"the mean of {group} is {float(value):g}; give a finite number.")

    def check(self, arm: Arm) -> None:
        """Raise `InputError` for a group that holds no parameter of an arm."""
        names = possible_names(arm)
        corrections = [kind.model for kind in all_kinds() if any(_is_correction(kind.model, name) for name in names)]
        for group in (*self.groups, *self.mean):
            if not any(is_of_group(group, name) for name in names):
                stems = dict.fromkeys(name.rsplit("_", 1)[0] for name in names)
                kinds = ("all", "lengths", "angles", *corrections, *stems, *names)
                raise InputError(f"the prior is of '{group}', and the arm has no such parameter{nearest(group, kinds)}")

    def of(self, names: tuple[str, ...], nominal: Float[AnyArray, " p"]) -> "ParameterPrior | None":
        """The prior of the named parameters, mm and rad; None where it says nothing of any of them."""
        given, nominal = to_numpy((self, nominal))
        xp, steps = namespace(given, nominal), natural_steps(names)
        owners = [_owner(self.groups, name) for name in names]
        mean, sd = xp.asarray(nominal), xp.asarray(_BROAD * steps)
        members, used = [], []
        for number, group in enumerate(self.groups):
            own = [i for i, owner in enumerate(owners) if owner == number]
            if own and (self.learned[number] or group in self.sd):
                members.append(tuple(own))
                used.append(number)
        if not members:
            return None
        means = tuple(self.mean)
        for i, name in enumerate(names):
            owner = _owner(means, name)
            if owner is not None:
                mean = set_at(mean, i, given.mean[means[owner]])
        for number, own in zip(used, members, strict=True):
            group = self.groups[number]
            if group in self.sd:
                index = np.array(own)
                mixed = _unit(names[i] for i in own) == MIXED
                sd = set_at(sd, index, given.sd[group] * xp.asarray(steps[index] if mixed else np.ones(len(own))))
        groups = tuple(self.groups[number] for number in used)
        learned = tuple(self.learned[number] for number in used)
        expected = tuple(self.learned[number] and self.groups[number] in self.sd for number in used)
        units = tuple(_unit(names[i] for i in own) for own in members)
        return ParameterPrior(mean, sd, groups, learned, expected, tuple(members), units)


MIXED = "mm and mrad"


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
        return np.array([i for own in self.members for i in own])

    @property
    def membership(self) -> Float[np.ndarray, "g k"]:
        """1 where a parameter of ``index`` belongs to a group."""
        owner = np.repeat(np.arange(len(self.members)), [len(own) for own in self.members])
        return (owner[None, :] == np.arange(len(self.members))[:, None]).astype(float)


def _number(value: Numbers, what: str) -> Float[AnyArray, ""]:
    number = as_array(value, what)
    if number.ndim:
        raise InputError(f"{what} has shape {number.shape}; give one number for the group.")
    if is_concrete(number) and np.isnan(np.asarray(number)):
        raise InputError(f"{what} is NaN; give a number.")
    return number


def is_of_group(group: str, name: str) -> bool:
    """Whether a group holds a parameter."""
    if group in ("lengths", "angles"):
        return is_length(name) == (group == "lengths")
    if is_kind(group.partition("=")[0]):
        return _is_correction(group, name)
    return group in ("all", name, name.rsplit("_", 1)[0]) or fnmatchcase(name, group)


def _is_correction(group: str, name: str) -> bool:
    """Whether a coefficient is of the kind of a group, and of its orders where it names some."""
    kind, _, option = group.partition("=")
    found = coefficient_of(name)
    if found is None or found.kind.model != kind:
        return False
    return not option or (kind == Harmonics.model and found.number in (orders_of(option) or ()))


def _owner(groups: tuple[str, ...], name: str) -> int | None:
    """Number of the group that a parameter belongs to."""
    found = [(_closeness(group, name), i) for i, group in enumerate(groups) if is_of_group(group, name)]
    return max(found)[1] if found else None


def _closeness(group: str, name: str) -> int:
    if is_kind(group.partition("=")[0]):
        return 3 if "=" in group else 2
    return {name: 4, "lengths": 1, "angles": 1, "all": 0}.get(group, 3)


def possible_names(arm: Arm) -> tuple[str, ...]:
    """Names that a prior may have: every parameter of an arm, Hayati's beta too."""
    return tuple(dict.fromkeys([*parameter_names(arm), *(f"beta_{i + 1}" for i in range(arm.joints))]))


def unit_of_group(group: str, names: Iterable[str]) -> str:
    """The unit of a group's standard deviation: "mm", "rad", `MIXED`, or that of coefficients of one kind."""
    return _unit(name for name in names if is_of_group(group, name))


def _unit(names: Iterable[str]) -> str:
    names = list(names)
    own = {unit_of_coefficient(name) for name in names}
    if len(own) == 1 and "" not in own:
        return own.pop()
    lengths = {is_length(name) for name in names}
    return MIXED if len(lengths) == 2 else "mm" if True in lengths else "rad"
