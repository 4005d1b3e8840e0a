"""Commanded poses of ``correct``: the tip that they are of, their temperature, and the frame that they are in."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..core.errors import InputError
from ..core.text import printable
from ..files.inputs import InputFile
from .arm_command import first_frame
from .options import numbers_option

if TYPE_CHECKING:  # --help loads neither JAX nor readers of tables
    from ..data.recording import RecordedAs
    from ..files.text_lines import Column


def targets_of(record: Any, chain: Any) -> dict[str, np.ndarray]:
    """Positions in the last frame that the calibration has found, mm, by the name of the target; of a robot, those on
    the chain."""
    from ..data.observations.observation import offset_of

    found, geometry = {}, record.observed.geometry
    for observation in record.recording.capture.observations:
        part, q = offset_of(observation.target or ""), np.asarray(observation.q)
        if part in geometry and (chain is None or (q[:, chain.robot_joints] == chain.number).any()):
            found[observation.target] = np.asarray(geometry[part])[:3]
    return found


def tool_tip(record: Any, chain: Any, probe: str) -> np.ndarray:
    """The tip that ``--probe`` gives in the last frame, mm: X,Y,Z, or the name of a target of the calibration."""
    targets = targets_of(record, chain)
    if probe in targets:
        return targets[probe]
    names = ", ".join(map(printable, targets)) or "none"
    return np.array(numbers_option("--probe", probe, f"X,Y,Z in mm, or a target of the calibration ({names})", 3))


def other_tip(record: Any, chain: Any, meant: np.ndarray) -> list[str]:
    """That positions are those of another point than the targets whose positions were calibrated, where they are."""
    targets = targets_of(record, chain).items()
    targets = {name: at for name, at in targets if not np.allclose(at, meant, rtol=0, atol=1e-3)}
    if not targets:
        return []
    of = ", ".join(f"{printable(name)} ({_mm(at)})" for name, at in targets.items())
    first = printable(next(iter(targets)))
    return [
        f"The positions are those of the arm's tip, ({_mm(meant)}) mm in the last frame, not those of the measured "
        f"target, which the calibration found elsewhere in this frame [mm]: {of}. If the target is to reach the "
        f"positions, give --probe {first}; for a tool, give --probe X,Y,Z."
    ]


def _mm(point: np.ndarray) -> str:
    return ", ".join(f"{x:.3f}" for x in point)


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


def names_of_frames(record: Any) -> dict[str, str]:
    """The frames that ``--in-frame`` may name, as parts of the geometry: by the name of the station, board or
    placement, or of an observation."""
    from ..summaries.observations import frames_in_base

    frames = frames_in_base(record)
    return {part.removeprefix("frame of ").removeprefix("placement "): part for part in frames.values()} | frames


def named_frame(record: Any, name: str) -> np.ndarray:
    """The frame that ``--in-frame`` names: takes positions in it to the first frame of the arm; 4 x 4, mm."""
    from ..calibration.reprojection import frame_of

    names = names_of_frames(record)
    if name not in names:
        known = ", ".join(map(printable, names)) or "none"
        raise InputError(f"--in-frame {name} is not a frame of the calibration; give one of its frames ({known}).")
    return frame_of(np.asarray(record.observed.geometry[names[name]]))


def targets_words(record: Any, commanded: Any, name: str | None) -> str:
    """What the targets were taken to be: poses of the nominal arm, or positions in a frame."""
    other, frame = "", printable(next(iter(names_of_frames(record)), ""))
    if frame and name is None:
        other = f" If the targets are positions in the frame of {frame}, give --in-frame {frame}."
    if commanded.poses is None:
        return f"Targets: the poses that the nominal arm has in its base frame at the readings of the table.{other}"
    table = commanded.table
    columns = [table.header[i] if table.header else str(i + 1) for i in commanded.position]
    where = "the base frame" if name is None else f"the frame of {printable(name)}"
    begin = "of the table" if commanded.columns else "given by --near"
    kept = "" if commanded.oriented else ", whose orientation on the nominal arm is kept"
    return (
        f"Targets: positions (columns {', '.join(map(printable, columns))}) in {where}; the search starts from the "
        f"readings {begin}{kept}.{other}"
    )


def in_first_frame(record: Any, poses: np.ndarray) -> np.ndarray:
    """Poses in the frame in which the Denavit-Hartenberg chain begins; of a URDF they are given in its base link."""
    urdf = record.recording.nominal.urdf
    return poses if urdf is None else np.linalg.inv(first_frame(record.recording.nominal)) @ poses


def written_as(record: Any, unit: str | None) -> "RecordedAs":
    """How the readings of a calibration were recorded, for ``--as-recorded``. Raises `InputError` where it is not
    known."""
    if unit is not None:
        raise InputError("--as-recorded applies the unit of the recording; leave out --unit.")
    if record.recording.recorded_as is None:
        raise InputError(
            "--as-recorded needs to know how the readings were recorded, but the calibration does not contain it, as "
            "those of simulations, robots of several chains or several captures; calibrate from one manifest, or give "
            "joint values without --as-recorded."
        )
    return record.recording.recorded_as


def columns_as_recorded(file: InputFile, written: "RecordedAs") -> "list[Column] | None":
    """The columns of the recording, where a table has columns of such names."""
    from ..files.text_table import TextTable

    table = TextTable(file)
    return list(written.names) if table.header and table.has(written.names) else None
