"""All kinds of joint corrections, and the names of their coefficients."""

import pkgutil
import re
from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

from ...core.errors import InputError, nearest
from .kind import AbstractCorrection, Loads, Sought, Term

# Short forms. An error function of each joint, whatever its cause: with a prior, 62 coefficients a joint are few enough
# to be found in seconds from 500 poses, and orders to 63 were hardly better (`benchmarks/NOTES.md`).
_SHORT_FORMS = {"functions": "harmonics=1-31"}
_COEFFICIENT = re.compile(r"([a-z]+)([1-9][0-9]*)?(?:_([1-9][0-9]*))?")
_KEPT = 4096  # results: every calibration asks for the same ones, and the method of an Equinox module takes 0.1 ms
_KINDS: dict[str, AbstractCorrection] = {}  # by what a model calls them


def all_kinds() -> tuple[AbstractCorrection, ...]:
    """Every kind in a file of this folder, by name, and those registered besides."""
    return tuple(_KINDS.values())


def is_kind(name: str) -> bool:
    """Whether a model calls some kind so."""
    return name in _KINDS


def register(kind: AbstractCorrection) -> None:
    """Make a kind known that has no file in this folder.

    Raises `InputError` where what a model calls it, or a word of its coefficients, is another kind's.
    """
    for name in (kind.model, *kind.words):
        taken = any(name in (other.model, *other.words) for other in all_kinds())
        if taken or re.fullmatch("[a-z]+", name) is None or name in ("dh", *_SHORT_FORMS):
            raise InputError(
                f"'{name}' of {type(kind).__name__} is no name for a kind of joint correction; name it by lowercase "
                "letters that no other kind has."
            )
    _KINDS[kind.model] = kind
    _forget()


def unregister(kind: AbstractCorrection) -> None:
    """Make a kind unknown again."""
    del _KINDS[kind.model]
    _forget()


def _forget() -> None:
    for cached in (coefficient_of, unit_of_coefficient, term_of, terms_of):
        cached.cache_clear()


def _register_files() -> None:
    """Whatever kinds the modules of this folder define, by name."""
    modules = [module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)]) if module.name != "kinds"]
    for module in modules:
        import_module(f"{__package__}.{module}")
    for kind in sorted(AbstractCorrection.__subclasses__(), key=lambda kind: kind.model):
        register(kind())  # pyright: ignore[reportAbstractUsage]


class Coefficient(NamedTuple):
    """What the name of a coefficient says of it."""

    kind: AbstractCorrection
    word: str
    number: int
    joint: int


@lru_cache(_KEPT)
def coefficient_of(name: str) -> Coefficient | None:
    """What the name of a coefficient says, of whichever arm it is; None for every other parameter."""
    parts = _COEFFICIENT.fullmatch(name)
    kind = None if parts is None else next((kind for kind in all_kinds() if parts[1] in kind.words), None)
    if parts is None or kind is None:
        return None
    return Coefficient(kind, parts[1], int(parts[2] or 0), int(parts[3] or 0))


@lru_cache(_KEPT)
def unit_of_coefficient(name: str) -> str:
    """Unit of a joint correction's coefficient, of a joint that rotates; empty for other parameters."""
    coefficient = coefficient_of(name)
    return "" if coefficient is None else Term(*coefficient).unit


def all_sought() -> dict[str, tuple[AbstractCorrection, Sought]]:
    """What residuals are searched for, by name, with its kind."""
    return {sought.name: (kind, sought) for kind in all_kinds() for sought in kind.sought}


def shared_model() -> str:
    """The model of the functions by which poses may share errors."""
    return ",".join(model_with(kind, kind.shared) for kind in all_kinds() if kind.shared is not None)


def model_of(terms: Iterable[Term]) -> str:
    """The model that has all these terms: "dh,gear,harmonics=1-3"; "dh" alone for none."""
    terms = tuple(terms)
    by_kind = [(kind, [term for term in terms if term.kind.model == kind.model]) for kind in all_kinds()]
    return ",".join(["dh", *(model_with(kind, kind.option_of(chosen)) for kind, chosen in by_kind if chosen)])


def model_with(kind: AbstractCorrection, option: str) -> str:
    """A model of one kind with an option, or without where it is empty."""
    return f"{kind.model}={option}" if option else kind.model


@lru_cache(_KEPT)
def term_of(name: str, joints: int, loads: Loads | None = None) -> Term | None:
    """The term that a coefficient belongs to, or None where this is no coefficient's name.

    Raises `InputError` where it is one, but not of an arm with so many joints.
    """
    coefficient = coefficient_of(name)
    if coefficient is None:
        return None
    kind = coefficient.kind
    term = Term(*coefficient, loads if kind.rows == 3 and not coefficient.number else None)
    wrong = f"is of a joint from 1 to {joints}" if _is_outside(term, joints) else kind.wrong(term, joints)
    if wrong:
        raise InputError(f"the coefficient '{name}' {wrong}; correct its name.")
    return term


@lru_cache(_KEPT)
def terms_of(model: str, joints: int, loads: Loads | None = None) -> tuple[Term, ...]:
    """The terms of a model: kinds with their options, separated by commas, such as "dh,gravity,harmonics=1".

    Raises `InputError` where a kind is unknown or there twice, or an option means nothing. "dh" stands for the arm
    itself, "functions" for harmonics=1-31; ``loads`` are the masses of the arm, where known.
    """
    all_terms: list[Term] = []
    seen: set[str] = set()
    for given in model.split(","):
        part = _SHORT_FORMS.get(given.strip(), given.strip())
        name, _, option = part.partition("=")
        if name in seen:
            raise InputError(f"the model names '{name}' twice; name it once, as in dh,gravity,harmonics=1+2.")
        seen.add(name)
        if name == "dh":
            continue
        kind = _KINDS.get(name)
        if kind is None:
            raise InputError(f"unknown model '{name}'{nearest(name, ['dh', *_KINDS, *_SHORT_FORMS])}")
        terms = kind.terms(joints, option, loads)
        for term in terms:
            wrong = kind.wrong(term, joints)
            if wrong or _is_outside(term, joints):
                raise InputError(f"{part} {wrong or f'names joint {term.joint} of {joints}'}; correct it.")
        all_terms += terms
    return tuple(dict.fromkeys(all_terms))


def _is_outside(term: Term, joints: int) -> bool:
    """Whether an arm has no such joint; 0, no joint, is for what scales the whole arm."""
    return not (0 if term.kind.of_arm else 1) <= term.joint <= joints


_register_files()
