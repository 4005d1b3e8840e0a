"""Whatever judges a calibration or its data: tests of noise, model, groups of poses and readings."""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
