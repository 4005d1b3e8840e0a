"""Hand-eye calibration by OpenCV 4, in its own environment (OpenCV 5 has none): IN.npz OUT.npz.

The poses of the flange in the base (``flange``) and of a target in an instrument's frame (``seen``), n x 4 x 4 in mm,
give the target on the flange and the base in the instrument's frame by each method of OpenCV.
"""

import sys
import time

import cv2
import numpy as np


def matrix(rotation: np.ndarray, origin: np.ndarray) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, np.ravel(origin)
    return made


def main(source: str, target: str) -> None:
    given = np.load(source)
    flange, seen = given["flange"], given["seen"]
    # calibrateHandEye: the "gripper" is the flange, and the "target" what the "camera" sees. Here the tracker stands
    # still and the target moves, so that the inverse of each measured pose takes the camera's part.
    back, inverse = np.linalg.inv(flange), np.linalg.inv(seen)
    out = {}
    for name in ("SHAH", "LI"):
        begin = time.process_time()
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}")
        parts = [list(part) for a in (inverse, back) for part in (a[:, :3, :3], a[:, :3, 3:])]
        found = cv2.calibrateRobotWorldHandEye(*parts, method=method)
        # OpenCV's "world" is the frame of the tracker, and its "camera" the target on the flange.
        out[f"base {name}"], out[f"mount {name}"] = matrix(*found[:2]), np.linalg.inv(matrix(*found[2:]))
        out[f"seconds {name}"] = time.process_time() - begin
    for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        begin = time.process_time()
        parts = [list(part) for a in (flange, inverse) for part in (a[:, :3, :3], a[:, :3, 3:])]
        mount = matrix(*cv2.calibrateHandEye(*parts, method=getattr(cv2, f"CALIB_HAND_EYE_{name}")))
        out[f"mount {name}"] = mount
        out[f"seconds {name}"] = time.process_time() - begin
    np.savez(target, **out)


if __name__ == "__main__":
    main(*sys.argv[1:])
