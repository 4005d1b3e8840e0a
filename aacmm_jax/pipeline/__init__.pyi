from .capture_calibration import CaptureOptions as CaptureOptions
from .capture_calibration import join_recordings as join_recordings
from .model_ladder import ComparedModels as ComparedModels
from .single import CalibrationOptions as CalibrationOptions
