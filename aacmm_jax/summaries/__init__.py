"""Sentences and tables that command line, report and JSON share.

Warnings about captures and calibrations, pose outliers among them, are worded in `diagnostics`. A module is imported
when it is first asked for: printing what a file holds needs none of those that compute.
"""

import lazy_loader as _lazy_loader

_MODULES = {
    *("arm_survey", "calibration", "cameras", "compared_models", "correction", "drift", "evaluation", "planning"),
    "verification",
}
__getattr__, __dir__, __all__ = _lazy_loader.attach(__name__, submodules=_MODULES)
