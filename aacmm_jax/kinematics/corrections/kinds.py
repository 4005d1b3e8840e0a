"""All kinds of joint corrections, and the names of their coefficients."""

import re
from functools import lru_cache

from ...core.errors import InputError, nearest
from .coupling import Coupling
from .expansion import Expansion
from .gear_ratio import GearRatio
from .gravity import Gravity
from .harmonics import Harmonics
from .kind import AbstractCorrection, Loads, Term

KINDS: tuple[AbstractCorrection, ...] = (Harmonics(), GearRatio(), Gravity(), Coupling(), Expansion())
# Short forms. An error function of each joint, whatever its cause: with a prior, 62 coefficients a joint are few enough
# to be found in seconds from 500 poses, and orders to 63 were hardly better (`benchmarks/NOTES.md`).
_SHORT_FORMS = {"functions": "harmonics=1-31"}
COEFFICIENT = re.compile(r"([a-z]+)([1-9][0-9]*)?(?:_([1-9][0-9]*))?")
_KEPT = 4096  # results: every calibration asks for the same ones, and the method of an Equinox module takes 0.1 ms


@lru_cache(_KEPT)
def term_of(name: str, joints: int, loads: Loads | None = None) -> Term | None:
    """The term that a coefficient belongs to, or None where this is no coefficient's name.

    Raises:
        InputError: It is one, but not of an arm with so many joints.
    """
    found = COEFFICIENT.fullmatch(name)
    kind = None if found is None else next((kind for kind in KINDS if found[1] in kind.words), None)
    if found is None or kind is None:
        return None
    number = int(found[2] or 0)
    term = Term(kind, found[1], number, int(found[3] or 0), loads if kind.rows == 3 and not number else None)
    wrong = f"is of a joint from 1 to {joints}" if _is_outside(term, joints) else kind.wrong(term, joints)
    if wrong:
        raise InputError(f"the coefficient '{name}' {wrong}; correct its name.")
    return term


@lru_cache(_KEPT)
def terms_of(model: str, joints: int, loads: Loads | None = None) -> tuple[Term, ...]:
    """The terms of a model: kinds with their options, separated by commas, such as "dh,gravity,harmonics=1".

    Args:
        model: Names of kinds, each with an option after "=" if need be; "dh" stands for the arm itself, "functions"
            for harmonics=1-31.
        joints: Number of joints of the arm.
        loads: Masses of the arm, where known.

    Raises:
        InputError: A kind is unknown or there twice, or an option means nothing.
    """
    found: list[Term] = []
    seen: set[str] = set()
    for given in model.split(","):
        part = _SHORT_FORMS.get(given.strip(), given.strip())
        name, _, option = part.partition("=")
        if name in seen:
            raise InputError(f"the model names '{name}' twice; name it once, as in dh,gravity,harmonics=1+2.")
        seen.add(name)
        if name == "dh":
            continue
        kinds = [kind for kind in KINDS if kind.model == name]
        if not kinds:
            known = ["dh", *(kind.model for kind in KINDS), *_SHORT_FORMS]
            raise InputError(f"unknown model '{name}'{nearest(name, known)}")
        terms = kinds[0].terms(joints, option, loads)
        for term in terms:
            wrong = kinds[0].wrong(term, joints)
            if wrong or _is_outside(term, joints):
                raise InputError(f"{part} {wrong or f'names joint {term.joint} of {joints}'}; correct it.")
        found += terms
    return tuple(dict.fromkeys(found))


def _is_outside(term: Term, joints: int) -> bool:
    """Whether an arm has no such joint; 0, no joint, is for thermal expansion alone."""
    return not (0 if isinstance(term.kind, Expansion) else 1) <= term.joint <= joints
