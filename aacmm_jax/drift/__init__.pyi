from .comparison import compare as compare
from .comparison import trend as trend
from .results import Drift as Drift
from .results import Trend as Trend
