from .capture import Capture as Capture
from .capture import ReferenceLength as ReferenceLength
from .capture import stack_captures as stack_captures
from .noise import Noise as Noise
from .recording import Recording as Recording
from .simulation import simulate as simulate
from .sphere import ProbedSphere as ProbedSphere
