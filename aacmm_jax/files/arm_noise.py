"""The noise that an arm file states: a class, a published repeatability, or standard deviations."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeFloat, PositiveFloat, model_validator

from ..data.arm_classes import CLASSES, SEATING, ArmNoise, class_noise, noise_of_repeatability
from ..data.noise import Noise
from ..kinematics.arm import Arm
from .toml import Strict


class NoiseTable(Strict):
    """The table ``[noise]`` of an arm file."""

    arm_class: Annotated[Literal["measuring arm", "robot", "hobby arm"] | None, Field(alias="class")] = None
    repeatability_mm: PositiveFloat | None = None  # pose repeatability of ISO 9283
    encoder_arcsec: NonNegativeFloat | list[FiniteFloat] | None = None
    seating_mm: NonNegativeFloat | None = None
    source: str = ""

    @model_validator(mode="after")
    def _one_statement(self) -> "NoiseTable":
        if self.repeatability_mm is not None and self.encoder_arcsec is not None:
            raise ValueError("give repeatability_mm or encoder_arcsec; both say how precise the readings are.")
        return self


def stated_noise(arm: Arm, table: NoiseTable | None, default: str) -> ArmNoise:
    """The noise of a file's table; what it does not state is that of its class, by default ``default``.

    Raises:
        InputError: The numbers are none of this arm.
    """
    table = NoiseTable() if table is None else table
    name = table.arm_class or default
    seating = SEATING if table.seating_mm is None else table.seating_mm
    source = table.source or f"class {name}: {CLASSES[name].source}"
    if table.encoder_arcsec is not None:
        found = Noise(encoder_arcsec=table.encoder_arcsec, seating=seating)
    elif table.repeatability_mm is not None:
        found = noise_of_repeatability(arm, table.repeatability_mm, seating)
    else:
        found = Noise(encoder_arcsec=np.asarray(class_noise(arm, name).encoder_arcsec), seating=seating)
    found.check(arm.joints)
    return ArmNoise(name, found, source)
