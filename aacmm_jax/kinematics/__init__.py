"""The arm: its Denavit-Hartenberg chain, Jacobian, parameters, inverse kinematics and workspace.

Which parameters data determine: `independence` for an arm, `uncertainty` for a capture.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
