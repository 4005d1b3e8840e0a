"""Commanded poses of ``correct``: their temperature, and the frame that they are in."""

from typing import Any

import numpy as np

from ..core.errors import InputError
from .arm_command import first_frame


def at_temperature(commanded: Any, calibrated: Any, temperature: float | None) -> np.ndarray:
    """The readings, with the temperature of an arm that expands."""
    from ..data.capture_data import check_temperatures
    from ..files.manifest_readings import stated_or_recorded
    from ..files.table_columns import TEMPERATURE
    from ..kinematics.arm import correction_names
    from ..kinematics.corrected_arm import loads_of
    from ..kinematics.recorded_kinds import Expansion

    torques = calibrated.corrections is not None and "torques" in calibrated.corrections.functions.columns
    if torques and loads_of(calibrated) is None:
        raise InputError(
            "the arm was calibrated with measured torques, but those of commanded poses are unknown without masses; "
            "calibrate with --model gravity, or with an arm whose masses are known."
        )
    if Expansion.words[0] not in correction_names(calibrated):
        if temperature is not None:
            raise InputError("the arm was calibrated without thermal expansion; leave out --temperature.")
        return commanded.q
    if commanded.temperature is None and temperature is None:
        raise InputError(
            "the arm was calibrated with its thermal expansion; give --temperature, or a column temperature_C."
        )
    table = str(commanded.table.path)
    column = None if commanded.temperature is None else commanded.temperature[:, None]
    recorded = stated_or_recorded(temperature, column, TEMPERATURE, table, len(commanded.q))
    assert recorded is not None
    check_temperatures("--temperature" if commanded.temperature is None else table, recorded)
    return calibrated.beside.laid_out(np.hstack([commanded.q, recorded]), ("thermometer",))


def in_first_frame(record: Any, poses: np.ndarray) -> np.ndarray:
    """Poses in the frame in which the Denavit-Hartenberg chain begins; of a URDF they are given in its base link."""
    urdf = record.recording.nominal.urdf
    return poses if urdf is None else np.linalg.inv(first_frame(record.recording.nominal)) @ poses
