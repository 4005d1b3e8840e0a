"""Calibrations: one and many of them, repeated on drawn data, evaluated on others; and their results.

A calibration in the order of the data: `task` (one problem, checked, and its weighted least squares), `solve`
(parameters, geometry and covariance), and `stages` (k, and the division by it). Beside that path: `prior_fit`,
`scale_anchor`, `batch` with `batch_kernel`, `redrawn` with `sampling`, `evaluation` with `prediction`, `results` and
`record`. Public calls are `pipeline.single`, `batch`, `sampling` and `evaluation`; the file of a calibration is in
`files.calibrations`.
"""

import lazy_loader as _lazy_loader

__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
