"""Options: how they are declared, those of several commands, and how the texts given for them are read."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import typer

from .. import data, files
from ..core.errors import InputError
from ..core.jax_setup import LARGEST_INTEGER
from ..core.text import is_control, is_number, number, quoted
from ..files.outputs import write_text


def argument(help: str, metavar: str, default: Any = ...) -> Any:
    """An argument of a command, as the default of the function's parameter."""
    return typer.Argument(default, metavar=metavar, help=help)


def option(help: str, metavar: str | None = None, *names: str, default: Any = None, **limits: Any) -> Any:
    """An option: what it does, the word for its value (None: its choices, or the unit that the parameter's name ends
    in), and its names if not the parameter's."""
    return typer.Option(default, *names, metavar=metavar, help=help, **limits)


def flag(name: str, help: str) -> Any:
    """An option without a value."""
    return typer.Option(False, name, help=help)


def output(help: str, metavar: str, default: Any = ...) -> Any:
    """The option -o."""
    kept = " An existing file that aacmm did not write is replaced only with --overwrite."
    return option(help + kept, metavar, "--output", "-o", default=default)


def seed(subject: str) -> Any:
    """The option --seed."""
    return option(f"Seed of {subject}.", "N", default=0, min=0, max=LARGEST_INTEGER)


JSON = flag("--json", "Print one JSON object on standard output, and nothing else.")
ONLY = option("Use only the sockets whose names match this shell pattern; may be given several times.", "PATTERN")
WITHOUT = option("Leave out the sockets whose names match this shell pattern; may be given several times.", "PATTERN")
CALIBRATION_FILE = argument("Calibration, written by aacmm calibrate.", "CALIBRATION.h5")
NOMINAL_ARM = argument(
    "Nominal arm: a TOML file, URDF, MJCF (.xml), kinematics.yaml or calibration.conf (Universal Robots), or the name "
    "of an arm that ships with aacmm.",
    "ARM",
)
ABOUT = option("Administrative data of a certificate: laboratory, customer, item, persons, dates.", "FILE.toml")
EVALUATION = option(
    "Evaluation of this calibration, written by aacmm evaluate -o; its acceptance tests are added to the certificate.",
    "FILE.h5",
)
BASE_LINK = option("Fixed base link of the arm, of a URDF or MJCF. Default: the root (MJCF: world).", "LINK", "--base")
TIP_LINK = option(
    "Last link (MJCF: body or site) of the arm; repeat for a robot of several chains. Default: all links or bodies "
    "without a child, one for each chain of joints.",
    "LINK",
    "--tip",
)
_ENCODER = "the standard deviation of a joint reading"
_SEATING = "the standard deviation of the tip in its socket, for each coordinate"
_ESTIMATED, _OF_CLASS = (
    "Default: estimated.",
    "Default: the value in [noise] of the arm file, otherwise the value for the class of the arm.",
)
ENCODER_NOISE = option(f"Set {_ENCODER}.", default=0.0, min=0)
SEATING_NOISE = option(f"Set {_SEATING}.", default=0.0, min=0)
KNOWN_ENCODER_NOISE = option(f"State {_ENCODER}, for weighting the data. {_ESTIMATED}", min=0)
KNOWN_SEATING_NOISE = option(f"State {_SEATING}. {_ESTIMATED}", min=0)
USUAL_ENCODER_NOISE = option(f"Assume {_ENCODER}. {_OF_CLASS}", min=0)
USUAL_SEATING_NOISE = option(f"Assume {_SEATING}. {_OF_CLASS}", min=0)
LINEAR_ENCODER_NOISE = option(
    "Standard deviation of a reading of a prismatic joint. Default: the displacement at a distance of 1 m that "
    "corresponds to the standard deviation of the rotary encoders.",
    min=0,
)
REFERENCE_LENGTHS = option(
    "Reference length between two sockets, with its standard uncertainty U in mm; may be given several times. Put a "
    "name that contains a comma in double quotes: '\"a, b\",C'.",
    "A,B[,U]",
    "--length",
)


