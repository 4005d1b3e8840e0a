"""Calibrations of one arm compared over time; the sentences about it: `results`, `summaries.drift`."""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
