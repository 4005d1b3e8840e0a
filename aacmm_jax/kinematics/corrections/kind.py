"""What a kind of joint correction says of itself: the names of its coefficients, and the functions they multiply.

What a joint really does is its reading plus coefficients times known functions of all readings,

    theta_i = q_i + theta_i0 + sum_b c_ib phi_b(q),

so the derivative of the tip by a coefficient is the Jacobian column of the joint's theta (of a prismatic joint, of its
d) times phi. Thermal expansion moves no joint: all lengths grow by 1 + c (T - 20 C). A new kind is one file with one
class in this folder: whatever else the package does with kinds, it asks them.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from jaxtyping import Float

from ...core.errors import InputError
from ...core.numpy_or_jax import AnyArray
from ..chain import ForwardPass


class Loads(NamedTuple):
    """What pulls at the arm, for functions of gravity."""

    mass: tuple[float, ...]  # of each link, kg
    centre: tuple[tuple[float, float, float], ...]  # of mass, in the link's own D-H frame, mm


class Sought(NamedTuple):
    """Functions of a kind that residuals are searched for, all those of one joint at once."""

    name: str  # what results call it: "first harmonic"
    option: str  # of the model with these functions: "1" of ``harmonics=1``
    follows: str  # what residuals follow then, of joint {i}: "cos q_{i}"
    cause: str  # what usually causes it, with its article: "an eccentric encoder"
    of_slides: bool = False  # whether prismatic joints have it as well
    relative: bool = False  # whether its size is the coefficient, a ratio, rather than what it adds over the poses


@dataclass(frozen=True)
class AbstractCorrection(abc.ABC):
    """A kind of joint correction, without data of its own: every two of a class are equal, and static in a program."""

    model: ClassVar[str]  # what a model calls it, as in ``--model dh,harmonics=1``
    words: ClassVar[tuple[str, ...]]  # with which the names of its coefficients begin
    description: ClassVar[str]  # what its coefficients are, in the plural: "errors of gear ratios"
    unit: ClassVar[str]  # of a coefficient of a revolute joint; in place of rad, mm of a prismatic one
    unit_alone: ClassVar[str] = ""  # where it differs: of a coefficient whose name has no number
    usual_size: ClassVar[float]  # about how large coefficients usually are, in this unit
    usual_of_slide: ClassVar[float | None] = None  # the same where a joint is prismatic, mm; None: as of others
    rows: ClassVar[int] = 1  # of `values`: 3 for a function of gravity, one for each component of its direction
    of_arm: ClassVar[bool] = False  # whether it scales all lengths of the arm: its terms are of joint 0
    of_own_reading: ClassVar[bool] = False  # whether each function is of its joint's reading alone, and can be drawn
    sought: ClassVar[tuple[Sought, ...]] = ()  # what residuals of a calibration without it are searched for
    shared: ClassVar[str | None] = None  # option of the model whose functions poses may share errors by; None: none

    def terms(self, joints: int, option: str, loads: Loads | None) -> tuple["Term", ...]:
        """The terms of a model with an option, ``harmonics=2`` has the option "2"; by default there is none.

        Args:
            joints: Number of joints of the arm.
            option: What follows the name of the kind; empty for the default.
            loads: Masses of the arm, where known.

        Raises:
            InputError: The option means nothing here.
        """
        if option:
            raise InputError(f"{self.model} takes no option such as '{option}'; write {self.model} alone.")
        return self.all_terms(joints, loads)

    def all_terms(self, joints: int, loads: Loads | None) -> tuple["Term", ...]:
        """The terms of a model without an option: by default one for each joint."""
        return tuple(Term(self, self.words[0], 0, joint) for joint in range(1, joints + 1))

    def option_of(self, terms: Sequence["Term"]) -> str:
        """The option of the model that has these terms, and as few others as can be: the inverse of `terms`."""
        return ""

    def wrong(self, term: "Term", joints: int) -> str:
        """What is wrong with a term of this kind for an arm of so many joints, in a few words; empty if nothing is."""
        return "has a number, and takes none" if term.number else ""

    def usual(self, terms: Sequence["Term"]) -> dict[str, float]:
        """The groups of the default prior with their standard deviations, for an arm with these terms of this kind."""
        return {self.model: self.usual_size}

    @abc.abstractmethod
    def values(
        self, terms: Sequence["Term"], q: Float[AnyArray, "n ... 1 N"], forward: ForwardPass
    ) -> Float[AnyArray, "rows ... 1 N"]:
        """The functions of terms at N configurations, one after the other: `rows` of each.

        Args:
            terms: Of this kind.
            q: Joint readings, rad (mm of prismatic joints), joints first; with a thermometer, its reading is last, C.
            forward: The frames of the nominal arm at these readings, mm.
        """


class Term(NamedTuple):
    """One coefficient and its function: ``cos2_3`` has the word "cos", the number 2 and the joint 3."""

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
    def unit(self) -> str:
        """Unit of the coefficient."""
        return self.kind.unit if self.number else self.kind.unit_alone or self.kind.unit

    @property
    def rows(self) -> int:
        """How many rows `values` has."""
        return self.kind.rows
