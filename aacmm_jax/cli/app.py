"""What all commands share: the application, common arguments and options, checks, and how results are printed."""

import contextlib
import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NoReturn, get_args, get_type_hints

import typer
import typer.core

from ..core.backend import prepare_command
from ..core.errors import InputError
from ..core.text import in_short, is_control, is_number, number, printable, quoted


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

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else.")]

Only = Annotated[
    list[str] | None,
    typer.Option("--only", metavar="PATTERN", help="Use only the sockets that match this shell pattern; repeatable."),
]

Without = Annotated[
    list[str] | None,
    typer.Option(
        "--without", metavar="PATTERN", help="Leave out the sockets that match this shell pattern; repeatable."
    ),
]

KEPT = " An existing file that aacmm did not write is kept unless --overwrite."  # of what -o names

CaptureOutput = Annotated[
    Path, typer.Option("--output", "-o", metavar="FILE.h5", help="Capture to write (HDF5)." + KEPT)
]

NominalArm = Annotated[
    str,
    typer.Argument(
        metavar="ARM",
        help="Nominal arm: a TOML file, a URDF, a kinematics.yaml, or the name of an arm that ships with aacmm.",
    ),
]

BaseLink = Annotated[
    str | None,
    typer.Option("--base", metavar="LINK", help="Of a URDF: the link that does not move. Default: its root."),
]

TipLink = Annotated[
    str | None,
    typer.Option(
        "--tip", metavar="LINK", help="Of a URDF: the link at the end. Default: the only one with no link after it."
    ),
]

EncoderNoise = Annotated[
    float, typer.Option("--encoder-arcsec", min=0, metavar="ARCSEC", help="Standard deviation of a joint reading.")
]

KnownEncoderNoise = Annotated[
    float | None,
    typer.Option(
        "--encoder-arcsec",
        min=0,
        metavar="ARCSEC",
        help="Known standard deviation of a joint reading, for the weights. Default: estimated.",
    ),
]

KnownSeatingNoise = Annotated[
    float | None,
    typer.Option(
        "--seating-mm",
        min=0,
        metavar="MM",
        help="Known standard deviation of the tip in its socket, for each coordinate. Default: estimated.",
    ),
]

LinearEncoderNoise = Annotated[
    float | None,
    typer.Option(
        "--linear-encoder-mm",
        min=0,
        metavar="MM",
        help="The same of prismatic joints. Default: what the other encoders are at a distance of 1 m.",
    ),
]

SeatingNoise = Annotated[
    float,
    typer.Option(
        "--seating-mm", min=0, metavar="MM", help="Standard deviation of the tip in its socket, for each coordinate."
    ),
]

ReferenceLengths = Annotated[
    list[str] | None,
    typer.Option(
        "--length",
        metavar="A,B[,U]",
        help="Reference length between two sockets, u in mm; repeatable. Quote a name with a comma: '\"a, b\",C'.",
    ),
]

CalibrationFile = Annotated[Path, typer.Argument(metavar="CALIBRATION.h5", help="Calibration, written by calibrate.")]


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
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
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


def show_summary(summary: dict[str, Any], as_json: bool, display: Callable[[dict[str, Any]], None]) -> None:
    """Print a summary as JSON, or with the function that prints it for people."""
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        display(_printable(summary))


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
    for name, hint in get_type_hints(command, include_extras=True).items():
        inner = {kind for part in (hint, *get_args(hint)) for kind in (part, *get_args(part))}
        if inner & {int, float} or any({int, float} & set(get_args(kind)) for kind in inner):
            named = [text for item in inner for text in getattr(item, "param_decls", None) or ()]
            numeric |= set(named or [f"--{name.replace('_', '-')}"])
    for option, following in zip(arguments, [*arguments[1:], ""], strict=True):
        name, equals, value = option.partition("=")
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


def warn_of_unusable(calibration: Path, record: Any) -> None:
    """Say on standard error that a calibration did not converge, or ended with a residual that no arm has."""
    if not record.converged or record.implausible_residual:
        reason = "the residual is that of no arm; see aacmm show." if record.converged else record.reason
        typer.echo(f"Warning: {calibration} is not a calibration that can be used: {reason}", err=True)


def bad_option(option: str, text: str, form: str) -> NoReturn:
    """Refuse the value of an option."""
    raise InputError(f"{option} '{text}' is not of the form {form}.")


class Stopped(Exception):
    """Work was interrupted, and what is done is kept; the message says how to continue."""
