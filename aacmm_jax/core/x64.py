"""Turns on JAX's 64-bit floats; imported before anything else of the package.

A calibration in float32 is silently wrong by tens of micrometres, so an explicit request for it is refused.
"""

import os

import jax

_setting = os.environ.get("JAX_ENABLE_X64")
if _setting is not None and _setting.strip().lower() in {"0", "false", "off", "no"}:
    raise ImportError(
        f"aacmm_jax needs 64-bit floats, but JAX_ENABLE_X64={_setting} forbids them: in float32 a calibration is "
        "wrong by tens of micrometres; unset JAX_ENABLE_X64 or set it to 1."
    )
jax.config.update("jax_enable_x64", True)
