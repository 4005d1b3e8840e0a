from .scale import Scale as Scale
from .scale import fix_scale as fix_scale
from .scale import scale_from_lengths as scale_from_lengths
from .sockets import Repeatability as Repeatability
from .sockets import pose_outliers as pose_outliers
from .sockets import repeatability as repeatability
