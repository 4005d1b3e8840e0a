"""All tests of a calibration's model and noise by its own residuals, each with a stated rate of false alarms."""

from typing import Any, NamedTuple

from ..calibration.record import CalibrationRecord
from ..calibration.results import Calibration, Identification
from ..data.capture import Capture
from ..data.noise import Noise
from .findings import Case, case_of
from .length_consistency import Lengths, lengths_of
from .missing_terms import FoundTerm, missing
from .noise_level import Misfit, NoisyObservation, misfit_of, noisy_observations
from .noisy_encoders import NoisyJoint, noisiest_joint
from .residual_tests import LEVEL
from .successive_poses import Successive, successive_of


class ModelTests(NamedTuple):
    """All tests of one calibration; None and nothing where there is too little to test.

    Each has its ``probability`` where nothing is wrong, already that of its whole family; below `LEVEL` it is a
    finding.
    """

    misfit: Misfit | None = None
    lengths: Lengths | None = None
    noisy_observations: tuple[NoisyObservation, ...] = ()  # those that are too noisy
    terms: tuple[FoundTerm, ...] = ()  # those that were found, the most important first
    noisy_joint: NoisyJoint | None = None
    successive: Successive | None = None

    @property
    def warns(self) -> bool:
        """Whether something is wrong."""
        tests = (self.misfit, self.lengths, self.noisy_joint, self.successive)
        significant = any(test.probability < LEVEL for test in tests if test is not None)
        return bool(self.terms or self.noisy_observations or significant)


def model_tests(
    result: Calibration | Identification | CalibrationRecord,
    capture: Capture | None = None,
    *,
    class_noise: Noise | None = None,
) -> ModelTests:
    """Test model and noise of a calibration by its residuals. It takes some milliseconds.

    Args:
        result: What `calibrate` or `identify` returned, or the record of a calibration.
        capture: What it was calibrated from; not with a record, which holds it.
        class_noise: Noise of encoders and seat that is usual for this class of arms, as for `findings_of`.

    Returns:
        The tests; those that found something have a probability below `LEVEL`.

    Example:
        >>> tests = aj.diagnostics.model_tests(result, capture)
        >>> print(tests.warns, len(tests.terms))
        False 0
    """
    return values_of_tests(case_of(result, capture, class_noise))


def values_of_tests(case: Case) -> ModelTests:
    """The tests of a case."""
    return ModelTests(
        misfit=case.once(misfit_of),
        lengths=case.once(lengths_of),
        noisy_observations=case.once(noisy_observations),
        terms=case.once(missing),
        noisy_joint=case.once(noisiest_joint),
        successive=case.once(successive_of),
    )


def rows_of_tests(tests: ModelTests) -> dict[str, Any]:
    """The tests as JSON has them: probabilities where nothing is wrong, and what was found; mm, rad."""
    misfit = _values(tests.misfit, "ratio", "degrees_of_freedom", "probability")
    if misfit is not None and tests.misfit is not None:
        misfit["against"] = tests.misfit.usual or "given noise"
    lengths = _values(tests.lengths, "birge_ratio", "degrees_of_freedom", "probability", "odd")
    if lengths is not None:
        lengths["odd"] = lengths["odd"] or None
    return {
        "level": LEVEL,
        "misfit": misfit,
        "lengths": lengths,
        "noisy_joint": _values(tests.noisy_joint, "joint", "probability"),
        "successive_poses": _values(tests.successive, "correlation", "probability"),
        "noisy_observations": [{"name": one.name, "probability": one.probability} for one in tests.noisy_observations],
        "missing_terms": [
            {
                "term": term.kind,
                "joint": term.joint,
                "amplitude": term.amplitude,
                "f": term.test.ratio,
                "degrees_of_freedom": list(term.test.degrees_of_freedom),
                "probability": term.probability,
                "alternatives": [{"term": kind, "joint": joint} for kind, joint in term.alternatives],
            }
            for term in tests.terms
        ],
    }


def _values(test: Any, *names: str) -> dict[str, Any] | None:
    return None if test is None else {name: getattr(test, name) for name in names}
