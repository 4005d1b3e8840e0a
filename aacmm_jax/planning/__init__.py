"""Planning of calibrations: positions of sockets and reference lengths, and the poses to take.

Poses of acceptance tests: `acceptance.procedure`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
