"""Every file format, read and written; what a file holds is defined in `data`, `calibration` and `acceptance`."""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
