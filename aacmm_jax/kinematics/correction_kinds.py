"""What joints do besides their Denavit-Hartenberg motion: the kinds of corrections.

Each coefficient multiplies a known function of the readings (`chain`). A new kind is one class here, added to `KINDS`
of `corrections`, or one of a user's own (`register_correction`): whatever else the package does with kinds follows from
these classes.
"""

import abc
import functools
import operator
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.numpy_or_jax import AnyArray, namespace
from ..core.rotations import cross
from .beside import Readings
from .chain import ForwardPass, frame_axes, last_joints

REFERENCE_TEMPERATURE = 20.0  # C, by ISO 1
_HIGHEST = 99  # order of a harmonic
STANDARD_GRAVITY = 9.80665  # m/s^2, by definition
_METRE = 1e-3  # m/mm
KILO = 1e-3  # kN/N: with rad/(kN m), compliances are about as large as errors of angles
_MASSES = "masses"

Rows = Float[AnyArray, "rows ... 1 N"]


class Loads(NamedTuple):
    """What pulls at the arm, for functions of gravity."""

    mass: tuple[float, ...]  # of each link, kg
    centre: tuple[tuple[float, float, float], ...]  # of mass, in the link's own D-H frame, mm


class Sought(NamedTuple):
    """Functions of a kind that residuals are searched for, all those of one joint at once.

    Example:
        >>> sought = aj.kinematics.Sought("bow", "", "the square of q_{i}", "a bent scale")
        >>> print(sought.follows.format(i=2))
        the square of q_2
    """

    name: str  # what results call it: "first harmonic"
    option: str  # of the model with these functions: "1" of ``harmonics=1``
    follows: str  # what residuals follow then, of joint {i}: "cos q_{i}"
    cause: str  # what usually causes it, with its article: "an eccentric encoder"
    of_slides: bool = False  # whether prismatic joints have it as well
    relative: bool = False  # whether its size is the coefficient, a ratio, rather than what it adds over the poses
    rather: str = ""  # name of what is taken for the cause where that explains as much


@dataclass(frozen=True)
class AbstractCorrection(abc.ABC):
    """A kind of joint correction: coefficients, to be calibrated, times known functions of the readings.

    The sum of these products is added to the angle of a joint, rad, or of a prismatic joint to its position, mm. A
    kind has no data of its own: every two of a class are equal, and static in a program. A class states `model`,
    `words`, `description`, `unit`, `usual_size` and `values`; everything else has a default.

    Example:
        >>> class Bow(aj.kinematics.AbstractCorrection):
        ...     model, words, description = "bow", ("bow",), "bows of scales"
        ...     unit, usual_size = "1/rad", 1e-4
        ...
        ...     def values(self, terms, q, forward):
        ...         return q.joints[np.array([term.joint - 1 for term in terms])] ** 2
        >>> print([term.name for term in Bow().terms(3, "", None)])
        ['bow_1', 'bow_2', 'bow_3']
    """

    model: ClassVar[str]  # its name in ``--model dh,harmonics=1``: lowercase letters
    words: ClassVar[tuple[str, ...]]  # with which the names of its coefficients begin: lowercase letters
    description: ClassVar[str]  # what its coefficients are, in the plural: "errors of gear ratios"
    unit: ClassVar[str]  # of a coefficient: 1, rad (for a prismatic joint read as mm), mm, m, K and kN, as in 1/rad
    unit_alone: ClassVar[str] = ""  # where it differs: of a coefficient whose name has no number
    usual_size: ClassVar[float]  # about how large coefficients usually are, in this unit: expected by the default prior
    usual_of_slide: ClassVar[float | None] = None  # the same where a joint is prismatic, mm; None: as of others
    rows: ClassVar[int] = 1  # of `values`: 3 for a function of gravity, one for each component of its direction
    of_arm: ClassVar[bool] = False  # whether it scales all lengths of the arm: its terms are of joint 0
    of_own_reading: ClassVar[bool] = False  # whether each function is of its joint's reading alone, and can be drawn
    of_other_reading: ClassVar[bool] = False  # whether each function is the reading of the joint that `Term.number` is
    column: ClassVar[str] = ""  # recorded column that its functions read: torques, directions, load or thermometer
    of_masses: ClassVar[bool] = False  # whether functions without a number need the masses of the links
    has_options: ClassVar[bool] = False  # whether a model may state an option after =, as in ``harmonics=1-3``
    sought: ClassVar[tuple[Sought, ...]] = ()  # what residuals of a calibration without it are searched for
    shared: ClassVar[str | None] = None  # option of the functions that shared errors of poses may follow; None: none

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple["Term", ...]:
        """The terms of a model for an arm of so many joints; the option of ``harmonics=2`` is "2", by default empty."""
        return tuple(Term(self, self.words[0], 0, joint) for joint in range(1, joints + 1))

    def option_of(self, terms: Sequence["Term"]) -> str:
        """The option of the model that has these terms, and as few others as can be: the inverse of `terms`."""
        return ""

    def wrong(self, term: "Term", joints: int) -> str:
        """What is wrong with a term of this kind for an arm of so many joints, in a few words; empty if nothing is."""
        return "must have no number before the underscore" if term.number else ""

    def usual(self, terms: Sequence["Term"]) -> dict[str, float]:
        """The groups of the default prior with their standard deviations, for an arm with these terms of this kind."""
        return {self.model: self.usual_size}

    def column_of(self, term: "Term") -> str:
        """The recorded column that the function of a term reads, as in `column`; empty for none."""
        return self.column

    @abc.abstractmethod
    def values(self, terms: Sequence["Term"], q: Readings, forward: ForwardPass) -> Rows:
        """The functions of terms of this kind, one after the other, `rows` of each, at N configurations.

        ``q.joints`` are the readings ``(n, ..., 1, N)``, the joints first, rad (mm of prismatic joints); beside them,
        where they were recorded and else None, are ``q.torques`` and ``q.directions``, of the same shape, and
        ``q.load``, kg, and ``q.thermometer``, C, ``(1, ..., 1, N)``. ``forward`` has the nominal arm there, mm in the
        base frame: ``tip``, and by joint ``z_before`` and ``origin_before`` (the axis that moves, and a point on it)
        and ``origin`` (of the frame after the joint). Arrays are NumPy's or JAX's: functions such as ``cos`` are those
        of ``aj.kinematics.namespace(q)``.
        """


