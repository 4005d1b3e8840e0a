from .comparison import Drift as Drift
from .comparison import Trend as Trend
from .comparison import compare as compare
from .comparison import trend as trend
