"""Reports for laboratories and their customers: one HTML file for a calibration, an evaluation, a study or
compared models; and the page of a plan.

Warnings and tables that the command line shows too are worded in `summaries`; figures for papers are in `plot`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
