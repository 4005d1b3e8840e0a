"""The command line, ``aacmm``."""

import contextlib
import errno
import gc
import io
import os
import sys
from importlib import import_module
from typing import NoReturn

INTERRUPTED = 130
INTERRUPTED_SENTENCE = "Interrupted; no file was left half-written."
_CLOSED_PIPE = 141  # as a shell reports of a program whose output is closed (128 + SIGPIPE)
# Modules of commands, in the order in which ``--help`` lists them.
_FAMILIES = (
    "arm_command",
    "capture_commands",
    "calibration_commands",
    "result_commands",
    "certificate_command",
    "export_command",
    "correct_command",
    "study_commands",
    "plan_commands",
    "target_command",
    "verify_command",
    "live_command",
)


def main() -> None:
    """Run ``aacmm``. ``--debug`` shows tracebacks, ``--overwrite`` replaces files of any kind by the outputs.

    Exit codes: 0 done, 1 not achieved, 2 bad input, 130 interrupted, 141 standard output closed by its reader.
    """
    end = sys.argv.index("--") if "--" in sys.argv else len(sys.argv)  # what follows is no option
    debug, overwrite = (option in sys.argv[:end] for option in ("--debug", "--overwrite"))
    sys.argv = [word for i, word in enumerate(sys.argv) if i >= end or word not in ("--debug", "--overwrite")]
    _prepare_process()
    try:
        from ..core.errors import InputError
        from ..files.outputs import asking
        from .app import Stopped, app, check_numbers, prepare_jax, register_own_corrections

        for family in _FAMILIES:
            import_module(f".{family}", __name__)
    except ImportError as error:
        if debug:
            raise
        _fail(str(error), 2)
    except KeyboardInterrupt:
        _interrupted()
    try:
        check_numbers(sys.argv[1:])
        if not {"--help", "--version"} & set(sys.argv):
            if sys.argv[1:2] != ["show"]:  # which rarely computes
                prepare_jax()
            register_own_corrections()
        with contextlib.nullcontext() if overwrite else asking():
            app(prog_name="aacmm")
    except SystemExit as done:
        if done.code == INTERRUPTED:
            _interrupted()
        if isinstance(done.__context__, BrokenPipeError):  # typer and rich both exit with 1 while they handle it
            _discard_output()
            sys.exit(_CLOSED_PIPE)
        raise
    except KeyboardInterrupt:
        _interrupted()
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        sys.exit(INTERRUPTED)
    except InputError as error:
        if debug:
            raise
        _fail(str(error), 2)
    except Exception as error:
        if debug:
            raise
        _fail_without_jax()
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            _discard_output()
            _fail(
                "standard output cannot be written: no space left on the device; free some space, or write to "
                "another device.",
                1,
            )
        _fail(
            f"aacmm failed unexpectedly ({type(error).__name__}: {error}); repeat the command with --debug and report "
            "its output.",
            1,
        )
    finally:
        gc.freeze()


def _prepare_process() -> None:
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names that the terminal's encoding does not have
    # Tracing makes hundreds of thousands of objects that live until the process ends. Looking for garbage among them
    # would take a sixth of the time of a short command.
    gc.set_threshold(500_000, 20, 20)
    # The matrices of one calibration are so small that threads of NumPy's BLAS wait for each other most of the time: a
    # plan took twice the CPU time. It reads this once, when NumPy is imported.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _fail_without_jax() -> None:
    from ..core.jax_setup import check_backend

    try:
        check_backend()
    except RuntimeError as error:
        _fail(str(error), 2)


def _interrupted() -> NoReturn:
    print(INTERRUPTED_SENTENCE, file=sys.stderr)
    sys.exit(INTERRUPTED)


def _discard_output() -> None:
    """Standard output leads nowhere from now on: Python would write what is left at its end, and fail again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> NoReturn:
    from ..core.text import in_short, printable

    print(f"Error: {printable(in_short(message))}", file=sys.stderr)
    sys.exit(code)
