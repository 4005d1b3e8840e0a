"""Calibrate with pybotics and predict held-out points, in its own environment: IN.npz OUT.npz.

pybotics supplies chain, world frame, tool, the masks of what is free, and forward kinematics; SciPy's `least_squares`,
which its documentation calls, gets the coordinates. pybotics has Craig's parameters only; ``parallel`` says whether the
d of joints 2 and 3 are free, whose axes are nominally parallel to their neighbours'. The world frame starts where the
nominal tips fit the points best: from the identity, the search had not ended after two minutes of CPU time.
"""

import sys
import time

import numpy as np
from pybotics.geometry import position_from_matrix
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.optimization import OptimizationHandler
from pybotics.robot import Robot
from scipy.optimize import least_squares


def fitted(tips: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The frame (4, 4) that brings tips closest to points."""
    middle, target = tips.mean(axis=0), points.mean(axis=0)
    left, _, right = np.linalg.svd((points - target).T @ (tips - middle))
    frame = np.eye(4)
    frame[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    frame[:3, 3] = target - frame[:3, :3] @ middle
    return frame


def main(source: str, target: str) -> None:
    given = np.load(source)
    n = given["alpha"].size
    links = np.zeros((n, 4))
    links[1:, 0], links[1:, 1] = given["alpha"][:-1], given["a"][:-1]
    links[:, 3] = given["d"]
    robot = Robot(MDHKinematicChain.from_parameters(links))
    nominal = np.array([position_from_matrix(robot.fk(row)) for row in given["q"]])
    robot.world_frame = fitted(nominal, given["points"])
    free = np.ones((n, 4), dtype=bool)
    free[0] = False  # the world frame
    free[-1, 2:] = False  # the tool
    free[1:3, 3] = bool(given["parallel"])
    handler = OptimizationHandler(
        robot, kinematic_chain_mask=free.ravel(), tool_mask=[True] * 3 + [False] * 3, world_mask=[True] * 6
    )

    def tips(vector: np.ndarray, q: np.ndarray) -> np.ndarray:
        handler.apply_optimization_vector(vector)
        return np.array([position_from_matrix(handler.robot.fk(row)) for row in q])

    def residual(vector: np.ndarray) -> np.ndarray:
        return (tips(vector, given["q"]) - given["points"]).ravel()

    begin = time.process_time()
    found = least_squares(residual, handler.generate_optimization_vector(), x_scale="jac", max_nfev=100)
    seconds = time.process_time() - begin
    np.savez(target, points=tips(found.x, given["q_unseen"]), seconds=seconds, values=found.x)


if __name__ == "__main__":
    main(*sys.argv[1:])
