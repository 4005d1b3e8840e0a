"""What all commands share: the application, and how results are printed."""

import contextlib
import inspect
import json
import math
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib import metadata
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, get_args, get_type_hints

import typer
import typer.core

from ..core.errors import InputError, naming
from ..core.jax_setup import prepare_command
from ..core.text import in_short, is_number, printable, quoted

_OWN_CORRECTIONS = "AACMM_CORRECTIONS"  # environment variable: a Python file


class Stopped(Exception):
    """Work was interrupted, and what is done is kept; the message says how to continue."""


class _Commands(typer.core.TyperGroup):
    """The commands; what typer says of wrong options is printable and no longer than people read."""

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        with _said_in_short():
            return super().make_context(*arguments, **options)

    def invoke(self, ctx: Any) -> Any:
        with _said_in_short():
            return super().invoke(ctx)


class _Command(typer.core.TyperCommand):
    """A command whose options of one value are given at most once: click would take the last and drop the others."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        given = self.make_parser(ctx).parse_args(args=list(args))[2]
        for parameter, times in Counter(given).items():
            if times > 1 and parameter.param_type_name == "option" and not parameter.multiple:
                raise InputError(f"{parameter.opts[0]} is given {times} times, but has one value; give it once.")
        return super().parse_args(ctx, args)


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
    epilog="Every command accepts --help, --debug (shows the traceback of a failure) and --overwrite (replaces files "
    "that aacmm did not write). The environment variable AACMM_CORRECTIONS names a Python file with joint corrections "
    "of your own. Start with: aacmm demo",
)


def _version(wanted: bool) -> bool:
    if wanted:
        typer.echo(metadata.version("aacmm_jax"))
        raise typer.Exit()
    return wanted


@app.callback()
def prepare(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    """Calibrate articulated-arm coordinate measuring machines and other serial arms."""


def check_numbers(arguments: Sequence[str]) -> None:
    """Refuse values of numeric options that only Python takes for numbers (1_0, digits of other scripts), and NaN."""
    numeric = set()
    for info in app.registered_commands:
        callback: Any = info.callback
        if arguments[:1] == [info.name or callback.__name__.replace("_", "-")]:
            parameters = inspect.signature(callback).parameters
            for name, hint in get_type_hints(callback).items():
                if {int, float} & {hint, *get_args(hint)}:
                    numeric |= set(parameters[name].default.param_decls or [f"--{name.replace('_', '-')}"])
    for argument, following in zip(arguments, [*arguments[1:], ""], strict=True):
        option, equals, value = argument.partition("=")
        value = value if equals else following
        try:
            finite = math.isfinite(float(value))
        except ValueError:
            continue  # what Python cannot read as a number, typer refuses
        if option in numeric and not (finite and is_number(value)):
            raise InputError(f"{option} {quoted(value)} is not a finite number; give a number in decimal digits.")


def examples(*commands: str) -> str:
    """The end of a command's help: examples as they are typed, one a line, not wrapped."""
    word = "Examples" if len(commands) > 1 else "Example"
    lines = [line for command in commands for line in command.splitlines()]
    return "\n".join(["\b", f"{word}:", *(f"  {line}" for line in lines)])


def command(*typed: str, name: str | None = None) -> Callable[[Any], Any]:
    """A command, named as its function or ``name``, with examples as they are typed."""

    def register(function: Any) -> Any:
        for parameter, value in inspect.signature(function).parameters.items():
            unit = parameter.rpartition("_")[2]
            if unit in ("mm", "deg", "arcsec") and value.default.metavar is None:
                value.default.metavar = unit.upper()
        return app.command(name, cls=_Command, epilog=examples(*typed))(function)

    return register


def prepare_jax() -> None:
    """Before a command computes: on the CPU where JAX cannot start on what it is told to use, with a warning."""
    warning = prepare_command()
    if warning is not None:
        typer.echo(warning, err=True)


def register_own_corrections() -> None:
    """Run the Python file that the environment names, which registers joint corrections of the user's own."""
    path = os.environ.get(_OWN_CORRECTIONS)
    if not path:
        return
    loader = SourceFileLoader("own_corrections", path)
    module = ModuleType(loader.name)
    module.__file__ = os.path.abspath(path)
    sys.modules[loader.name] = module
    try:
        with naming(f"{path} ({_OWN_CORRECTIONS})"):
            loader.exec_module(module)
    except InputError:
        raise
    except Exception as error:
        what = f"{type(error).__name__}: {error}"
        raise InputError(
            f"{path}, the file that {_OWN_CORRECTIONS} names, cannot be run: {what}; correct it."
        ) from error


def with_spinner(what: str, work: Callable[[], Any]) -> Any:
    """Do work, with a spinner on standard error where that is a terminal."""
    from rich.console import Console

    console = Console(stderr=True)
    with console.status(f"{what} ...") if console.is_terminal else contextlib.nullcontext():
        return work()


@contextlib.contextmanager
def progress_bar(*columns: Any, transient: bool = False) -> Iterator[Any]:
    """A bar of rich with these columns on standard error, where that is a terminal; None elsewhere."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    bars = Progress(*columns, console=console, transient=transient)
    with bars if console.is_terminal else contextlib.nullcontext() as bar:
        yield bar


def read_with_progress(manifest: Path, overlays: Path | None = None) -> Any:
    """The recording of a manifest, with a bar while images are read."""
    from ..files.manifest import read_manifest

    with progress_bar(transient=True) as bar:
        return read_manifest(manifest, progress=tracked(bar), overlays=overlays)


def read_recording(path: Path) -> Any:
    """The recording of a capture, with the digest of its file first among its sources, or of a manifest."""
    from ..files.captures import load_capture
    from ..files.inputs import InputFile, fingerprint

    if path.suffix == ".toml":
        return read_with_progress(path)
    recording = load_capture(read := InputFile(path))
    return recording._replace(sources=(fingerprint(read), *recording.sources))


def tracked(bar: Any) -> Callable[[Sequence[Any], str], Iterable[Any]]:
    """What yields items and shows on a bar how many are done, where there is one."""
    return lambda items, what: items if bar is None else bar.track(items, description=what)


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


def warn_of_unusable(calibration: Path, record: Any, force: bool = True) -> None:
    """Say on standard error that a calibration is not to be used, and why; without ``force``, refuse it."""
    from ..diagnostics.usability import why_unusable

    reason = why_unusable(record)
    if reason is None:
        return
    if not force:
        raise InputError(
            f"the calibration in {calibration} is not usable: {reason}; calibrate again, or give --force to export it "
            "all the same."
        )
    typer.echo(f"Warning: the calibration in {calibration} is not usable: {reason}.", err=True)
