"""Rendered images of targets in known places."""

import numpy as np

from aacmm_jax.camera.rendering import Optics, render
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data.cameras.camera import camera_models
from aacmm_jax.data.targets import Charuco, Checkerboard, PointTable, TagGrid

SIZE = (640, 480)
PINHOLE = np.array([600.0, 605.0, 315.0, 242.0, -0.25, 0.08, 1e-3, -5e-4])
FISHEYE = np.array([280.0, 280.0, 320.0, 240.0, -0.02, 0.01, 0.0, 0.0])
SQUARE = 20 * np.array([[-1, -1, -1.3], [1, -1, -1.3], [1, 1, -1.3], [-1, 1, -1.3]])
TURNS = [rotation_matrix(np.array(w)) for w in ([0.0, 0, 0], [0, np.pi / 2, 0], [0, -np.pi / 2, 0], [np.pi / 2, 0, 0])]
CUBE = PointTable(range(16), np.concatenate([SQUARE @ turn.T for turn in TURNS]), "4x4_50")
TARGETS = {
    "checkerboard": Checkerboard(8, 5, 22.0),
    "charuco": Charuco(7, 5, 25.0, 18.0),
    "aruco": TagGrid(4, 3, 36.0, 9.0, "4x4_50"),
    "april": TagGrid(3, 2, 50.0, 12.0),
    "cube": CUBE,
}


def place(target, seed, nearer=0.0):
    """A random place in view, turned about the line of sight by any angle."""
    random = np.random.default_rng(seed)
    turn = rotation_matrix(np.append(random.uniform(-0.6, 0.6, 2), random.uniform(-3, 3)))
    transform = np.eye(4)
    transform[:3, :3] = turn
    centre = np.array([*random.uniform([-50, -30], [50, 30]), random.uniform(320, 420) - nearer])
    transform[:3, 3] = centre - turn @ target.points.mean(axis=0)
    return transform


def scene(target, seed=0, *, model="pinhole", nearer=0.0, **optics):
    """An image of a target, and where its corners are in it, in the order of its ids."""
    intrinsics = PINHOLE if model == "pinhole" else FISHEYE
    transform = place(target, seed, nearer)
    image = render(target, transform, model, intrinsics, SIZE, optics=Optics(**optics), seed=seed)
    points = transform[:3, :3] @ target.points.T + transform[:3, 3:]
    return image, np.asarray(camera_models()[model].project(points, intrinsics[:, None]).values).T
