"""The kinds of joint corrections by name, and their coefficients by name."""

import math
import re
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, TypeVar

from ..core.errors import InputError, nearest
from .correction_kinds import AbstractCorrection, Coupling, GearRatio, Gravity, Harmonics, Loads, Sought, Term
from .recorded_kinds import Backlash, Expansion, Load, Torque

# Short forms. An error function of each joint, whatever its cause: with a prior, 62 coefficients a joint are few enough
# to be found in seconds from 500 poses, and orders to 63 were hardly better (`benchmarks/NOTES.md`).
_SHORT_FORMS = {"functions": "harmonics=1-31"}
_COEFFICIENT = re.compile(r"([a-z]+)([1-9][0-9]*)?(?:_([1-9][0-9]*))?")
_KEPT = 4096  # results: every calibration asks for the same ones
_STATED = ("model", "words", "description", "unit", "usual_size")
_TAKEN = {"dh", "all", "lengths", "angles", "alpha", "a", "d", "theta", "beta", "probe", "gravity_", *_SHORT_FORMS}
# Of the units of coefficients; a certificate has to write them in D-SI (`certificate.parameter_results`).
UNITS = {"1", "rad", "mm", "m", "K", "kN"}
# What the sentences on unknown names end with.
REGISTER = (
    "register a kind of your own first, with aj.kinematics.register_correction, or for aacmm with the environment "
    "variable AACMM_CORRECTIONS=FILE.py"
)
Kind = TypeVar("Kind", bound=AbstractCorrection)

KINDS: dict[str, AbstractCorrection] = {  # by what a model calls them, in the order of these names
    kind.model: kind
    for kind in (Backlash(), Coupling(), Expansion(), GearRatio(), Gravity(), Harmonics(), Load(), Torque())
}


def register_correction(kind: type[Kind]) -> type[Kind]:
    """Make a joint correction of your own known to models, files, plans, reports and tests of residuals.

    It is a decorator of the class, whose class of the same ``model`` it replaces, so that a cell of a notebook can be
    run again. Programs that load a calibration with such a correction register it before. For ``aacmm``, the
    environment variable ``AACMM_CORRECTIONS`` names the Python file with the class.

    Args:
        kind: A class derived from `AbstractCorrection`, which is made without arguments.

    Returns:
        The same class.

    Raises:
        InputError: something that the class must state is missing, or another kind has the same names.

    Example:
        >>> @aj.kinematics.register_correction
        ... class Bow(aj.kinematics.AbstractCorrection):
        ...     model, words, description = "bow", ("bow",), "bows of scales"
        ...     unit, usual_size = "1/rad", 1e-4
        ...
        ...     def values(self, terms, q, forward):
        ...         return q.joints[np.array([term.joint - 1 for term in terms])] ** 2
        ...
        >>> bent = aj.kinematics.with_corrections(arm, "dh,bow")
        >>> print(aj.kinematics.parameter_names(bent)[-1])
        bow_6
    """
    if wrong := _wrong_kind(kind):
        raise InputError(wrong)
    KINDS[kind.model] = kind()
    coefficient_of.cache_clear()
    terms_of.cache_clear()
    return kind


def _wrong_kind(kind: Any) -> str:
    """What is wrong with a class of which a kind is to be made, in one sentence; empty if nothing is."""
    if not (isinstance(kind, type) and issubclass(kind, AbstractCorrection)):
        return f"{kind!r} is not a class derived from AbstractCorrection; give such a class."
    name = kind.__name__
    missing = [each for each in _STATED if not hasattr(kind, each)] + sorted(kind.__abstractmethods__)
    if missing:
        return f"the correction {name} lacks {', '.join(missing)}; add what is missing to the class."
    stated: Any = kind  # its attributes, of whatever types they are
    words = stated.words if isinstance(stated.words, tuple) else (stated.words,)
    others = [other for other in KINDS.values() if other.model != stated.model]
    if stated.model in KINDS and type(KINDS[stated.model]).__module__.startswith(f"{__package__}."):
        return f"the package has a correction '{stated.model}'; give {name} another model."
    for word in (stated.model, *words):
        if not (isinstance(word, str) and re.fullmatch("[a-z]+", word)):
            return f"the correction {name} has the name {word!r}; model and words need lowercase letters (a to z) only."
        if word in _TAKEN or any(word in (other.model, *other.words) for other in others):
            return f"the correction {name} uses the name '{word}', which means something else; choose another one."
    if not (words and isinstance(stated.words, tuple)):
        return f"the words of the correction {name} are {stated.words!r}; give a tuple such as ('{stated.model}',)."
    for unit in (stated.unit, stated.unit_alone):
        if not isinstance(unit, str) or not set(re.split(r"[/() ]+", unit)) <= UNITS | {""}:
            return f"the unit of the correction {name} is {unit!r}; use 1, rad, mm, m, K and kN, as in rad/(kN m)."
    size = stated.usual_size
    if not (isinstance(size, int | float) and math.isfinite(size) and size > 0):
        return f"usual_size of the correction {name} is {size!r}; give the usual size of a coefficient, above 0."
    return ""


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
            hint = nearest(name, ["dh", *KINDS, *_SHORT_FORMS])
            hint = hint if hint.endswith("?") else f"{hint[:-1]}; or {REGISTER}."
            raise InputError(f"unknown model '{name}'{hint}")
        if option and not kind.has_options:
            raise InputError(f"{name} takes no options, but '{option}' is given; write only {name}.")
        for term in kind.terms(joints, option, loads):
            if wrong := term.wrong(joints):
                raise InputError(f"{part} {wrong}; correct the model.")
            terms[term] = None
    return tuple(terms)
