from .arm_uncertainty import Uncertainty as Uncertainty
from .identifiability import Observability as Observability
from .identifiability import observability as observability
from .volume import VolumetricUncertainty as VolumetricUncertainty
from .volume import sample_lengths as sample_lengths
from .volume import volumetric_uncertainty as volumetric_uncertainty
