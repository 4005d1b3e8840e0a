"""What diagnostics say of a calibration, in one form for terminal, report, certificate and JSON.

A diagnostic is a module of this folder that has a function ``test(case) -> list[Finding]``; `findings_of` finds it by
that. Its ``ORDER`` says where its findings stand among others that are as serious, and its ``NEEDS`` what must be
plausible for them to mean anything: "nothing", the "scale" of the arm, or its residuals too, "fit".
"""

import pkgutil
from collections.abc import Callable, Iterable
from functools import cached_property, lru_cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import numpy as np

from ..calibration.record import CalibrationRecord, record_of
from ..calibration.results import Calibration, Identification
from ..core._compat import inside_trace
from ..core.arguments import checked_arguments
from ..core.arrays import is_concrete
from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..core.units import ARCSEC
from ..data.capture import Capture
from ..data.noise import ArmNoise, Noise
from ..data.recording import Recording
from ..kinematics.parameters import ArmSpecification
from .equations import EXACT, Block, Equations, Rows, equations_of, in_chunks, residual_rms
from .residual_tests import Residuals

Severity = Literal["unusable", "doubt", "note"]
RECORD_DIRECTIONS = (
    "Record from which side each joint was approached (columns direction_1, direction_2, ...): backlash is then "
    "tested, and corrected if it is there."
)
_SEVERITIES: tuple[Severity, ...] = ("unusable", "doubt", "note")  # the most serious first
_FEWEST = 6  # degrees of freedom below which residuals say nothing

Value = TypeVar("Value")


class Finding(NamedTuple):
    """What a diagnostic found: what it is, how certain, what it costs, what to do, and which data it is about.

    Example:
        >>> (finding,) = aj.diagnostics.findings_of(result, capture)
        >>> print(finding.code, finding.severity, finding.concerns)
        one-reference-length note ('A - B',)
    """

    code: str  # which finding it is; stays the same where the sentence changes
    says: str  # what was found, a sentence
    costs: str = ""  # what it does to the numbers of the result, a sentence
    advice: str = ""  # what to do, a sentence
    severity: Severity = "note"  # "unusable": the result is not to be used; "doubt": its uncertainties are too small
    doubt: str = ""  # the same in a few words, for the first line of a result
    probability: float | None = None  # of such data where nothing is wrong, where a test says so
    concerns: tuple[str, ...] = ()  # parameters, sockets, observations, lengths and joints ("joint 2")
    # Part of the excess of the squared residuals over what is expected that this explains, where that is known.
    explains: float | None = None

    @property
    def sentence(self) -> str:
        """All that is to be read."""
        return " ".join(part for part in (self.says, self.costs, self.advice) if part)


def sentences(findings: Iterable[Finding]) -> list[str]:
    """Findings as people read them."""
    return [finding.sentence for finding in findings]


def finding_rows(findings: Iterable[Finding]) -> list[dict[str, Any]]:
    """Findings as JSON has them."""
    return [finding._asdict() | {"concerns": list(finding.concerns)} for finding in findings]


_BY_EQUATIONS: set[Callable] = set()  # functions of a case whose values follow from its equations


def by_equations(compute: Callable[["Case"], Value]) -> Callable[["Case"], Value]:
    """Decorator of a function of a case whose value follows from the equations alone, not from the covariance."""
    _BY_EQUATIONS.add(compute)
    return compute


class Case:
    """A calibration, and what several diagnostics need of it, computed once when first asked for."""

    def __init__(self, record: CalibrationRecord, class_noise: Noise | None = None):
        self.record = record
        self.usual = record.recording.usual if class_noise is None else ArmNoise("as given", class_noise, "")
        self._kept: dict[Callable, Any] = {}

    def once(self, compute: "Callable[[Case], Value]") -> Value:
        """What a function makes of this case."""
        if compute not in self._kept:
            with np.errstate(all="ignore"):
                self._kept[compute] = compute(self)
        return self._kept[compute]

    @cached_property
    def equations(self) -> Equations:
        """The equations of the calibration at its solution."""
        return equations_of(self.record)

    @cached_property
    def chunks(self) -> tuple[list[Rows], list[Block]]:
        """The equations of poses, in chunks that tests of residuals can take, and those of relations."""
        return in_chunks(self.equations)

    @cached_property
    def left(self) -> Residuals:
        """What the model leaves of them."""
        rows, relations = self.chunks
        return Residuals.of([*(part.block("") for part in rows), *relations])

    @cached_property
    def testable(self) -> bool:
        """Whether residuals say anything of the model."""
        return bool(self.chunks[0]) and self.left.degrees_of_freedom >= _FEWEST

    @cached_property
    def scatters(self) -> bool:
        """Whether they also are more than the rounding errors of a simulation without noise."""
        return self.testable and residual_rms(self.chunks[0]) >= EXACT

    @cached_property
    def shows_noise(self) -> bool:
        """Whether they also scatter as the noise does: a robust loss makes them smaller, and less scattered."""
        weights = self.record.observed.weights
        return self.scatters and not any(bool(np.any(np.asarray(part) < 1)) for part in weights)

    def take_over(self, earlier: "Case") -> None:
        """Keep what an earlier case has computed of the same equations."""
        if _same_equations(self.record, earlier.record):
            vars(self).update({name: value for name, value in vars(earlier).items() if name not in vars(self)})
            self._kept |= {compute: value for compute, value in earlier._kept.items() if compute in _BY_EQUATIONS}


# Fields of a record from which its equations follow, and what is made of these, besides its arm and its capture.
_FIELDS = (
    *("names", "hold", "scale_set_by", "method", "against_division", "noise", "reduced_chi"),
    *("observed", "prior"),
)


