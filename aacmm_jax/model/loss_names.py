"""Names of the robust losses, for Python and the command line; `robust` has the losses. (Imports no JAX.)"""

from typing import Literal, get_args

LossName = Literal["huber", "cauchy", "tukey"]
LOSSES: tuple[LossName, ...] = get_args(LossName)
