"""What all commands share: the application, common options, and how results are shown."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from ..core.errors import InputError

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    rich_markup_mode="rich",
    help="Calibrate articulated-arm coordinate measuring machines and other serial arms.",
    epilog="Every command takes --help and, for a traceback when something fails, --debug. Start with: aacmm demo",
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else there.")]

Only = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="PATTERN", help="Use only the sockets that match (shell pattern); repeatable."),
]

Without = Annotated[
    list[str] | None, typer.Option("--without", metavar="PATTERN", help="Leave out the sockets that match; repeatable.")
]

CaptureFile = Annotated[Path, typer.Argument(metavar="CAPTURE.h5", help="Capture written by import or simulate.")]

CalibrationFile = Annotated[Path, typer.Argument(metavar="CALIBRATION.h5", help="Calibration written by calibrate.")]


def _version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(metadata.version("aacmm_jax"))
        raise typer.Exit()


@app.callback()
def prepare(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")] = False,
) -> None:
    """Calibrate articulated-arm coordinate measuring machines and other serial arms."""
    # Compiled kernels are kept between runs; it more than halves the time of a short command.
    import jax

    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(home / "aacmm_jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def with_spinner(what: str, work: Callable[[], Any]) -> Any:
    """Do work behind a spinner on standard error, where that is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        return work()
    with console.status(f"{what} ..."):
        return work()


def show_summary(summary: dict[str, Any], as_json: bool, printed: Callable[[dict[str, Any]], None]) -> None:
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        printed(summary)


def socket_option(text: str) -> tuple[str, tuple[float, ...]]:
    name, _, point = text.partition("=")
    try:
        x, y, z = (float(part) for part in point.split(","))
    except ValueError:
        bad_option("--socket", text, "NAME=X,Y,Z in mm, for example A=400,200,300")
    return name, (x, y, z)


def length_option(text: str) -> tuple:
    parts = text.split(",")
    try:
        return (
            (*parts[:2], *(float(u) for u in parts[2:]))
            if len(parts) in (2, 3)
            else bad_option("--length", text, "A,B or A,B,U")
        )
    except ValueError:
        bad_option("--length", text, "A,B or A,B,U with u in mm")


def bad_option(option: str, text: str, form: str) -> NoReturn:
    raise InputError(f"{option} '{text}' is not of the form {form}.")


class Stopped(Exception):
    """Work was interrupted and what is done is kept; the message says how to go on."""
