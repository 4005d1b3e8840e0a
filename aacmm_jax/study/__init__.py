"""Monte Carlo studies of calibrations: specification, trials, store, results.

Trials are solved in batches, which look for no encoder that is noisier than the others and for no errors that poses
share: intervals of a study are by its noise alone, and not by what `calibrate` adds to it.

Many calibrations without a study: `calibration.batch`; Monte Carlo of one calibration: `calibration.sampling`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
