from .bounded import BoundedLevenbergMarquardt as BoundedLevenbergMarquardt
from .bounded import least_squares as least_squares
from .levenberg_marquardt import Reason as Reason
