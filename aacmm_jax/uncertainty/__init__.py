"""What data determine, and how well: covariance, propagation to k, tips and lengths, identifiability.

Monte Carlo and cross-validation, which repeat calibrations: `calibration.sampling` and `pipeline.cross_validation`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
