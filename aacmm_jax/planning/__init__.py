"""Planning of calibrations: where sockets and reference lengths stand, and which poses to take."""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
