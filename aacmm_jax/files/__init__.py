"""Every file format, read and written; what a file holds is defined in `data`, `calibration` and `acceptance`.

What cannot be read or written is an `InputError` that names the file, the place in it, and what to do. A file that is
written is written whole or not at all.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
