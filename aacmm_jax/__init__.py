"""Calibration of articulated-arm coordinate measuring machines and other serial arms, differentiable throughout.

The names below are those that most scripts need; everything else is grouped by subject, one folder each:

* `kinematics`: the arm. `data`: captures, noise, simulation. `solver`: bounded least squares.
* `model`: the residual of a capture for an arm. `uncertainty`: what data determine, and how well.
* `calibration`: the solve, one and many, and its results. `diagnostics`: what judges a result or its data.
* `pipeline`: identify and calibrate. `study`: calibrations by the thousand.
* `acceptance`, `drift`, `planning`: tests by standards, calibrations compared, which poses to take.
* `camera`: boards, their corners in images, models of cameras.
* `files`: every format. `summaries`: sentences and tables. `report`, `plot`, `certificate`, `cli`: what people read.
* `live`: captures that guide whoever takes them.
* `core`: arrays, errors, `units`.

A name is imported when it is first asked for; the stub `__init__.pyi` lists them.
"""

import lazy_loader as _lazy_loader

from .core import jax_setup as _jax_setup  # turns on 64-bit floats before anything makes an array
from .core import units as _units  # noqa: F401 - a name of a package that does not list it is found once it is imported

_jax_setup.set_up()

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
