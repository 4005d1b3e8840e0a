"""Makes the recordings of this folder anew, by simulation: python examples/simulated_robot/make.py."""

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import aacmm_jax as aj

FOLDER = Path(__file__).resolve().parent
BOX = ((250.0, -450.0, 150.0), (700.0, 450.0, 800.0))  # mm, where the tracker saw its target
STATION = (0.0, 0.0, 2.1, 2600.0, -1400.0, 450.0)  # the tracker in the base frame: rotation vector, origin in mm
TARGET = (31.0, -12.0, 64.0)  # mm, in the frame of tool0
ENCODER_ARCSEC, TRACKER_MM, SEAT_MM = 8.0, 0.02, 0.01


def main() -> None:
    """Write the tables that the manifests name."""
    for name, poses, seed in (("tracker", 80, 1), ("unseen", 40, 2)):
        _track(_robot((0, 0, 0)), FOLDER / f"{name}.csv", poses, seed)
    _touch()


def _robot(probe: Sequence[float]) -> aj.Arm:
    """The robot as built, up to 0.6 mm and 0.08 deg off its URDF but for the probe, mm in the frame of tool0."""
    nominal = aj.load_arm(FOLDER / "robot.urdf", tip="tool0", probe=probe)
    space = aj.Parameters.free_of(nominal, held=("d_1", "theta_1", "probe_x", "probe_y", "probe_z"))
    return aj.perturbed_arm(space, length=0.6, angle=math.radians(0.08), seed=3)


def _track(true: aj.Arm, path: Path, poses: int, seed: int) -> None:
    points = aj.data.observations.SimulatedPoints("tracker", BOX, poses, STATION, TRACKER_MM, "ball", TARGET)
    capture = aj.simulate(true, {}, observations=[points], encoder_arcsec=ENCODER_ARCSEC, seed=seed)
    (seen,) = capture.observations
    assert isinstance(seen, aj.data.observations.MeasuredPoints)
    table = np.hstack([np.degrees(seen.q), np.asarray(seen.points)])
    header = ",".join([*(f"J{joint} [deg]" for joint in range(1, 7)), "x [mm]", "y [mm]", "z [mm]"])
    np.savetxt(path, table, fmt=["%.5f"] * 6 + ["%.4f"] * 3, delimiter=",", header=header, comments="")


def _touch() -> None:
    manifest = tomllib.loads((FOLDER / "plate.toml").read_text())
    (plate,) = manifest["artefact"]
    turn, corner = math.radians(25.0), np.array([350.0, -200.0, 120.0])  # of the plate in the base frame; mm
    rotation = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1.0]])
    holes = {name: corner + rotation @ np.array(place, float) for name, place in plate["coordinates"].items()}
    capture = aj.simulate(
        _robot(manifest["probe"]), holes, poses=8, encoder_arcsec=ENCODER_ARCSEC, seating=SEAT_MM, seed=4
    )
    for name, q in capture.sockets.items():
        path = FOLDER / plate["files"][name]
        path.parent.mkdir(exist_ok=True)
        np.savetxt(path, np.degrees(np.asarray(q)), fmt="%.5f", delimiter=",")


if __name__ == "__main__":
    main()
