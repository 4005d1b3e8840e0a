"""What all commands share: the application, how options are declared, options of several commands, and printing."""

import contextlib
import csv
import inspect
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args

import typer
import typer.core

from ..core.backend import prepare_command
from ..core.errors import InputError
from ..core.text import in_short, is_control, is_number, number, printable, quoted
from ..core.x64 import LARGEST_INTEGER


class _Commands(typer.core.TyperGroup):
    """The commands; what typer says of wrong options is printable and no longer than people read."""

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        with _said_in_short():
            return super().make_context(*arguments, **options)

    def invoke(self, ctx: Any) -> Any:
        with _said_in_short():
            return super().invoke(ctx)


@contextlib.contextmanager
def _said_in_short() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        message = getattr(error, "message", "")  # of typer's exceptions; that of several lines is the help
        if isinstance(message, str) and "\n" not in message:
            error.message = printable(in_short(message))  # pyright: ignore[reportAttributeAccessIssue]
        raise


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
    # Plain help: the panels of rich cut the names of options, and with them their units, in a narrow terminal.
    rich_markup_mode=None,
    context_settings={"max_content_width": 120},
    help="Calibrate articulated-arm coordinate measuring machines and other serial arms.",
    epilog="Every command has --help, --debug for the traceback of a failure, and --overwrite to replace a file that "
    "aacmm did not write. Start with: aacmm demo",
)


def argument(metavar: str, help: str, default: Any = ...) -> Any:
    """An argument of a command, as the default of the function's parameter."""
    return typer.Argument(default, metavar=metavar, help=help)


def option(metavar: str | None, help: str, *names: str, default: Any = None, **limits: Any) -> Any:
    """An option of a command: the word for its value (None: its choices), what it does, and its names if they are not
    the parameter's."""
    return typer.Option(default, *names, metavar=metavar, help=help, **limits)


def flag(name: str, help: str) -> Any:
    """An option without a value."""
    return typer.Option(False, name, help=help)


def output(metavar: str, help: str, default: Any = ...) -> Any:
    """The option -o."""
    kept = " An existing file that aacmm did not write is kept unless --overwrite."
    return option(metavar, help + kept, "--output", "-o", default=default)


def seed(of: str) -> Any:
    """The option --seed."""
    return option("N", f"Seed of {of}.", default=0, min=0, max=LARGEST_INTEGER)


JSON = flag("--json", "Print one JSON object on standard output, and nothing else.")
ONLY = option("PATTERN", "Use only the sockets that match this shell pattern; repeatable.")
WITHOUT = option("PATTERN", "Leave out the sockets that match this shell pattern; repeatable.")
CAPTURE_OUTPUT = output("FILE.h5", "Capture to write (HDF5).")
NOMINAL_ARM = argument(
    "ARM", "Nominal arm: a TOML file, a URDF, a kinematics.yaml, or the name of an arm that ships with aacmm."
)
BASE_LINK = option("LINK", "Link of a URDF that does not move. Default: its root.", "--base")
TIP_LINK = option("LINK", "Link at the end of a URDF. Default: the only one with no link after it.", "--tip")
_ENCODER = "the standard deviation of a joint reading"
_SEATING = "the standard deviation of the tip in its socket, for each coordinate"
_ESTIMATED, _OF_CLASS = "Default: estimated.", "Default: the arm file's [noise], or that of the arm's class."
ENCODER_NOISE = option("ARCSEC", f"Set {_ENCODER}.", default=0.0, min=0)
SEATING_NOISE = option("MM", f"Set {_SEATING}.", default=0.0, min=0)
KNOWN_ENCODER_NOISE = option("ARCSEC", f"State {_ENCODER}, for the weights. {_ESTIMATED}", min=0)
KNOWN_SEATING_NOISE = option("MM", f"State {_SEATING}. {_ESTIMATED}", min=0)
USUAL_ENCODER_NOISE = option("ARCSEC", f"Assume {_ENCODER}. {_OF_CLASS}", min=0)
USUAL_SEATING_NOISE = option("MM", f"Assume {_SEATING}. {_OF_CLASS}", min=0)
LINEAR_ENCODER_NOISE = option(
    "MM", "Do the same for prismatic joints. Default: what the other encoders are at a distance of 1 m.", min=0
)
REFERENCE_LENGTHS = option(
    "A,B[,U]",
    "Reference length between two sockets, u in mm; repeatable. Quote a name with a comma: '\"a, b\",C'.",
    "--length",
)
CALIBRATION_FILE = argument("CALIBRATION.h5", "Calibration, written by calibrate.")


def examples(*commands: str) -> str:
    """The end of a command's help: examples as they are typed, one a line, not wrapped."""
    word = "Examples" if len(commands) > 1 else "Example"
    lines = [line for command in commands for line in command.splitlines()]
    return "\n".join(["\b", f"{word}:", *(f"  {line}" for line in lines)])


