"""Figures for papers (matplotlib), each a function that plots into the axes given, or into new ones.

None touches matplotlib's global state; save one with ``axes.figure.savefig("name.pdf")``. All are readable in grey.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
