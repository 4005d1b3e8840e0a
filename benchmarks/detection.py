"""Bias of detected corners, and images misread, over rendered images.

``python benchmarks/detection.py [--images N]`` renders N images of each target: random place, any turn about the line
of sight, up to 0.6 rad oblique in each direction, lens with k1 = -0.25, noise of 2 and 4 grey levels, uneven light. It
prints how far corners are from where they are (mean, standard deviation, largest, px), how many images are refused, and
how many have a corner that is off by more than 1 px (misread). Then come wrong images: mirrored ones and other boards.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from aacmm_jax.camera.detection import detect
from aacmm_jax.data.targets import Charuco, Checkerboard, TagGrid
from tests.camera.scenes import TARGETS, scene


def measure(name: str, images: int, **optics: float) -> None:
    """Print the errors of the corners of one target."""
    target, errors, refused, misread = TARGETS[name], [], 0, 0
    order, began = np.argsort(target.ids), time.process_time()
    for seed in range(images):
        image, true = scene(target, seed, **optics)
        found = detect(image, target)
        if found.refused:
            refused += 1
            continue
        error = found.corners - true[order[np.searchsorted(target.ids[order], found.ids)]]
        misread += int(np.abs(error).max() > 1)
        errors.append(error)
    every = np.concatenate(errors)
    print(
        f"{name:13s} blur {optics['blur']:.1f} px, noise {optics['noise']:.0f}: {images} images, {refused} refused, "
        f"{misread} misread, {len(every)} corners, mean ({every[:, 0].mean():+.4f}, {every[:, 1].mean():+.4f}) px, "
        f"standard deviation {every.std():.3f} px, largest {np.abs(every).max():.2f} px, "
        f"{1000 * (time.process_time() - began) / images:.0f} ms an image"
    )


def wrong(images: int) -> None:
    """Print how many wrong images are taken for right ones."""
    board, checkers, tags = TARGETS["charuco"], TARGETS["checkerboard"], TARGETS["aruco"]
    cases = {
        "mirrored ChArUco": (board, board, True),
        "mirrored tags": (tags, tags, True),
        "ChArUco 6 x 5 for 7 x 5": (Charuco(6, 5, 25.0, 18.0), board, False),
        "ChArUco 5 x 7 for 7 x 5": (Charuco(5, 7, 25.0, 18.0), board, False),
        "checkerboard 9 x 6 for 8 x 5": (Checkerboard(9, 6, 22.0), checkers, False),
        "checkerboard 10 x 5 for 8 x 5": (Checkerboard(10, 5, 20.0), checkers, False),
        "tags 3 x 4 for 4 x 3": (TagGrid(3, 4, 36.0, 9.0, "4x4_50"), tags, False),
        "tags with a gap of 6 for 9 mm": (TagGrid(4, 3, 36.0, 6.0, "4x4_50"), tags, False),
    }
    for case, (shown, stated, mirrored) in cases.items():
        seen = (scene(shown, seed)[0] for seed in range(images))
        taken = sum(not detect(np.ascontiguousarray(x[:, ::-1] if mirrored else x), stated).refused for x in seen)
        print(f"{case}: {taken} of {images} accepted")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=60)
    count = parser.parse_args().images
    for one in TARGETS:
        measure(one, count, blur=0.8, noise=2.0)
        measure(one, count, blur=1.5, noise=4.0)
    wrong(max(count // 5, 1))