def _version(wanted: bool) -> bool:
    if wanted:
        from importlib import metadata

        typer.echo(metadata.version("aacmm_jax"))
        raise typer.Exit()
    return wanted


@app.callback()
def prepare(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Calibrate articulated-arm coordinate measuring machines and other serial arms."""


def prepare_jax() -> None:
    """Before a command computes: on the CPU where JAX cannot start on what it is told to use, with a warning."""
    warning = prepare_command()
    if warning is not None:
        typer.echo(warning, err=True)


def with_spinner(what: str, work: Callable[[], Any]) -> Any:
    """Do work, with a spinner on standard error where that is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        return work()
    with console.status(f"{what} ..."):
        return work()


def show_summary(summary: dict[str, Any], as_json: bool, view: Callable[[dict[str, Any]], Iterable]) -> None:
    """Print a summary as JSON, or what people see of it."""
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
        return
    from .display import display

    display(view(_printable(summary)))


def _printable(item: Any) -> Any:
    """The same with every text printable: names from a file reach a terminal only through here."""
    if isinstance(item, str):
        return printable(item)
    if isinstance(item, dict):
        return {_printable(key): _printable(value) for key, value in item.items()}
    return [_printable(value) for value in item] if isinstance(item, list | tuple) else item


def check_numbers(arguments: Sequence[str]) -> None:
    """Refuse values of numeric options that only Python takes for numbers (1_0, digits of other scripts), and NaN."""
    command = next((info.callback for info in app.registered_commands if arguments[:1] == [_name(info)]), None)
    if command is None:
        return
    numeric = set()
    for name, parameter in inspect.signature(command).parameters.items():
        kinds = {parameter.annotation, *get_args(parameter.annotation)}
        if {int, float} & {kind for outer in kinds for kind in (outer, *get_args(outer))}:
            numeric |= set(parameter.default.param_decls or [f"--{name.replace('_', '-')}"])
    for word, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        value = value if equals else following
        if name in numeric and _is_pythons(value) and not (is_number(value) and math.isfinite(float(value))):
            raise InputError(f"{name} {quoted(value)} is not a finite number; write plain decimal digits.")


def _name(info: Any) -> str:
    return info.name or info.callback.__name__.replace("_", "-")


def _is_pythons(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def numbers_option(name: str, text: str, form: str, count: int | None = None) -> tuple[float, ...]:
    """Finite numbers that an option lists, separated by commas."""
    try:
        values = tuple(number(part.strip()) for part in text.split(","))
    except ValueError:
        bad_option(name, text, form)
    if count not in (None, len(values)):
        bad_option(name, text, form)
    if not all(map(math.isfinite, values)):
        raise InputError(f"{name} '{text}' holds a value that is not finite; give finite numbers.")
    return values


def sockets_option(texts: Sequence[str] | None) -> dict[str, tuple[float, ...]]:
    """Sockets from ``NAME=X,Y,Z``, mm."""
    points: dict[str, tuple[float, ...]] = {}
    for text in texts or ():
        name, _, point = text.rpartition("=")
        try:
            x, y, z = (number(part.strip()) for part in point.split(","))
        except ValueError:
            bad_option("--socket", text, "NAME=X,Y,Z in mm, for example A=400,200,300")
        if any(is_control(character) for character in name):
            raise InputError(f"--socket {quoted(text)} has a control character in its name; leave it out.")
        if name in points:
            raise InputError(f"socket '{name}' is given twice in --socket; give each its own name.")
        points[name] = (x, y, z)
    return points


def names_option(text: str) -> tuple[str, ...]:
    """Names that an option lists, separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def length_option(text: str) -> tuple:
    """A reference length from ``A,B`` or ``A,B,U``, mm; a name with a comma in it is put in double quotes."""
    start, end, *rest = [*next(csv.reader([text]), []), "", ""]
    u = rest[:-2]
    try:
        if not start or not end or len(u) > 1:
            raise ValueError
        return (start, end, *(number(part.strip()) for part in u))
    except ValueError:
        bad_option("--length", text, "A,B or A,B,U with u in mm")


def bad_option(option: str, text: str, form: str) -> NoReturn:
    """Refuse the value of an option."""
    raise InputError(f"{option} '{text}' is not of the form {form}.")


def warn_of_unusable(calibration: Path, record: Any) -> None:
    """Say on standard error that a calibration did not converge, or ended with a residual that no arm has."""
    if not record.converged or record.implausible_residual:
        reason = "the residual is that of no arm; see aacmm show." if record.converged else record.reason
        typer.echo(f"Warning: {calibration} is not a calibration that can be used: {reason}", err=True)


class Stopped(Exception):
    """Work was interrupted, and what is done is kept; the message says how to continue."""
