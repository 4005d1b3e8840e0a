"""Stage 1 of the paper's problem with pybotics, in its own environment (it needs NumPy before 2): IN.npz OUT.npz.

pybotics has no fixed-point residual with an unknown point and no bounds of its own. It supplies the chain, the mask of
free parameters, and forward kinematics pose by pose; the residual is centred here, and SciPy's `least_squares`, which
pybotics itself calls, gets the bounds.
"""

import sys
import time

import numpy as np
from pybotics.geometry import position_from_matrix
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.optimization import OptimizationHandler
from pybotics.robot import Robot
from scipy.optimize import least_squares

# pybotics keeps a link as Craig does: alpha and a of the link before, then theta and d of the joint.
COLUMN = {"alpha": 0, "a": 1, "theta": 2, "d": 3}


def main(source: str, target: str) -> None:
    given = np.load(source)
    kinds, indices, n = given["kinds"].tolist(), given["indices"].tolist(), given["alpha"].size
    links = np.zeros((n, 4))
    links[1:, 0], links[1:, 1] = given["alpha"][:-1], given["a"][:-1]
    links[:, 2], links[:, 3] = given["theta"], given["d"]
    robot = Robot(MDHKinematicChain.from_parameters(links))
    # pybotics' tool is the last link of the standard form together with the probe. The free axis of the probe (z),
    # rotated by alpha_n, must therefore be an axis of the tool.
    c, s = np.cos(given["alpha"][-1]), np.sin(given["alpha"][-1])
    x, y, z = given["probe"]
    robot.tool.position = [given["a"][-1] + x, c * y - s * z, s * y + c * z]
    axis = int(np.argmax([0.0, -s, c]))
    assert [0.0, -s, c][axis] > 1 - 1e-12
    # pybotics orders its vector link by link, and the tool after it; ours goes kind by kind.
    slots = []
    for kind, i in zip(kinds, indices, strict=True):
        link = i + 1 if kind in ("alpha", "a") else i
        slots.append(4 * n + axis if kind == "probe" else 4 * link + COLUMN[kind])
    free = np.isin(np.arange(4 * n + 6), slots)
    order = np.argsort(slots)
    handler = OptimizationHandler(robot, kinematic_chain_mask=free[: 4 * n], tool_mask=free[4 * n :])

    def residual(vector: np.ndarray) -> np.ndarray:
        handler.apply_optimization_vector(vector)
        tips = np.array([position_from_matrix(handler.robot.fk(row)) for row in given["q"]])
        return (tips - tips.mean(axis=0)).ravel()

    scale = given["scale"][order]
    bounds = given["lower"][order], given["upper"][order]
    begin, found = time.perf_counter(), []
    for start in given["starts"]:
        options = {"bounds": bounds, "x_scale": scale, "xtol": 1e-13, "ftol": 1e-15, "gtol": 1e-15}
        solution = np.empty(len(order))
        solution[order] = least_squares(residual, start[order], **options).x
        found.append(solution)
    np.savez(target, seconds=time.perf_counter() - begin, found=np.array(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
