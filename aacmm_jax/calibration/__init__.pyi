from .evaluation import Evaluation as Evaluation
from .record import CalibrationRecord as CalibrationRecord
from .record import record_of as record_of
from .results import CrossValidation as CrossValidation
from .results import ManyCalibrations as ManyCalibrations
from .results import ManyIdentifications as ManyIdentifications
from .results import converged as converged
from .sampling import Sampled as Sampled
