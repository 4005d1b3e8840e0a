"""Box-bounded nonlinear least squares: Levenberg-Marquardt with an active set, and its adjoint.

The residuals of a calibration are in `model.residuals`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