def _same_equations(first: CalibrationRecord, second: CalibrationRecord) -> bool:
    parts = [
        (record.calibrated.arm, record.recording.capture, *(getattr(record, name) for name in _FIELDS))
        for record in (first, second)
    ]
    if jax.tree.structure(parts[0]) != jax.tree.structure(parts[1]):
        return False
    return all(map(np.array_equal, *map(jax.tree.leaves, parts)))


_last: list[Case] = []  # the case of the record that was asked for last
_solved: list[Case] = []  # that of the result that was solved last, before its uncertainty was amended


def case_of(
    result: Calibration | Identification | CalibrationRecord,
    capture: Capture | None = None,
    class_noise: Noise | None = None,
) -> Case:
    """The case of a result, or the same one again for the same record: what it has computed is kept.

    The case of another record of the same solution takes over what follows from the equations.
    """
    if not isinstance(result, CalibrationRecord):
        if capture is None:
            raise InputError(
                "the result does not contain its capture; give the capture from which the arm was calibrated."
            )
        record = record_of(result, Recording(capture, ArmSpecification(result.space.base)))
        return Case(record, class_noise)
    if class_noise is not None:
        return Case(result, class_noise)
    if not _last or _last[0].record is not result:
        case = Case(result)
        for earlier in (*_last, *_solved):
            case.take_over(earlier)
        _last[:] = [case]
    return _last[0]


def amendable(result: Calibration | Identification, capture: Capture) -> Case | None:
    """The case of a result whose noise and uncertainty may be amended; None where its values are traced, where it did
    not converge, or where data and arm do not belong together.

    What it computes of the equations is kept for the record of the amended result, whose covariance alone is another.
    """
    if inside_trace() or not is_concrete(*jax.tree.leaves((result, capture))):
        return None
    if not bool(result.converged) or result.implausible_residual:
        return None
    _solved[:] = [case_of(to_numpy(result), to_numpy(capture))]
    return _solved[0]


@lru_cache(maxsize=1)
def diagnostics() -> tuple[ModuleType, ...]:
    """The modules of this folder that are diagnostics."""
    names = [module.name for module in pkgutil.iter_modules([str(Path(__file__).parent)])]
    modules = [import_module(f"{__package__}.{name}") for name in names]
    return tuple(sorted((module for module in modules if hasattr(module, "test")), key=lambda module: module.ORDER))


@checked_arguments
def findings_of(
    result: Calibration | Identification | CalibrationRecord,
    capture: Capture | None = None,
    *,
    class_noise: Noise | None = None,
) -> list[Finding]:
    """What should be read about a calibration before its numbers, the most serious first.

    Args:
        result: What `calibrate` or `identify` returned, or the record of a calibration.
        capture: What it was calibrated from; not with a record, which holds it.
        class_noise: Noise of encoders and seat that is usual for this class of arms, for a calibration whose noise was
            estimated; by default that which the arm's file states, where the record has it.

    Returns:
        The findings; none where nothing is to be said.

    Example:
        >>> for finding in aj.diagnostics.findings_of(result, capture):
        ...     print(finding.code, finding.severity)
        one-reference-length note
    """
    case = case_of(result, capture, class_noise)
    plausible = {"nothing"}
    if case.record.plausible_scale:
        plausible |= {"scale"} | ({"fit"} if not case.record.implausible_residual else set())
    findings = [finding for module in diagnostics() if module.NEEDS in plausible for finding in case.once(module.test)]
    return sorted(findings, key=_rank)


def _rank(finding: Finding) -> tuple[bool, float, int]:
    """Results that are not to be used first; then what explains most of the residuals; then by how serious it is."""
    explains = -1.0 if finding.explains is None else finding.explains
    return finding.severity != "unusable", -explains, _SEVERITIES.index(finding.severity)


def warnings_of(
    result: Calibration | Identification | CalibrationRecord,
    capture: Capture | None = None,
    *,
    class_noise: Noise | None = None,
) -> list[str]:
    """The sentences of `diagnostics.findings_of`, which the command line prints.

    Args:
        result: What `calibrate`, `identify` or `calibrate_capture` returned.
        capture: What it was calibrated from; not with the record of `calibrate_capture`, which holds it.
        class_noise: Noise that is usual for this class of arms, for a calibration whose noise was estimated.

    Returns:
        The sentences; none where nothing is to be said.

    Example:
        >>> for sentence in aj.warnings_of(result, capture):
        ...     print(sentence.partition(". ")[2])
        Hold out a second reference length as a check.
    """
    return sentences(findings_of(result, capture, class_noise=class_noise))


def look_for_play(case: Case, joints: int = 1) -> str:
    """What to do where joints may have play: to record directions, where these would decide it and none are there."""
    advice = f"State the noise of each joint, or look for play in {'these joints' if joints > 1 else 'this joint'}."
    return advice if "directions" in case.record.recording.nominal.arm.recorded else f"{advice} {RECORD_DIRECTIONS}"


def chance_text(probability: float) -> str:
    """A probability as sentences have it."""
    return "p < 0.0001" if probability < 1e-4 else f"p = {probability:.1g}"


def rounded(value: float) -> str:
    """A number with two digits."""
    return f"{float(f'{value:.2g}'):g}"


def reading_text(value: float, slides: bool) -> str:
    """An error of a joint's reading: arcsec, or um of a prismatic joint, from rad or mm."""
    return f"{rounded(1e3 * value)} um" if slides else f"{rounded(value / ARCSEC)} arcsec"
