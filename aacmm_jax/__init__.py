"""Calibration of articulated-arm coordinate measuring machines and other serial arms, differentiable throughout.

The names below are those that most scripts need; everything else is grouped by subject: `acceptance`, `calibration`,
`certificate`, `data`, `drift`, `files`, `kinematics`, `model`, `planning`, `plot`, `report`, `solver`, `study`,
`uncertainty`, `units`. A name is imported when it is first asked for; the stub `__init__.pyi` lists them.
"""

import lazy_loader as _lazy_loader

from .core import compilation_cache as _compilation_cache
from .core import units as _units  # noqa: F401 - a name of a package that does not list it is found once it is imported
from .core import x64 as _x64  # noqa: F401 - turns on 64-bit floats before anything makes an array

_compilation_cache.set_up()

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
