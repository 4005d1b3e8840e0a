from .active_set import QuadraticModel as QuadraticModel
from .bounded import BoundedLevenbergMarquardt as BoundedLevenbergMarquardt
from .bounded import least_squares as least_squares
from .reason import Reason as Reason
