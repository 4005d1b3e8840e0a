"""Targets and cameras: boards to print, their corners in images, rendered images; models of cameras.

OpenCV detects corners, and does nothing else (extra ``camera``).
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
