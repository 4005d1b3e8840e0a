from .arm import Arm as Arm
from .arm import parameter_names as parameter_names
from .parameters import ArmSpecification as ArmSpecification
from .parameters import Bounds as Bounds
from .parameters import Parameters as Parameters
from .parameters import perturbed_arm as perturbed_arm
from .workspace import arm_reach as arm_reach
