"""Simulated corners: random poses in which a camera has the whole target in view."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ...core.arguments import OneOf
from ...core.errors import InputError
from ...core.rotations import rotation_matrix, rotation_vector
from ..cameras.camera import AbstractCamera, camera_models
from .declared import FREE, declared
from .observation import Readings, Transforms
from .pixels import Pixels
from .simulated import AbstractSimulated, Aim

_TRIED, _MOST_TRIED = 10, 500  # random poses for each one that is wanted, over the share of directions within the tilt
_ASIDE = 0.35  # of the target's size: how far from its middle the camera looks


class SimulatedPixels(AbstractSimulated):
    """Corners of a target that a camera sees from random poses, each with the whole target in its image.

    Example:
        >>> board = [(30 * i, 30 * j, 0) for j in range(4) for i in range(6)]
        >>> eye = aj.data.observations.SimulatedPixels(
        ...     "eye", 10, "webcam", "board", board, (600, 600, 319.5, 239.5), (640, 480),
        ...     frame=(np.pi, 0, 0, -700, -200, 0), mount=(60, 0, 20, 0, 0, 0), distance=(250, 400),
        ... )
        >>> seen = aj.simulate(aj.load_arm("ur10e"), {}, observations=[eye], seed=1).observations[0]
        >>> print(seen.corners.shape, [*seen.unknowns])
        (10, 24, 2) ['frame of board', 'orientation of webcam']
    """  # fmt: skip

    table = "pixels"
    poses: int = declared("number of poses")
    camera: str = declared("camera")
    board: str = declared("target that the camera sees")
    points: Float[np.ndarray, "k 3"] = declared("points of the target, in its frame", "mm", "corner", "axis")
    intrinsics: Float[np.ndarray, " i"] = declared("true intrinsics of the camera", "px", "intrinsic")
    image_size: Float[np.ndarray, "2"] = declared("width and height of an image", "px", "image_axis")
    on_arm: bool = declared("whether the camera is on the arm and the target stands still", default=True)
    model: str = declared("model of the camera", default="pinhole")
    stated: Float[np.ndarray, " i"] | None = declared(
        "intrinsics that are stated", "px", "intrinsic", default=None, more="the true ones if None"
    )
    u_intrinsics: Float[np.ndarray, " i"] = declared(
        "standard uncertainty of each of these", "px", "intrinsic", default=0.0, spread=0, most=FREE,
        more="0 for an exact value, infinite for one that is only a start",
    )  # fmt: skip
    mount: Float[np.ndarray, "6"] = declared(
        "true position (mm) and rotation vector (rad) in the last frame of what is on the arm", default=(0.0,) * 6
    )
    frame: Float[np.ndarray, "6"] = declared(
        "true frame in the base frame of what stands still: rotation vector (rad) and origin (mm)",
        default=(0.0,) * 6,
        moves="frame",
    )
    distance: Float[np.ndarray, "2"] = declared(
        "least and largest distance of the target's middle from the camera", "mm", default=(300.0, 600.0)
    )
    tilt: float = declared("largest angle between the target's normal and the line of sight", "rad", default=0.9)
    u: float = declared("standard deviation of a coordinate of a corner", "px", default=0.3)
    u_scale: float = declared("relative standard uncertainty of the target's scale", "1", default=0.0)
    scale: float = declared("true scale of the target", "1", default=1.0)
    true_views: bool = declared("whether the true views are recorded, instead of those of the corners", default=False)

    def completed(self, where: str) -> Mapping[str, Any]:
        OneOf(camera_models())(self.model, f"model of {where}")
        self.camera_model.check_count(len(self.intrinsics), where)
        if not 0 < self.distance[0] <= self.distance[1]:
            raise InputError(f"distance of {where} is {self.distance}; give the least and the largest one, above 0.")
        turn, still = (np.asarray(rotation_matrix(w)) for w in (self.mount[3:], self.frame[:3]))
        # The tip that is led: a point before the camera, or the middle of the target.
        ahead = np.array([0.0, 0.0, self.distance.mean()]) if self.on_arm else self.middle
        axis, normal, place = ((float(x), float(y), float(z)) for x, y, z in (turn[:, 2], -still[:, 2], self.mount[:3]))
        return {"offset": self.mount[:3] + turn @ ahead, "aim": Aim(axis, normal, self.tilt, place)}

    @property
    def camera_model(self) -> AbstractCamera:
        """The model of the camera."""
        return camera_models()[self.model]

    @property
    def middle(self) -> Float[np.ndarray, " 3"]:
        """The middle of the target in its frame, mm."""
        return self.scale * self.points.mean(axis=0)

    def tips(self, random: np.random.Generator) -> Float[np.ndarray, "m 3"]:
        tried = min(2 * _TRIED / (1 - np.cos(min(self.tilt, np.pi / 2)) + 1e-9), _MOST_TRIED)
        count, turn = int(tried) * self.poses, np.asarray(rotation_matrix(self.frame[:3]))
        if self.on_arm:
            spread = _ASIDE * np.ptp(self.points, axis=0) * random.uniform(-1, 1, (count, 3))
            spread[:, 2] += random.uniform(-0.5, 0.5, count) * np.ptp(self.distance)
            return (self.middle + spread) @ turn.T + self.frame[3:]
        if self.camera_model.dimension == 3:
            seen = np.stack([*random.uniform(-0.4, 0.4, (2, count)), np.ones(count)])
        else:
            pixels = random.uniform(0.2, 0.8, (2, count)) * self.image_size[:, None]
            seen = self.camera_model.directions(pixels, self.intrinsics)
        return (seen * random.uniform(self.distance[0], self.distance[1], count)).T @ turn.T + self.frame[3:]

    def recorded(self, q: Readings, transforms: Transforms, random: np.random.Generator) -> Pixels:
        seen, corners = self._seen(transforms)
        chosen = np.flatnonzero(seen)[: self.poses]
        if len(chosen) < self.poses:
            raise InputError(
                f"{self.noun} '{self.name}' shows the whole target in {len(chosen)} of {len(q)} random poses, but "
                f"{self.poses} poses are wanted; move the target, or change the distance or the tilt."
            )
        corners, k = corners[chosen], len(self.points)
        views = self._views(transforms[chosen]) if self.true_views else None
        return Pixels(
            self.name,
            q[chosen],
            corners + self.u * random.normal(size=corners.shape),
            np.tile(self.points, (len(chosen), 1, 1)),
            np.tile(np.arange(k), (len(chosen), 1)),
            max(self.u, 1e-6),
            self.camera,
            self.board,
            on_arm=self.on_arm,
            model=self.model,
            intrinsics=self.intrinsics if self.stated is None else self.stated,
            u_intrinsics=self.u_intrinsics,
            image_size=self.image_size,
            u_scale=self.u_scale,
            views=views,
        )

    def measurable(self, transforms: Transforms) -> Bool[np.ndarray, " m"]:
        return self._seen(transforms)[0]

    def _placed(self, transforms: Transforms) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Axes ``(m, 3, 3)`` and origin ``(m, 3)`` of the camera, and those of the target, in the base frame."""
        held, still = (np.asarray(rotation_matrix(w)) for w in (self.mount[3:], self.frame[:3]))
        turn = transforms[:, :3, :3] @ held
        assert self.offset is not None
        origin = transforms[:, :3, 3] + transforms[:, :3, :3] @ (self.mount[:3] - self.offset)
        fixed = np.broadcast_to(still, turn.shape), np.broadcast_to(self.frame[3:], origin.shape)
        return (turn, origin, *fixed) if self.on_arm else (*fixed, turn, origin)

    def _views(self, transforms: Transforms) -> Float[np.ndarray, "m 6"]:
        """Rotation vectors and origins of the target in the camera's frame."""
        camera, centre, board, place = self._placed(transforms)
        turns = camera.swapaxes(1, 2) @ board
        origins = np.einsum("mji,mj->mi", camera, place - centre)
        return np.concatenate([[rotation_vector(turn) for turn in turns], origins], axis=1)

    def _seen(self, transforms: Transforms) -> tuple[Bool[np.ndarray, " m"], Float[np.ndarray, "m k d"]]:
        """Which poses have the whole target in view, and its corners."""
        camera, centre, board, place = self._placed(transforms)
        points = self.scale * self.points @ board.swapaxes(1, 2) + (place - centre)[:, None]
        before = np.moveaxis(points @ camera, -1, 0)  # (3, m, k)
        model = self.camera_model
        values = np.moveaxis(np.asarray(model.project(before, self.intrinsics[:, None, None]).values), 0, -1)
        sight = before.mean(axis=2)
        size = np.linalg.norm(sight, axis=0)
        normal = np.einsum("mij,mi->jm", camera, board[:, :, 2])
        ahead = np.sum(normal * sight, axis=0) > np.cos(self.tilt) * size
        ahead &= (size >= self.distance[0]) & (size <= self.distance[1])
        if model.dimension == 2:
            edge = 1 + 4 * self.u
            inside = (values >= edge) & (values <= self.image_size - 1 - edge)
            ahead &= inside.all(axis=(1, 2)) & ~model.folded(before, self.intrinsics).any(axis=1)
        return ahead, values
