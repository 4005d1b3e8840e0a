from .comparison import compare as compare
from .comparison import trend as trend
from .due import Due as Due
from .due import next_due as next_due
from .results import Drift as Drift
from .results import Trend as Trend