RESIDUALS = option(
    "Write the residual of every pose to this file (CSV): observation, pose, used or held out, residual x, y, z in the "
    "base frame, distance and its predicted standard uncertainty.",
    "FILE.csv",
)


def share_or_name(text: str | None) -> float | str | None:
    """A share where the text is a number, otherwise a name."""
    return number(text) if text is not None and is_number(text) else text


def write_residuals(path: Path, record: Any) -> None:
    """Write the residual of every pose of a calibration or an evaluation."""
    from ..pipeline.hold_out import residuals_of
    from ..summaries.observations import residuals_csv

    write_text(path, residuals_csv(residuals_of(record)))


def bad_option(option: str, text: str, form: str) -> NoReturn:
    """Refuse the value of an option."""
    raise InputError(f"{option} '{text}' is not of the form {form}.")


def check_figure(path: Path | None) -> None:
    """Refuse a figure that cannot be drawn, before any work."""
    if path is not None:
        from ..plot.figures import check_format

        check_format(path)


def names_option(text: str) -> tuple[str, ...]:
    """Names that an option lists, separated by commas."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def numbers_option(option: str, text: str, form: str, count: int | None = None) -> tuple[float, ...]:
    """Finite numbers that an option lists, separated by commas."""
    values = _numbers(option, text, text, form, count)
    if not all(map(math.isfinite, values)):
        raise InputError(f"{option} '{text}' contains a value that is not finite; give finite numbers.")
    return values


def _numbers(option: str, text: str, part: str, form: str, count: int | None) -> tuple[float, ...]:
    """The numbers in a part of what is given for an option."""
    try:
        values = tuple(number(word.strip()) for word in part.split(","))
    except ValueError:
        bad_option(option, text, form)
    if count not in (None, len(values)):
        bad_option(option, text, form)
    return values


def numbers_by_name(
    option: str, texts: Sequence[str] | None, form: str, count: int, *, named: bool = True
) -> dict[str, tuple[float, ...]]:
    """So many numbers by name: ``NAME=1,2,3``; unless all are ``named`` also ``1,2,3``, by the name ""."""
    by_name: dict[str, tuple[float, ...]] = {}
    for text in texts or ():
        name, equals, values = text.rpartition("=")
        if named and not equals:
            bad_option(option, text, form)
        if any(is_control(character) for character in name):
            raise InputError(f"{option} {quoted(text)} has a control character in its name; remove the character.")
        if name in by_name:
            raise InputError(f"{option} is given twice for {repr(name) if name else 'all sockets'}; give it once.")
        by_name[name] = _numbers(option, text, values, form, count)
    return by_name


def sockets_option(texts: Sequence[str] | None) -> dict[str, tuple[float, ...]]:
    """Sockets from ``NAME=X,Y,Z``, mm."""
    return numbers_by_name("--socket", texts, "NAME=X,Y,Z in mm, for example A=400,200,300", 3)


def length_option(text: str) -> tuple:
    """A reference length from ``A,B`` or ``A,B,U``, mm; a name with a comma in it is put in double quotes."""
    form = "A,B or A,B,U with u in mm"
    names = next(csv.reader([text]), [])
    if len(names) not in (2, 3) or not all(names[:2]):
        bad_option("--length", text, form)
    return (*names[:2], *(_numbers("--length", text, u, form, 1)[0] for u in names[2:]))


def assumed_noise(
    arm: str, links: Mapping[str, Any], encoder: float | None, seating: float | None, linear: float | None = None
) -> Any:
    """The noise of an arm that has not been calibrated (`ArmNoise`): what options give, arcsec and mm, else what its
    file states, else that of its class."""
    assumed = files.load_noise(arm, **links)
    stated = data.Noise(
        encoder_arcsec=assumed.noise.encoder_arcsec if encoder is None else encoder,
        seating=assumed.noise.seating if seating is None else seating,
        linear_encoder=assumed.noise.linear_encoder if linear is None else linear,
    )
    return assumed._replace(noise=stated, source=assumed.source if encoder is None else "as given")
