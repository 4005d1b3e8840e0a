"""The kinds of joint corrections by name, and their coefficients by name."""

import re
from collections.abc import Iterable
from functools import lru_cache

from ..core.errors import InputError, nearest
from .correction_kinds import AbstractCorrection, Coupling, GearRatio, Gravity, Harmonics, Loads, Sought, Term
from .recorded_kinds import Backlash, Expansion, Load, Torque

# Short forms. An error function of each joint, whatever its cause: with a prior, 62 coefficients a joint are few enough
# to be found in seconds from 500 poses, and orders to 63 were hardly better (`benchmarks/NOTES.md`).
_SHORT_FORMS = {"functions": "harmonics=1-31"}
_COEFFICIENT = re.compile(r"([a-z]+)([1-9][0-9]*)?(?:_([1-9][0-9]*))?")
_KEPT = 4096  # results: every calibration asks for the same ones

KINDS: dict[str, AbstractCorrection] = {  # by what a model calls them, in the order of these names
    kind.model: kind
    for kind in (Backlash(), Coupling(), Expansion(), GearRatio(), Gravity(), Harmonics(), Load(), Torque())
}


@lru_cache(_KEPT)
def coefficient_of(name: str) -> Term | None:
    """The term that the name of a coefficient says, of whichever arm it is; None for every other parameter."""
    parts = _COEFFICIENT.fullmatch(name)
    kind = None if parts is None else next((kind for kind in KINDS.values() if parts[1] in kind.words), None)
    if parts is None or kind is None:
        return None
    return Term(kind, parts[1], int(parts[2] or 0), int(parts[3] or 0))


def unit_of_coefficient(name: str) -> str:
    """Unit of a joint correction's coefficient, of a joint that rotates; empty for other parameters."""
    term = coefficient_of(name)
    return "" if term is None else term.unit


def all_sought() -> dict[str, tuple[AbstractCorrection, Sought]]:
    """What residuals are searched for, by name, with its kind."""
    return {sought.name: (kind, sought) for kind in KINDS.values() for sought in kind.sought}


def shared_model() -> str:
    """The model of the functions by which poses may share errors."""
    return ",".join(model_with(kind, kind.shared) for kind in KINDS.values() if kind.shared is not None)


def model_of(terms: Iterable[Term]) -> str:
    """The model that has all these terms: "dh,gear,harmonics=1-3"; "dh" alone for none."""
    terms = tuple(terms)
    by_kind = [(kind, [term for term in terms if term.kind.model == kind.model]) for kind in KINDS.values()]
    return ",".join(["dh", *(model_with(kind, kind.option_of(chosen)) for kind, chosen in by_kind if chosen)])


def model_with(kind: AbstractCorrection, option: str) -> str:
    """A model of one kind with an option, or without where it is empty."""
    return f"{kind.model}={option}" if option else kind.model


def term_of(name: str, joints: int, loads: Loads | None = None) -> Term | None:
    """The term that a coefficient belongs to, None where this is no coefficient's name; `InputError` where it is one,
    but not of an arm with so many joints."""
    term = coefficient_of(name)
    if term is None:
        return None
    if wrong := term.wrong(joints):
        raise InputError(f"the coefficient '{name}' {wrong}; correct the name.")
    return term._replace(loads=loads) if term.takes_masses else term


@lru_cache(_KEPT)
def terms_of(model: str, joints: int, loads: Loads | None = None) -> tuple[Term, ...]:
    """The terms of a model: kinds with their options, separated by commas, such as "dh,gravity,harmonics=1".

    "dh" stands for the arm itself, "functions" for harmonics=1-31. `InputError` where a kind is unknown or there twice,
    or an option means nothing.
    """
    terms: dict[Term, None] = {}
    seen: set[str] = set()
    for given in model.split(","):
        part = _SHORT_FORMS.get(given.strip(), given.strip())
        name, _, option = part.partition("=")
        if name in seen:
            raise InputError(f"the model names '{name}' twice; give each part once, as in dh,gravity,harmonics=1+2.")
        seen.add(name)
        if name == "dh":
            continue
        kind = KINDS.get(name)
        if kind is None:
            raise InputError(f"unknown model '{name}'{nearest(name, ['dh', *KINDS, *_SHORT_FORMS])}")
        if option and not kind.has_options:
            raise InputError(f"{name} takes no options, but '{option}' is given; write only {name}.")
        for term in kind.terms(joints, option, loads):
            if wrong := term.wrong(joints):
                raise InputError(f"{part} {wrong}; correct the model.")
            terms[term] = None
    return tuple(terms)
