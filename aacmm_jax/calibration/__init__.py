"""Identification and calibration: one (`single`), many (`batch`), repeated, cross-validated; and their results.

Elsewhere: the rows that are minimised (`model.rows`), the active set (`solver.active_set`), covariance
(`uncertainty`), the file of a calibration (`files.calibrations`), the wording of its warnings (`diagnostics.findings`).
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
