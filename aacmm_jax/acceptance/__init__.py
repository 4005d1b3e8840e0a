"""Acceptance tests after JJF 1408, ASME B89.4.22 and ISO 10360-12, one module each; the decision rule: `decision`.

Their tables for people are made in `summaries.evaluation` and `report.evaluation`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
