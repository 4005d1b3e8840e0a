"""Pinocchio's kinematics of the same arm, pose by pose, in a process of its own: IN.npz OUT.npz.

Three things are timed, each over all poses in a Python loop, as its Python users call it: the tip; the tip and its
Jacobian by the joint angles; and the tip with its frame's kinematic regressor, Pinocchio's derivative by small
displacements of the placement of every joint (6 columns a joint), from which a calibration takes its D-H columns.
"""

import sys
import time

import numpy as np
import pinocchio as pin


def rotation_about(axis: int, angle: float) -> pin.SE3:
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.eye(3)
    one, two = [(1, 2), (2, 0), (0, 1)][axis]
    rotation[one, one] = rotation[two, two] = c
    rotation[two, one], rotation[one, two] = s, -s
    return pin.SE3(rotation, np.zeros(3))


def model_of(given) -> tuple[pin.Model, int]:
    model, parent, link = pin.Model(), 0, pin.SE3.Identity()
    for i in range(given["alpha"].size):
        joint = pin.JointModelRZ()
        parent = model.addJoint(parent, joint, link * rotation_about(2, given["theta"][i]), f"joint_{i + 1}")
        link = pin.SE3(np.eye(3), np.array([given["a"][i], 0.0, given["d"][i]])) * rotation_about(0, given["alpha"][i])
    tip = link * pin.SE3(np.eye(3), given["probe"])
    return model, model.addFrame(pin.Frame("tip", parent, 0, tip, pin.FrameType.OP_FRAME))


def main(source: str, target: str) -> None:
    given = np.load(source)
    model, tip = model_of(given)
    data, frame = model.createData(), pin.ReferenceFrame.LOCAL_WORLD_ALIGNED

    def position(q: np.ndarray) -> None:
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacement(model, data, tip)

    def jacobian(q: np.ndarray) -> None:
        pin.computeFrameJacobian(model, data, q, tip, frame)

    def regressor(q: np.ndarray) -> None:
        position(q)
        pin.computeFrameKinematicRegressor(model, data, tip, frame)

    seconds = {}
    for name, call in (("position", position), ("jacobian", jacobian), ("regressor", regressor)):
        times = []
        for _ in range(int(given["rounds"]) + 1):
            begin = time.perf_counter()
            for q in given["q"]:
                call(q)
            times.append(time.perf_counter() - begin)
        seconds[name] = times[1:]
    tips = []
    for q in given["q"]:
        position(q)
        tips.append(data.oMf[tip].translation.copy())
    np.savez(target, tips=np.array(tips), **seconds)


if __name__ == "__main__":
    main(*sys.argv[1:])
