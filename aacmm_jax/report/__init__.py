"""Reports for laboratories and their customers: one HTML file for a calibration, an evaluation, a study or
compared models; and the pages of a plan and of a verification.

Warnings and tables that the command line shows too are worded in `summaries`; figures for papers are in `plot`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
