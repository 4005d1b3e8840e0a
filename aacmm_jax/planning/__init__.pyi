from .design import Plan as Plan
from .design import plan as plan
