"""Calibration of articulated-arm coordinate measuring machines and other serial arms, differentiable throughout."""

from . import _float64 as _float64  # isort: skip - must come before anything that makes an array
from .arm import Arm as Arm
from .arm import parameter_names as parameter_names
from .calibrate import Calibration as Calibration
from .calibrate import Identification as Identification
from .calibrate import calibrate as calibrate
from .calibrate import identify as identify
from .capture import Capture as Capture
from .capture import ReferenceLength as ReferenceLength
from .errors import InputError as InputError
from .metrics import Repeatability as Repeatability
from .metrics import repeatability as repeatability
from .parameters import Bounds as Bounds
from .parameters import Parameters as Parameters
from .scale import Scale as Scale
from .scale import fix_scale as fix_scale
from .scale import scale_from_lengths as scale_from_lengths
from .simulate import simulate as simulate
from .solver import Reason as Reason
from .solver import least_squares as least_squares
