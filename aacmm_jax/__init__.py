"""Calibration of articulated-arm coordinate measuring machines and other serial arms, differentiable throughout."""

import typing as _typing
from importlib import import_module as _import_module

from . import _float64 as _float64  # isort: skip - must come before anything that makes an array
from .arm import Arm as Arm
from .arm import parameter_names as parameter_names
from .batch import ManyCalibrations as ManyCalibrations
from .batch import ManyIdentifications as ManyIdentifications
from .batch import calibrate_many as calibrate_many
from .batch import identify_many as identify_many
from .batch import stack_captures as stack_captures
from .calibrate import calibrate as calibrate
from .calibrate import identify as identify
from .calibration_files import CalibrationRecord as CalibrationRecord
from .calibration_files import load_calibration as load_calibration
from .calibration_files import record_of as record_of
from .calibration_files import save_calibration as save_calibration
from .capture import Capture as Capture
from .capture import ReferenceLength as ReferenceLength
from .capture_files import load_capture as load_capture
from .capture_files import save_capture as save_capture
from .errors import IdentifiabilityWarning as IdentifiabilityWarning
from .errors import InputError as InputError
from .evaluate import Evaluation as Evaluation
from .evaluate import evaluate as evaluate
from .metrics import Repeatability as Repeatability
from .metrics import repeatability as repeatability
from .noise import Noise as Noise
from .observability import Observability as Observability
from .observability import observe as observe
from .parameters import Bounds as Bounds
from .parameters import Parameters as Parameters
from .recording import ArmSpecification as ArmSpecification
from .recording import ProbedSphere as ProbedSphere
from .recording import Recording as Recording
from .results import Calibration as Calibration
from .results import Identification as Identification
from .results import converged as converged
from .scale import Scale as Scale
from .scale import fix_scale as fix_scale
from .scale import scale_from_lengths as scale_from_lengths
from .simulate import deviated as deviated
from .simulate import simulate as simulate
from .solver import BoundedLevenbergMarquardt as BoundedLevenbergMarquardt
from .solver import least_squares as least_squares
from .steps import Reason as Reason
from .uncertainty import Uncertainty as Uncertainty
from .uncertainty import Volume as Volume
from .uncertainty import over_volume as over_volume
from .uncertainty import uncertainty_of as uncertainty_of

# Imported when first asked for: these need pydantic, which takes a tenth of the package's own import, and more.
_LATER = {
    "plan": "planning",
    "Plan": "planning",
    "monte_carlo": "sampling",
    "Sampled": "sampling",
    "bootstrap": "sampling",
    "cross_validate": "validation",
    "load_arm": "arm_files",
    "load_specification": "arm_files",
    "save_arm": "arm_files",
    "shipped_arms": "arm_files",
    "read_manifest": "manifest",
    "Study": "study.study",
    "make_study": "study.study",
    "read_study": "study.shipped",
    "shipped_studies": "study.shipped",
    "run_study": "study.run",
    "open_study": "study.results",
    "dask_executor": "study.executors",
    "accept": "acceptance",
    "measured_by": "acceptance",
    "Measured": "acceptance",
    "decide": "decision",
    "Limit": "decision",
    "fit_sphere": "spheres",
    "enclosing_sphere": "spheres",
    "reach_of": "reach",
    "read_points": "points_files",
    "acceptance_procedure": "procedure",
    "record_procedure": "procedure",
    "EvaluationRecord": "evaluation_files",
    "evaluation_of": "evaluation_files",
    "save_evaluation": "evaluation_files",
    "load_evaluation": "evaluation_files",
    "compare": "drift",
    "Drift": "drift",
    "Trend": "drift",
    "trend": "drift",
    "About": "about",
    "read_about": "about",
    "dcc": "certificate",
    "values_of_dcc": "certificate",
    "write_report": "report",
}
_NOW = {name for name, value in globals().items() if not (name.startswith("_") or isinstance(value, type(_typing)))}
__all__ = sorted(_NOW | set(_LATER))  # pyright: ignore[reportUnsupportedDunderAll]

if _typing.TYPE_CHECKING:
    from . import plot as plot
    from .about import About as About
    from .about import read_about as read_about
    from .acceptance import Measured as Measured
    from .acceptance import accept as accept
    from .acceptance import measured_by as measured_by
    from .arm_files import load_arm as load_arm
    from .arm_files import load_specification as load_specification
    from .arm_files import save_arm as save_arm
    from .arm_files import shipped_arms as shipped_arms
    from .certificate import dcc as dcc
    from .certificate import values_of_dcc as values_of_dcc
    from .decision import Limit as Limit
    from .decision import decide as decide
    from .drift import Drift as Drift
    from .drift import Trend as Trend
    from .drift import compare as compare
    from .drift import trend as trend
    from .evaluation_files import EvaluationRecord as EvaluationRecord
    from .evaluation_files import evaluation_of as evaluation_of
    from .evaluation_files import load_evaluation as load_evaluation
    from .evaluation_files import save_evaluation as save_evaluation
    from .manifest import read_manifest as read_manifest
    from .planning import Plan as Plan
    from .planning import plan as plan
    from .points_files import read_points as read_points
    from .procedure import acceptance_procedure as acceptance_procedure
    from .procedure import record_procedure as record_procedure
    from .reach import reach_of as reach_of
    from .report import write_report as write_report
    from .sampling import Sampled as Sampled
    from .sampling import bootstrap as bootstrap
    from .sampling import monte_carlo as monte_carlo
    from .spheres import enclosing_sphere as enclosing_sphere
    from .spheres import fit_sphere as fit_sphere
    from .study.executors import dask_executor as dask_executor
    from .study.results import open_study as open_study
    from .study.run import run_study as run_study
    from .study.shipped import read_study as read_study
    from .study.shipped import shipped_studies as shipped_studies
    from .study.study import Study as Study
    from .study.study import make_study as make_study
    from .validation import cross_validate as cross_validate
else:

    def __getattr__(name: str):
        if name in _LATER.values() or name == "plot":
            return _import_module(f".{name}", __name__)
        if name not in _LATER:
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
        return getattr(_import_module(f".{_LATER[name]}", __name__), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_LATER})
