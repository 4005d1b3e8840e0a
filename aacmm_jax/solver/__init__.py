"""Box-bounded nonlinear least squares: Levenberg-Marquardt with an active set, and its adjoint.

The rows of a calibration are in `model.rows`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
