"""The command line, ``aacmm``."""

import gc
import sys
from importlib import import_module
from typing import NoReturn

_INTERRUPTED = 130
# Modules of commands, in the order in which ``--help`` lists them.
_FAMILIES = (
    "capture_commands",
    "calibration_commands",
    "result_commands",
    "study_commands",
    "plan_commands",
    "compare_commands",
)


def main() -> None:
    """Run ``aacmm``. Exit codes: 0 done, 1 not achieved, 2 bad input, 130 interrupted. ``--debug`` shows tracebacks."""
    debug = "--debug" in sys.argv
    if debug:
        sys.argv.remove("--debug")
    # Tracing makes hundreds of thousands of objects that live until the process ends. Looking for garbage among them
    # would take a sixth of the time of a short command.
    gc.set_threshold(200_000, 20, 20)
    try:
        from ..core.errors import InputError
        from .app import Stopped, app

        for family in _FAMILIES:
            import_module(f".{family}", __name__)
    except ImportError as error:
        if debug:
            raise
        _fail(str(error), 2)
    except KeyboardInterrupt:
        _interrupted()
    try:
        app(prog_name="aacmm")
    except SystemExit as done:
        if done.code == _INTERRUPTED:
            _interrupted()
        raise
    except KeyboardInterrupt:
        _interrupted()
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        sys.exit(_INTERRUPTED)
    except InputError as error:
        if debug:
            raise
        _fail(str(error), 2)
    except Exception as error:
        if debug:
            raise
        _fail(
            f"aacmm failed unexpectedly ({type(error).__name__}: {error}); report what it says with --debug.",
            1,
        )
    finally:
        gc.freeze()


def _interrupted() -> NoReturn:
    print("Interrupted; nothing was written that is not whole.", file=sys.stderr)
    sys.exit(_INTERRUPTED)


def _fail(message: str, code: int) -> NoReturn:
    print(f"Error: {message}", file=sys.stderr)
    sys.exit(code)
