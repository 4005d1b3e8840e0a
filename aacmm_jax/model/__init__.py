"""The measurement model: residuals of a capture for an arm, weights, the scale k, repeatability and its outliers.

The least squares itself is in `solver`, what it is applied to in `calibration`; the uncertainty of k, as far as it
follows from the parameters, in `uncertainty.scale_uncertainty`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
