"""The arm and its noise as options of the command line state them."""

from collections.abc import Sequence
from typing import Any

from .. import data
from ..core.errors import InputError
from ..core.units import DEG
from . import options
from .options import names_option


def with_parameters(nominal: Any, held: str | None, free: str | None) -> Any:
    """The arm with the parameters that the command line fixes and frees; what is freed there, its file may fix."""
    if held is None and free is None:
        return nominal
    freed = names_option(free or "")
    fixed = nominal.held if held is None else names_option(held)
    if fixed is not None and held is None:
        fixed = tuple(name for name in fixed if name not in freed)
    freed = [*(name for name in nominal.free if name not in (fixed or ())), *freed]
    return nominal._replace(held=fixed, free=tuple(dict.fromkeys(freed)), stated=tuple({*nominal.stated, "parameters"}))


def with_fixed_arm(nominal: Any, held: str | None, free: str | None) -> Any:
    """The arm without a parameter to identify."""
    from ..kinematics.arm import parameter_names

    if held is not None or free is not None:
        raise InputError("--arm-fixed holds all parameters; leave out --held and --free.")
    return nominal._replace(
        held=tuple(parameter_names(nominal.arm)), free=(), override={}, stated=tuple({*nominal.stated, "parameters"})
    )


def bounded(nominal: Any, length_mm: float | None, angle_deg: float | None, bounds: Sequence[str]) -> Any:
    """The arm with the bounds of its parameters, as its file or the command line says."""
    from ..kinematics.arm import is_length

    widths = options.numbers_by_name("--bound", bounds, "NAME=WIDTH, in mm or deg", 1)
    of_bounds = {name: width if is_length(name) else width * DEG for name, (width,) in widths.items()}
    identified = nominal.space().names
    by_hand = bool(bounds) or length_mm is not None or angle_deg is not None
    return nominal._replace(
        stated=tuple({*nominal.stated, "bounds"}) if by_hand else nominal.stated,
        length=nominal.length if length_mm is None else length_mm,
        angle=nominal.angle if angle_deg is None else angle_deg * DEG,
        override={name: width for name, width in nominal.override.items() if name in identified} | of_bounds,
    )


def known_noise(encoder_arcsec: float | None, seating_mm: float | None, linear_encoder_mm: float | None) -> Any:
    """The noise that is known: encoders and seat, or None."""
    if encoder_arcsec is None and seating_mm is None and linear_encoder_mm is None:
        return None
    if encoder_arcsec is None or seating_mm is None:
        missing = "--seating-mm" if seating_mm is None else "--encoder-arcsec"
        raise InputError(
            f"{missing} is missing; give both standard deviations, or leave out both to have them estimated."
        )
    return data.Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm, linear_encoder=linear_encoder_mm)
