from .metrics import Repeatability as Repeatability
from .metrics import pose_outliers as pose_outliers
from .metrics import repeatability as repeatability
from .scale import Scale as Scale
from .scale import fix_scale as fix_scale
from .scale import scale_from_lengths as scale_from_lengths
