from .design import Plan as Plan
from .design import plan as plan
from .kit import KitPlan as KitPlan
from .kit import plan_kit as plan_kit
from .kit_placement import KitItem as KitItem
from .motion import Motion as Motion
from .problem import PlanOptions as PlanOptions
