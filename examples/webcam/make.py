"""Makes this folder's readings and images anew, by simulation: python examples/webcam/make.py (needs the extra camera).

The true arm differs from its nominal parameters: zeros of the servos by 1 deg, lengths by 1 mm (largest). All that is
random is drawn from fixed seeds.
"""

import json
import math
from pathlib import Path

import cv2
import numpy as np

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix

FOLDER = Path(__file__).resolve().parent
POSES = 18  # with an image each
BOARD = aj.camera.Charuco(7, 5, 20.0, 15.0, "4x4_50")
SIZE = (640, 480)  # px
INTRINSICS = (612.0, 614.0, 322.0, 237.0, 0.08, -0.15, 0.001, -0.0005, 0.0)
MOUNT = (3.0, 18.0, 46.0, 1.75, 0.04, -0.03)  # of the camera in the last frame: mm, rotation vector in rad
FRAME = (math.pi, 0.03, 0.0, -72.0, -205.0, 3.0)  # of the board in the base frame: rotation vector in rad, mm
SERVO = math.radians(0.05)  # standard deviation of a reading
PRINTED = 0.998  # the printer's scale, which the bar in the manifest shows
OPTICS = aj.camera.Optics(blur=0.9, noise=1.5, shading=0.3)


def true_arm() -> aj.Arm:
    """The arm as it was built."""
    nominal = aj.load_arm("so100")
    space = aj.Parameters.free_of(nominal, held=("probe_x", "probe_y", "probe_z", "d_2", "d_3"))
    return aj.perturbed_arm(space, length=1.0, angle=math.radians(1.0), seed=5)


def main() -> None:
    """Write readings, images and the truth."""
    arm, random = true_arm(), np.random.default_rng(7)
    board = BOARD.scaled_by_bar(100.0, 100.0 * PRINTED, 0.0)
    eye = aj.data.observations.SimulatedPixels(
        "webcam", 4 * POSES, "webcam", "board", board.points, INTRINSICS, SIZE, mount=MOUNT, frame=FRAME,
        distance=(190.0, 300.0), tilt=0.8,
    )  # fmt: skip
    seen = aj.simulate(arm, {}, observations=[eye], seed=2).observations[0]
    held = np.vstack([np.column_stack([rotation_matrix(np.array(MOUNT[3:])), MOUNT[:3]]), [0, 0, 0, 1]])
    still = np.vstack([np.column_stack([rotation_matrix(np.array(FRAME[:3])), FRAME[3:]]), [0, 0, 0, 1]])
    camera = np.asarray(arm.pose(seen.q)) @ held
    above = np.flatnonzero(camera[:, 2, 3] > 80.0)[:POSES]  # mm over the table
    images = FOLDER / "images"
    images.mkdir(exist_ok=True)
    rows = ["image,J1 [deg],J2 [deg],J3 [deg],J4 [deg],J5 [deg]"]
    for number, pose in enumerate(above, start=1):
        transform = np.linalg.inv(camera[pose]) @ still
        image = aj.camera.render(board, transform, "pinhole", np.array(INTRINSICS), SIZE, optics=OPTICS, seed=number)
        name = f"{number:02d}.jpg"
        cv2.imwrite(str(images / name), image, [cv2.IMWRITE_JPEG_QUALITY, 75])
        read = np.degrees(np.asarray(seen.q)[pose] + SERVO * random.standard_normal(5))
        rows.append(",".join([name, *(f"{angle:.3f}" for angle in read)]))
    (FOLDER / "joints.csv").write_text("\n".join(rows) + "\n")
    truth = {"mount": MOUNT, "board": FRAME, "intrinsics": INTRINSICS, "scale": PRINTED}
    truth["parameters"] = {name: np.asarray(getattr(arm, name)).tolist() for name in ("alpha", "a", "d", "theta")}
    (FOLDER / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


if __name__ == "__main__":
    main()
