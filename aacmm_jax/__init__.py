"""Calibration of articulated-arm coordinate measuring machines and other serial arms, differentiable throughout."""

import typing as _typing
from importlib import import_module as _import_module

from .core import x64 as _float64  # isort: skip - must come before anything that makes an array
from .calibration.batch import ManyCalibrations as ManyCalibrations
from .calibration.batch import ManyIdentifications as ManyIdentifications
from .calibration.batch import calibrate_many as calibrate_many
from .calibration.batch import identify_many as identify_many
from .calibration.batch import stack_captures as stack_captures
from .calibration.evaluation import Evaluation as Evaluation
from .calibration.evaluation import evaluate as evaluate
from .calibration.results import Calibration as Calibration
from .calibration.results import Identification as Identification
from .calibration.results import converged as converged
from .calibration.stages import calibrate as calibrate
from .calibration.stages import identify as identify
from .core.errors import IdentifiabilityWarning as IdentifiabilityWarning
from .core.errors import InputError as InputError
from .data.capture import Capture as Capture
from .data.capture import ReferenceLength as ReferenceLength
from .data.noise import Noise as Noise
from .data.recording import ArmSpecification as ArmSpecification
from .data.recording import ProbedSphere as ProbedSphere
from .data.recording import Recording as Recording
from .data.simulation import deviated as deviated
from .data.simulation import simulate as simulate
from .files.calibrations import CalibrationRecord as CalibrationRecord
from .files.calibrations import load_calibration as load_calibration
from .files.calibrations import record_of as record_of
from .files.calibrations import save_calibration as save_calibration
from .files.captures import load_capture as load_capture
from .files.captures import save_capture as save_capture
from .kinematics.arm import Arm as Arm
from .kinematics.arm import parameter_names as parameter_names
from .kinematics.parameters import Bounds as Bounds
from .kinematics.parameters import Parameters as Parameters
from .model.metrics import Repeatability as Repeatability
from .model.metrics import repeatability as repeatability
from .model.scale import Scale as Scale
from .model.scale import fix_scale as fix_scale
from .model.scale import scale_from_lengths as scale_from_lengths
from .solver.bounded import BoundedLevenbergMarquardt as BoundedLevenbergMarquardt
from .solver.bounded import least_squares as least_squares
from .solver.levenberg_marquardt import Reason as Reason
from .uncertainty.identifiability import Observability as Observability
from .uncertainty.identifiability import observe as observe
from .uncertainty.volume import Uncertainty as Uncertainty
from .uncertainty.volume import Volume as Volume
from .uncertainty.volume import over_volume as over_volume
from .uncertainty.volume import uncertainty_of as uncertainty_of

# Imported when first asked for: these need pydantic, which takes a tenth of the package's own import, and more.
_LATER = {
    "plan": "planning.design",
    "Plan": "planning.design",
    "monte_carlo": "calibration.sampling",
    "Sampled": "calibration.sampling",
    "bootstrap": "calibration.sampling",
    "cross_validate": "calibration.cross_validation",
    "load_arm": "files.arms",
    "load_specification": "files.arms",
    "save_arm": "files.arms",
    "shipped_arms": "files.arms",
    "read_manifest": "files.manifest",
    "Study": "study.definition",
    "make_study": "study.definition",
    "read_study": "study.shipped",
    "shipped_studies": "study.shipped",
    "run_study": "study.runner",
    "open_study": "study.results",
    "dask_executor": "study.executors",
    "accept": "acceptance.suite",
    "measured_by": "acceptance.suite",
    "Measured": "acceptance.suite",
    "decide": "acceptance.decision",
    "Limit": "acceptance.decision",
    "fit_sphere": "acceptance.spheres",
    "enclosing_sphere": "acceptance.spheres",
    "reach_of": "kinematics.workspace",
    "read_points": "files.points",
    "acceptance_procedure": "acceptance.procedure",
    "record_procedure": "acceptance.procedure",
    "EvaluationRecord": "files.evaluations",
    "evaluation_of": "files.evaluations",
    "save_evaluation": "files.evaluations",
    "load_evaluation": "files.evaluations",
    "compare": "drift.comparison",
    "Drift": "drift.comparison",
    "Trend": "drift.comparison",
    "trend": "drift.comparison",
    "About": "files.administrative_data",
    "read_about": "files.administrative_data",
    "dcc": "certificate.document",
    "values_of_dcc": "certificate.document",
    "write_report": "report",
}
_NOW = {name for name, value in globals().items() if not (name.startswith("_") or isinstance(value, type(_typing)))}
__all__ = sorted(_NOW | set(_LATER))  # pyright: ignore[reportUnsupportedDunderAll]

if _typing.TYPE_CHECKING:
    from . import plot as plot
    from .acceptance.decision import Limit as Limit
    from .acceptance.decision import decide as decide
    from .acceptance.procedure import acceptance_procedure as acceptance_procedure
    from .acceptance.procedure import record_procedure as record_procedure
    from .acceptance.spheres import enclosing_sphere as enclosing_sphere
    from .acceptance.spheres import fit_sphere as fit_sphere
    from .acceptance.suite import Measured as Measured
    from .acceptance.suite import accept as accept
    from .acceptance.suite import measured_by as measured_by
    from .calibration.cross_validation import cross_validate as cross_validate
    from .calibration.sampling import Sampled as Sampled
    from .calibration.sampling import bootstrap as bootstrap
    from .calibration.sampling import monte_carlo as monte_carlo
    from .certificate.document import dcc as dcc
    from .certificate.document import values_of_dcc as values_of_dcc
    from .drift.comparison import Drift as Drift
    from .drift.comparison import Trend as Trend
    from .drift.comparison import compare as compare
    from .drift.comparison import trend as trend
    from .files.administrative_data import About as About
    from .files.administrative_data import read_about as read_about
    from .files.arms import load_arm as load_arm
    from .files.arms import load_specification as load_specification
    from .files.arms import save_arm as save_arm
    from .files.arms import shipped_arms as shipped_arms
    from .files.evaluations import EvaluationRecord as EvaluationRecord
    from .files.evaluations import evaluation_of as evaluation_of
    from .files.evaluations import load_evaluation as load_evaluation
    from .files.evaluations import save_evaluation as save_evaluation
    from .files.manifest import read_manifest as read_manifest
    from .files.points import read_points as read_points
    from .kinematics.workspace import reach_of as reach_of
    from .planning.design import Plan as Plan
    from .planning.design import plan as plan
    from .report import write_report as write_report
    from .study.definition import Study as Study
    from .study.definition import make_study as make_study
    from .study.executors import dask_executor as dask_executor
    from .study.results import open_study as open_study
    from .study.runner import run_study as run_study
    from .study.shipped import read_study as read_study
    from .study.shipped import shipped_studies as shipped_studies
else:

    def __getattr__(name: str):
        if name in _LATER.values() or name == "plot":
            return _import_module(f".{name}", __name__)
        if name not in _LATER:
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
        return getattr(_import_module(f".{_LATER[name]}", __name__), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_LATER})
