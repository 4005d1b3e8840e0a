"""Options of ``calibrate`` that together make the free parameters and their box."""

import math
from collections.abc import Sequence

from ..core.errors import InputError
from ..data.noise import Noise
from ..kinematics.arm import is_length
from ..kinematics.parameters import Bounds, Parameters
from ..kinematics.specification import ArmSpecification


def bounds(
    nominal: ArmSpecification,
    held: str | None,
    free: str | None,
    length_mm: float | None,
    angle_deg: float | None,
    single: Sequence[str],
) -> Bounds:
    """The box: what the arm's file proposes, changed by what the command line says."""
    names, released = (nominal.held, nominal.free) if held is None else (_names(held), ())
    space = Parameters.free_of(nominal.arm, held=names, free=dict.fromkeys((*released, *_names(free or ""))))
    override = {name: width for name, width in nominal.override.items() if name in space.names}
    for text in single:
        name, _, width = text.partition("=")
        try:
            value = float(width)
        except ValueError as error:
            raise InputError(f"--bound '{text}' is not of the form NAME=WIDTH, in mm or deg.") from error
        override[name] = value if is_length(name) else math.radians(value)
    return Bounds.around(
        space.base,
        space,
        length=nominal.length if length_mm is None else length_mm,
        angle=nominal.angle if angle_deg is None else math.radians(angle_deg),
        override=override,
    )


def noise(encoder_arcsec: float | None, seating_mm: float | None) -> Noise | None:
    """The noise that is known: both of its parts, or none."""
    if encoder_arcsec is None and seating_mm is None:
        return None
    if encoder_arcsec is None or seating_mm is None:
        missing = "--seating-mm" if seating_mm is None else "--encoder-arcsec"
        raise InputError(f"{missing} is missing: give both standard deviations, or neither to have both estimated.")
    return Noise(encoder_arcsec=encoder_arcsec, seating=seating_mm)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())
