"""The reference of the command line: what every command's ``--help`` says, as a page."""

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import get_args

import typer
from api_pages import write_if_changed
from typer.main import get_command

from aacmm_jax import cli
from aacmm_jax.cli.app import app as program

PAGE = Path(__file__).resolve().parents[1] / "reference" / "command_line.md"
OPENING = """# Command line

`aacmm COMMAND --help` says the same on a terminal. Lengths are in mm; angles are in the unit that an option's name
says. Exit codes: 0 done, 1 not achieved, 2 bad input, 130 interrupted, 141 the reader closed the output. `--debug`
shows the traceback of an error. Every command replaces its own output when it runs again, but a file that aacmm did not
write as what it writes now only with `--overwrite`.
"""


def _commands() -> dict[str, object]:
    """All commands in the order of ``aacmm --help``."""
    for family in cli._FAMILIES:
        import_module(f"aacmm_jax.cli.{family}")
    group = get_command(program)
    context = typer.Context(group, info_name="aacmm")
    return {name: group.get_command(context, name) for name in group.list_commands(context)}


def _help(text: str) -> str:
    """The text of a command; what stands after a line with a backspace sign is shown as it is typed."""
    parts = []
    for paragraph in inspect.cleandoc(text).split("\n\n"):
        if paragraph.startswith("\b"):
            title, *lines = paragraph.splitlines()[1:]
            parts.append("\n".join([title, "", "```bash", *(line.strip() for line in lines), "```"]))
        else:
            parts.append(_options_as_code(paragraph))
    return "\n\n".join(parts)


def _options_as_code(text: str) -> str:
    """Options in code type, in which two hyphens are no dash."""
    return re.sub(r"(?<![`\w-])--[a-z][a-z-]*[a-z]", r"`\g<0>`", text)


def _escaped(text: str) -> str:
    for character in "|*_<[":
        text = text.replace(character, "\\" + character)
    return _options_as_code(text)


def _choices(parameter) -> str:
    """The values that an option takes, or the word for one."""
    annotation = parameter.type_descriptor.annotation
    parts = [part for inner in (annotation, *get_args(annotation)) for part in get_args(inner)]
    words = [part for part in parts if isinstance(part, str)]
    words = words or [part for part in get_args(annotation) if isinstance(part, str)]
    return "|".join(dict.fromkeys(words)) or "VALUE"


def _parameter(parameter) -> str:
    """One argument or option: its names, the word for its value, its default, and what it does."""
    if parameter.param_type_name == "argument":
        names, value = f"`{parameter.metavar or parameter.name.upper()}`", ""
    else:
        names = ", ".join(f"`{name}`" for name in [*parameter.opts, *parameter.secondary_opts])
        value = "" if parameter.is_flag else f" `{parameter.metavar or _choices(parameter)}`"
    required = "; required" if parameter.required else ""
    shown = (
        parameter.default is not None
        and not getattr(parameter, "is_flag", False)
        and parameter.default not in ((), [], "")
    )
    default = f" Default: `{parameter.default}`." if shown and not callable(parameter.default) else ""
    return f"{names}{value}{required}\n: {_escaped(parameter.help or '')}{default}\n"


def page() -> str:
    """The whole page."""
    parts = [OPENING]
    for name, command in _commands().items():
        parts.append(f"## aacmm {name}\n\n{_help(command.help or '')}\n")
        parts.append(f"{_help(command.epilog or '')}\n")
        parameters = [
            parameter
            for parameter in command.params
            if parameter.name != "help" and not getattr(parameter, "hidden", False)
        ]
        parts.append("\n".join(map(_parameter, parameters)))
    return "\n".join(parts)


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.connect("builder-inited", lambda app: write_if_changed(PAGE, page()))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
