"""The command line, ``aacmm``."""

import sys


def main() -> None:
    """Run ``aacmm``. Exit codes: 0 done, 1 not achieved, 2 bad input, 130 interrupted. ``--debug`` shows tracebacks."""
    debug = "--debug" in sys.argv
    if debug:
        sys.argv.remove("--debug")
    try:
        from ..errors import InputError
        from .commands import app
    except ImportError as error:
        if debug:
            raise
        _fail(str(error), 2)
    try:
        app()
    except InputError as error:
        if debug:
            raise
        _fail(str(error), 2)
    except Exception as error:
        if debug:
            raise
        _fail(
            f"aacmm failed unexpectedly ({type(error).__name__}: {error}); run again with --debug and report what it shows.", 1
        )


def _fail(message: str, code: int) -> None:
    print(f"Error: {message}", file=sys.stderr)
    sys.exit(code)
