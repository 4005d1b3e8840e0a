"""Monte Carlo studies of calibrations: specification, trials, store, executors, results.

Many calibrations without a study: `calibration.batch`; Monte Carlo of one calibration: `calibration.sampling`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
