"""Turns on JAX's 64-bit floats, and refuses to go on without them; imported before anything else of the package.

A calibration in float32 is wrong by tens of micrometres without any sign of it.
"""

import os
import sys
from pathlib import Path

from .backend import check_setting
from .errors import InputError

LARGEST_INTEGER = 2**63 - 1  # of 64 bits; no seed may be larger

_setting = os.environ.get("JAX_ENABLE_X64")
if _setting is not None and _setting.strip().lower() in {"0", "false", "off", "no"}:
    _refusal = (
        f"aacmm_jax needs 64-bit floats, but JAX_ENABLE_X64={_setting} forbids them: in float32 a calibration is "
        "wrong by tens of micrometres; unset JAX_ENABLE_X64 or set it to 1."
    )
    # The command line imports the package before any code of its own can catch this.
    if Path(sys.argv[0]).stem == "aacmm" or (sys.argv[0] == "-m" and "aacmm_jax" in sys.orig_argv):
        print(f"Error: {_refusal}", file=sys.stderr)
        sys.exit(2)
    raise ImportError(_refusal)
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
else:
    os.environ["JAX_ENABLE_X64"] = "1"  # read when JAX is imported, which takes a second that ``aacmm --help`` can save


def check_x64() -> None:
    """Raise `InputError` where 64-bit floats were turned off after the import, and what `check_setting` raises."""
    import jax

    check_setting()

    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise InputError(
            "64-bit floats were turned off after aacmm_jax was imported, and in float32 a calibration is wrong by tens "
            "of micrometres; leave jax.enable_x64(False), or call jax.config.update('jax_enable_x64', True)."
        )