class Term(NamedTuple):
    """One coefficient and its function: ``cos2_3`` has the word "cos", the number 2 and the joint 3.

    Example:
        >>> harmonics = aj.kinematics.with_corrections(arm, ["cos2_3"]).corrections.functions.terms[0].kind
        >>> print(aj.kinematics.Term(harmonics, "cos", 2, 3).name)
        cos2_3
    """

    kind: AbstractCorrection
    word: str  # which function
    number: int  # which of them: an order, a link, another joint; 0 where there is only one
    joint: int  # that it moves, from 1; 0 where it scales all lengths of the arm
    loads: Loads | None = None  # masses of the arm, where the function needs them

    @property
    def name(self) -> str:
        """The coefficient's name as a parameter."""
        return f"{self.word}{self.number or ''}_{self.joint}" if self.joint else self.word

    @property
    def takes_masses(self) -> bool:
        """Whether its function is computed with the masses of all links, if they are known."""
        return self.kind.of_masses and not self.number

    @property
    def unit(self) -> str:
        """Unit of the coefficient."""
        return self.kind.unit if self.number else self.kind.unit_alone or self.kind.unit

    def wrong(self, joints: int) -> str:
        """What is wrong with it for an arm of so many joints, in a few words; empty if nothing is."""
        if not (0 if self.kind.of_arm else 1) <= self.joint <= joints:
            return f"must name a joint from 1 to {joints}"
        return self.kind.wrong(self, joints)


