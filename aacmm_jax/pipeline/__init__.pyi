from .capture_calibration import CaptureOptions as CaptureOptions
from .capture_calibration import join_recordings as join_recordings
from .capture_evaluation import EvaluationOptions as EvaluationOptions
from .capture_simulation import SimulationOptions as SimulationOptions
from .model_ladder import ComparedModels as ComparedModels
from .single import CalibrationOptions as CalibrationOptions
from .verification import Accuracy as Accuracy
from .verification import Verification as Verification
