"""Live capture: devices that are read while an arm is measured, what to measure next, and every pose on disk at once.

`Session` is the whole of it in Python; the terminal and the page (``aacmm live``) show its `Session.state`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