class Harmonics(AbstractCorrection):
    """cos hq and sin hq of every joint; of orders 1 and 2 by default, or of an option's: ``harmonics=1-3+8``.

    An encoder that is eccentric by e at the radius R errs by e / R times a sine of its reading (10 um at 50 mm: 41
    arcsec), one that is oval or tilted by the second harmonic; N evenly spaced read heads leave multiples of N only.
    """

    model = "harmonics"
    words = ("cos", "sin")
    description = "harmonics of encoders"
    unit = "rad"
    usual_size = 5e-5  # 10 arcsec
    usual_of_slide = 0.05
    of_own_reading = True
    has_options = True
    sought = (
        Sought("first harmonic", "1", "cos q_{i}", "an eccentric encoder or a bending link"),
        Sought("second harmonic", "2", "cos 2 q_{i}", "a tilted or oval encoder"),
    )
    shared = "1-3"

    @staticmethod
    def orders_of(option: str) -> tuple[int, ...] | None:
        """The orders that an option such as ``1-3+8`` names, each once; None where one is not from 1 to 99."""
        orders: set[int] = set()
        for part in option.split("+"):
            ends = re.fullmatch(r"([1-9]\d?)(?:-([1-9]\d?))?", part)
            if ends is None or int(ends[2] or ends[1]) < int(ends[1]):
                return None
            orders |= set(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
        return tuple(sorted(orders))

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        orders = self.orders_of(option or "1+2")
        if orders is None:
            raise InputError(
                f"harmonics={option} does not name orders from 1 to {_HIGHEST}; write harmonics=1, harmonics=1+2 or "
                "harmonics=1-31."
            )
        numbers = range(1, joints + 1)
        return tuple(Term(self, word, order, joint) for joint in numbers for order in orders for word in self.words)

    def option_of(self, terms: Sequence[Term]) -> str:
        orders = sorted({term.number for term in terms})
        first = [order for order in orders if order - 1 not in orders]
        last = [order for order in orders if order + 1 not in orders]
        runs = [str(low) if low == high else f"{low}-{high}" for low, high in zip(first, last, strict=True)]
        return "" if orders == [1, 2] else "+".join(runs)

    def wrong(self, term: Term, joints: int) -> str:
        return "" if 1 <= term.number <= _HIGHEST else f"must have an order from 1 to {_HIGHEST}, as in cos1_2"

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        octaves = [(2**k, min(2 ** (k + 1) - 1, _HIGHEST)) for k in range(_HIGHEST.bit_length())]
        return {f"{self.model}={low}" + (f"-{high}" if high > low else ""): self.usual_size for low, high in octaves}

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        xp, joints = namespace(q), sorted({term.joint for term in terms})
        readings = q.joints[np.array(joints) - 1]
        cos, sin = xp.cos(readings)[None], xp.sin(readings)[None]
        highest = max(term.number for term in terms)
        while len(cos) < highest:
            # Orders k + 1 to 2k from 1 to k by addition of angles: three times as fast as the cosine of every multiple,
            # and as exact.
            c, s, more = cos[-1:], sin[-1:], min(len(cos), highest - len(cos))
            next_cos, next_sin = c * cos[:more] - s * sin[:more], s * cos[:more] + c * sin[:more]
            cos, sin = xp.concatenate([cos, next_cos]), xp.concatenate([sin, next_sin])
        order = np.array([term.number - 1 + highest * (term.word == "sin") for term in terms])
        return xp.concatenate([cos, sin])[order, np.array([joints.index(term.joint) for term in terms])]


class GearRatio(AbstractCorrection):
    """The reading itself: a joint that turns, or a carriage that moves, by a little more or less than it reads."""

    model = "gear"
    words = ("gear",)
    description = "relative errors of gear ratios"
    unit = "1"
    usual_size = 2e-4
    of_own_reading = True
    sought = (Sought("gear ratio", "", "q_{i} (gear ratio)", "a wrong gear ratio", of_slides=True, relative=True),)
    shared = ""

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        return q.joints[np.array([term.joint - 1 for term in terms])]


class Coupling(AbstractCorrection):
    """The reading of another joint, whose motor or belt moves this one, too: by default each joint moves the next, with
    ``coupled=2-3`` joint 2 moves joint 3.

    Most couplings are small errors. One of -1 or 1 is a mechanism: parallel links hold the forearm's direction while
    the upper arm moves, so that joint 3 moves by q_3 - q_2. The nominal arm then has this coefficient, which is the
    mean of its prior, and only what remains is an error (`pipeline.automatic.with_full_couplings`).
    """

    model = "coupled"
    words = ("coupled",)
    description = "parts of other joints' readings"
    unit = "1"
    usual_size = 2e-4
    usual_of_slide = 0.05
    of_other_reading = True
    has_options = True

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        if not option:
            return tuple(Term(self, "coupled", joint - 1, joint) for joint in range(2, joints + 1))
        pairs = [re.fullmatch(r"([1-9]\d*)-([1-9]\d*)", pair) for pair in option.split("+")]
        if not all(pairs):
            raise InputError(
                f"coupled={option} does not name pairs of joints; if the reading of joint 2 moves joint 3, for "
                "example, write coupled=2-3."
            )
        return tuple(Term(self, "coupled", int(pair[1]), int(pair[2])) for pair in pairs if pair)

    def option_of(self, terms: Sequence[Term]) -> str:
        return "+".join(dict.fromkeys(f"{term.number}-{term.joint}" for term in terms))

    def wrong(self, term: Term, joints: int) -> str:
        if not 1 <= term.number <= joints:
            return f"must name the reading of another joint from 1 to {joints}, as in coupled2_3"
        return "must name another joint (use gear for a joint's own reading)" if term.number == term.joint else ""

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        return q.joints[np.array([term.number - 1 for term in terms])]


class Gravity(AbstractCorrection):
    """Compliance: a joint, with the link before it, yields to the moment of gravity about its axis.

    The moment of a mass m at c about the axis z through o is m g . (z x (c - o)): linear in the direction of gravity,
    so that its three components are functions of the readings alone. A joint has one coefficient for each link after
    it, ``compliance3_2``: compliance times the weight of link 3 as if it were in the origin of its frame, of the last
    link in the tip, rad/m. Only such products can be found, and no mass need be known: those that a URDF states lack
    the tool, the payload and often more. With ``gravity=masses`` the masses of all links are taken as known, and a
    joint has one coefficient, ``compliance_2``, rad/(kN m). Of simulated robots with 30 to 200 poses it predicted new
    poses by up to 15 % better where all masses were right, by as much worse where they were 30 % off, and 5 (30 poses)
    to 12 times (200) worse with 5 kg at the tip that nobody stated.
    """

    model = "gravity"
    words = ("compliance",)
    description = "joint compliances under the moments of gravity"
    unit = "rad/m"
    unit_alone = "rad/(kN m)"
    usual_size = 1e-3  # 1 mrad for links with levers of 1 m
    usual_of_slide = 0.05
    rows = 3
    of_masses = True
    has_options = True
    sought = (Sought("gravity", "", "gravity about joint {i}", "a joint or link that bends under its load"),)
    shared = ""

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple[Term, ...]:
        numbers = range(1, joints + 1)
        if not option:
            return tuple(Term(self, "compliance", link, joint) for joint in numbers for link in numbers[joint - 1 :])
        if option != _MASSES:
            raise InputError(f"gravity={option} is unknown; write gravity, or gravity=masses where masses are known.")
        if loads is None:
            raise InputError("gravity=masses needs the masses of the links, but they are unknown; write gravity.")
        return tuple(Term(self, "compliance", 0, joint, loads) for joint in numbers)

    def option_of(self, terms: Sequence[Term]) -> str:
        return "" if any(term.number for term in terms) else _MASSES

    def wrong(self, term: Term, joints: int) -> str:
        i, beyond = term.joint, term.number and not term.joint <= term.number <= joints
        return f"must name a link from {i} to {joints}, as in compliance{i}_{i}" if beyond else ""

    def usual(self, terms: Sequence[Term]) -> dict[str, float]:
        # With masses, 1 mrad for 100 N m.
        return {self.model: self.usual_size if all(term.number for term in terms) else 1e-2}

    def values(self, terms: Sequence[Term], q: Readings, forward: ForwardPass) -> Rows:
        return moments_about(terms, [self._pull(term, forward) for term in terms], forward)

    def _pull(self, term: Term, forward: ForwardPass) -> tuple[Any, Float[AnyArray, "... 3 N"]]:
        """The weight that pulls at a joint, and the sum of weights times where they are, mm: 1 of a single link, kN."""
        members: Any = np.ones(len(forward.origin)) if forward.members is None else forward.members
        if term.number:  # of a robot, nothing where the link is of another chain than the pose
            j = term.number - 1
            return members[j], members[j] * (forward.tip if j in last_joints(forward) else forward.origin[j])
        assert term.loads is not None
        # A link's centre of mass is at its origin, and along its axes by the coordinates that are stated.
        links, axes, centre = range(term.joint - 1, len(forward.origin)), frame_axes(forward), term.loads.centre
        weights = {j: KILO * STANDARD_GRAVITY * term.loads.mass[j] * members[j] for j in links}
        pulls = [weights[j] * (forward.origin[j] + sum(centre[j][k] * axes[k][j] for k in range(3))) for j in links]
        return sum(weights.values()), functools.reduce(operator.add, pulls)


def moments_about(
    terms: Sequence[Term], pulls: Sequence[tuple[Any, Float[AnyArray, "... 3 N"]]], forward: ForwardPass
) -> Rows:
    """The moments about the joints of terms, three rows each, of weights and the sums of weights times where they are,
    mm."""
    xp, moved = namespace(forward), np.array([term.joint - 1 for term in terms])
    weights, points = zip(*pulls, strict=True)
    if forward.members is None:
        weight = np.array(weights).reshape(-1, *(1,) * forward.tip.ndim)
    else:
        weight = xp.stack([w + 0.0 * forward.members[0] for w in weights])
    lever = xp.stack(points) - weight * forward.origin_before[moved]
    moments = xp.moveaxis(_METRE * cross(forward.z_before[moved], lever), -2, 1)
    count = moments.shape[0] * moments.shape[1]  # a -1 is undetermined where there are no poses
    return moments.reshape(count, *moments.shape[2:])[..., None, :]
