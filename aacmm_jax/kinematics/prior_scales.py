"""The prior of an arm of which nothing else is known: what errors of arms are usually about, learned from the data.

One scale for each kind of parameter, and for harmonics one an octave of the order, which all joints share: the error of
an encoder or a gear is a function whose harmonics fade with their order at a rate that nobody knows beforehand. A scale
for each joint fails where a joint moves little, since high orders imitate anything there (`benchmarks/NOTES.md`).
"""

from ..core.arguments import checked_arguments
from .arm import Arm, correction_names
from .corrections.kind import Term
from .corrections.kinds import all_kinds
from .priors import Prior, is_of_group

_LENGTH, _ANGLE = 1.0, 1e-3  # mm, rad


@checked_arguments
def default_prior(arm: Arm) -> Prior:
    """The prior with which an arm with joint corrections is calibrated where no other is given.

    Learned from the data, each expected to a factor of 4.5: lengths (1 mm), angles (1 mrad), gravity (1 mrad for links
    with levers of 1 m, or for 100 N m), gear and coupled (0.02 %), thermal expansion (20 um/(m K)), and one group for
    each octave of harmonics (0.05 mrad).

    Args:
        arm: The nominal arm, with the corrections that are calibrated.

    Returns:
        The prior of the groups that the arm has.

    Example:
        >>> bending = aj.kinematics.with_corrections(aj.load_arm("ur10e"), "gravity,harmonics=1")
        >>> prior = aj.kinematics.default_prior(bending)
        >>> print(prior.groups)
        ('lengths', 'angles', 'gravity', 'harmonics=1')
    """
    terms = () if arm.corrections is None else arm.corrections.functions.terms
    kinds: dict[str, float] = {}
    slides: dict[str, float] = {}
    for kind in all_kinds():
        kinds |= kind.usual([term for term in terms if isinstance(term, Term) and term.kind.model == kind.model])
        if kind.usual_of_slide is not None:
            # Coefficients of a slide are in mm, so that they cannot share a scale with those of joints that turn.
            slides |= {f"{word}*_{joint}": kind.usual_of_slide for joint in arm.prismatic for word in kind.words}
    names = correction_names(arm)
    known = {group: sd for group, sd in (kinds | slides).items() if any(is_of_group(group, name) for name in names)}
    return Prior({"lengths": _LENGTH, "angles": _ANGLE} | known, learn=True)
