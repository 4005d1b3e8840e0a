"""The measurement model: residuals of a capture for an arm, weights, the scale, and repeatability."""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
