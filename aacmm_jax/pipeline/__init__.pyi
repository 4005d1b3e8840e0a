from .model_ladder import ComparedModels as ComparedModels
from .single import CalibrationOptions as CalibrationOptions
