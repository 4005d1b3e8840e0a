"""What a camera saw: corners of known points of a target, with the camera or the target on the arm."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ...core.arguments import OneOf
from ...core.arrays import is_concrete
from ...core.errors import InputError
from ...core.linear_algebra import products_by_column
from ...core.numpy_or_jax import AnyArray, namespace, numpy_if_known
from ...core.rotations import cross, rotation_and_derivative, rotation_matrix
from ..cameras.camera import AbstractCamera, camera_models
from ..cameras.views import Corners, views_of
from .declared import FREE, Identifiers, Part, declared, is_exact, is_known
from .hand_eye import hand_eye
from .observation import (
    FRAME,
    AbstractObservation,
    Certified,
    Parts,
    Quantity,
    Rows,
    Tips,
    Unknowns,
    displacement,
    offset_of,
)
from .reduced_rows import reduced_rows

_OUTSIDE = 1.0  # px that a corner may lie outside of an image


class Pixels(AbstractObservation):
    """Corners of known points of a target, as a camera saw them: one image for each pose.

    The camera is on the arm and the target stands still, or the other way round. Unknown are the place of the one in
    the last frame ("offset of" and "orientation of" it), the frame of the other in the base frame ("frame of" it),
    those intrinsics that are not exact, and the scale of the target if that is uncertain. Observations that name the
    same camera or target share these. The camera's frame is that of `AbstractCamera`.

    The residuals are projected less measured coordinates, and 0 of absent corners, whose id is -1. They enter a
    calibration as fewer rows, which say the same (`reduced_rows`).

    Raises:
        InputError: Shapes or names do not fit, a corner is outside of the image, the number of intrinsics is not one of
            the model's, or a corner lies where the distortion folds back.

    Example:
        >>> q, ids = np.zeros((1, 6)), np.arange(4)[None]
        >>> corners = [[[100, 100], [200, 100], [100, 180], [200, 180]]]
        >>> points = [[[0, 0, 0], [50, 0, 0], [0, 40, 0], [50, 40, 0]]]
        >>> eye = aj.data.observations.Pixels(
        ...     "eye", q, corners, points, ids, 0.3, "webcam", "board", intrinsics=(600, 600, 320, 240)
        ... )
        >>> print([*eye.unknowns])
        ['frame of board', 'orientation of webcam']
    """

    kind, table, rotates, reduces = "pixels", "pixels", True, True
    stacks, eliminates = False, False
    fixes_scale = True
    derived = ("still", "uncertain", "free", "scaled")
    still: str  # what is not on the arm
    uncertain: tuple[int, ...]  # which intrinsics have an uncertainty
    free: tuple[int, ...]  # and which are only a start
    scaled: bool  # whether the target's scale is uncertain
    corners: Float[AnyArray, "m c d"] = declared(
        "measured corner", "px", "pose", "corner", "image_axis", more="mm of a camera that measures points in space"
    )
    points: Float[AnyArray, "m c 3"] = declared(
        "point of the target that was seen there, in its frame", "mm", "pose", "corner", "axis"
    )
    ids: Identifiers = declared(
        "identifier of this point", "1", "pose", "corner", more="-1 where the image has no more corners"
    )
    u: Float[AnyArray, "m c d"] = declared(
        "standard deviation of a coordinate of a corner", "px", "pose", "corner", "image_axis", spread=0,
        more="one number, one for each axis, or one for each coordinate of a corner",
    )  # fmt: skip
    camera: str = declared("camera", of_session=True)
    board: str = declared("target that the camera saw", of_session=True)
    on_arm: bool = declared("whether the camera is on the arm and the target stands still", default=True)
    model: str = declared("model of the camera", default="pinhole")
    intrinsics: Float[AnyArray, " k"] = declared("intrinsics of the camera", "px", "intrinsic", default=())
    u_intrinsics: Float[AnyArray, " k"] = declared(
        "standard uncertainty of each of the intrinsics", "px", "intrinsic", default=0.0, spread=0, most=FREE,
        more="0 for an exact value, infinite (kept as 1e12) for one that is only a start",
    )  # fmt: skip
    image_size: Float[AnyArray, "2"] | None = declared("width and height of an image", "px", "image_axis", default=None)
    u_scale: Float[AnyArray, ""] = declared("relative standard uncertainty of the target's scale", "1", default=0.0)
    views: Float[AnyArray, "m 6"] | None = declared(
        "rotation vector (rad) and origin (mm) of the target in the camera's frame", "1", "pose", "frame",
        default=None, more="for the start; all 0 where an image shows too little; computed from the corners if None",
    )  # fmt: skip
    images: tuple[str, ...] | None = declared("name of the image", "", "pose", default=None)
    frame = Part("frame of {still}", *FRAME)
    orientation = Part("orientation of {target}", *FRAME[:3])
    optics = Part("intrinsics of {camera}")  # of those that are not exact; where some are free, those that are stated
    free_optics = Part("free intrinsics of {camera}")  # beside stated ones
    scale = Part("scale of {board}", "1")

    def completed(self, where: str) -> Mapping[str, Any]:
        OneOf(camera_models())(self.model, f"model of {where}")
        model, present = self.camera_model, self.seen
        u, sides = self.u_intrinsics, (self.camera, self.board)
        model.check_count(len(self.intrinsics), where)
        if self.corners.shape[2] != model.dimension:
            raise InputError(
                f"corners of {where} have {self.corners.shape[2]} coordinates, but the model '{model.name}' measures "
                f"{model.dimension}; give (m, c, {model.dimension})."
            )
        if self.camera == self.board:
            raise InputError(f"{where} calls camera and target '{self.camera}'; give them different names.")
        if not present.any(axis=1).all():
            empty = int(np.flatnonzero(~present.any(axis=1))[0])
            raise InputError(f"{where} has no corner in pose {empty + 1}; leave out this pose.")
        if is_concrete(self.u) and np.any(np.asarray(self.u)[present] <= 0):
            raise InputError(f"u of {where} is 0; give the standard deviation of a corner, such as 0.3 px.")
        unsure, known = np.asarray(u) > 0 if is_concrete(u) else np.ones(len(u), dtype=bool), is_known(u)
        target, still = sides if self.on_arm else sides[::-1]

        def absent(values: AnyArray, value: float) -> AnyArray:
            return numpy_if_known(lambda values: namespace(values).where(present[..., None], values, value))(values)

        fields = {
            "corners": absent(self.corners, 0.0),
            "points": absent(self.points, 0.0),
            "u": absent(self.u, 1.0),
            "target": target,
            "still": still,
            "uncertain": tuple(np.flatnonzero(unsure & known).tolist()),
            "scaled": not is_exact(self.u_scale),
            "free": tuple(np.flatnonzero(unsure & ~known).tolist()),
        }
        if is_concrete(fields["corners"], fields["points"], fields["u"], self.intrinsics, u):
            made = self.changed(**fields)
            made._check_image(where)
            if self.views is None:
                corners = made.as_corners()
                fields["views"] = views_of(corners, np.asarray(self.intrinsics))[0].vectors()
            made.changed(**fields)._check_views(where)
        elif self.views is None:
            raise InputError(f"{where} has corners that are traced; give views for the start.")
        return fields

    def _check_image(self, where: str) -> None:
        """Raise `InputError` for corners outside of the image, and for a centre outside of it."""
        if self.image_size is None or self.camera_model.unit != "px":
            return
        size, corners, present = np.asarray(self.image_size), np.asarray(self.corners), self.seen
        inside = np.all((corners >= -0.5 - _OUTSIDE) & (corners <= size - 0.5 + _OUTSIDE), axis=2) | ~present
        if not inside.all():
            pose, corner = np.argwhere(~inside)[0]
            x, y = corners[pose, corner]
            raise InputError(
                f"corner {self.ids[pose][corner]} in pose {pose + 1} of {where} is at ({x:.1f}, {y:.1f}) px, "
                f"outside of the image of {size[0]:.0f} x {size[1]:.0f} px; check the size and the corners."
            )
        centre = np.asarray(self.intrinsics)[2:4]
        if np.any(centre < 0) or np.any(centre > size):
            raise InputError(
                f"the centre ({centre[0]:.1f}, {centre[1]:.1f}) px of {where} is outside of the image of {size[0]:.0f} "
                f"x {size[1]:.0f} px; the intrinsics may be those of another image size."
            )

    def _check_views(self, where: str) -> None:
        """Raise `InputError` where known intrinsics fold the image at a corner."""
        views, u = np.asarray(self.views), np.asarray(self.u_intrinsics)
        known = np.any(views[:, 3:] != 0, axis=1)
        if not known.any():
            raise InputError(
                f"{where} has no image with enough corners: at least four of a flat target, and six of another one; "
                "give corners of more points."
            )
        if not len(u) or np.any(u >= FREE):
            return
        turns = np.moveaxis(np.asarray(rotation_matrix(views[:, :3].T)), -1, 0)
        seen = np.moveaxis(np.asarray(self.points) @ turns.swapaxes(1, 2) + views[:, None, 3:], -1, 0)
        folded = self.camera_model.folded(seen, np.asarray(self.intrinsics)) & self.seen & known[:, None]
        if folded.any():
            pose, corner = np.argwhere(folded)[0]
            raise InputError(
                f"the distortion of {where} folds back before corner {self.ids[pose][corner]} in pose {pose + 1}; give "
                "other distortion coefficients, or leave out corners so near to the edge."
            )

    @property
    def camera_model(self) -> AbstractCamera:
        """The model of the camera."""
        return camera_models()[self.model]

    @functools.cached_property
    def seen(self) -> Bool[np.ndarray, "m c"]:
        """Which corners are present."""
        return np.array(self.ids) >= 0

    @functools.cached_property
    def equations(self) -> Int[np.ndarray, "r m"] | None:
        measured, n = self.corners.shape[2] * self.seen.sum(axis=1), self.rows - 1
        return np.concatenate([np.arange(n)[:, None] < measured, np.maximum(measured - n, 0)[None]]).astype(int)

    def changed(self, **fields: Any) -> Any:
        made = super().changed(**fields)
        for derived in ("seen", "equations"):
            vars(made).pop(derived, None)
        return made

    @property
    def places(self) -> Int[np.ndarray, " m"]:
        return np.zeros(len(self.ids), dtype=int)  # images are no places

    def as_corners(self) -> Corners:
        """The corners for a calibration of the camera alone."""
        values, points, u = (np.asarray(values) for values in (self.corners, self.points, self.u))
        return Corners(self.camera_model, values, points, self.seen, u)

    @property
    def row_units(self) -> tuple[str, ...]:
        own = len(self.uncertain) + len(self.free) + self.scaled  # that do not move the target as a whole
        return (self.camera_model.unit,) * (7 + own)

    @property
    def optical(self) -> Mapping[str, tuple[int, ...]]:
        """Which intrinsics the parts of the geometry hold that are intrinsics."""
        if self.uncertain and self.free:
            return {self.optics: self.uncertain, self.free_optics: self.free}
        return {self.optics: self.uncertain or self.free} if self.uncertain or self.free else {}

    def _by_part(self, values: Sequence[Any]) -> dict[str, tuple[Any, ...]]:
        return {part: tuple(values[i] for i in places) for part, places in self.optical.items()}

    @property
    def unknowns(self) -> Mapping[str, tuple[str, ...]]:
        scale = {self.scale: ("1",)} if self.scaled else {}
        frames = {self.frame: FRAME, self.orientation: FRAME[:3]}
        return frames | self._by_part(self.camera_model.units) | scale

    @property
    def apart(self) -> tuple[str, ...]:
        return tuple(name for name in self.unknowns if name not in (self.frame, self.orientation))

    @property
    def steps(self) -> Mapping[str, tuple[float, ...]]:
        return self._by_part(self.camera_model.steps)

    @property
    def certified(self) -> Certified:
        values: Certified = {}
        if self.uncertain:
            index = np.array(self.uncertain)
            values[self.optics] = (self.intrinsics[index], self.u_intrinsics[index])
        if self.scaled:
            values[self.scale] = (np.ones(1), namespace(self.u_scale).reshape(self.u_scale, (1,)))
        return values

    def quantities(self, part: str, values: Float[np.ndarray, " k"]) -> tuple[Quantity, ...]:
        if part in self.optical:
            model = self.camera_model
            named = zip(self.optical[part], values, strict=True)
            return tuple(Quantity(model.names[i], np.reshape(value, 1), model.units[i]) for i, value in named)
        return super().quantities(part, values)

    def in_session(self, session: str, probe: str) -> "AbstractObservation":
        made = super().in_session(session, probe)
        return made.changed(still=f"{session}/{self.still}")

    @property
    def other_counts(self) -> Int[np.ndarray, " m"]:
        return self.seen.sum(axis=1)

    def other_sizes(self, rows: Float[AnyArray, "r m"]) -> Float[AnyArray, " m"]:
        return super().other_sizes(rows) / namespace(rows).asarray(np.sqrt(self.other_counts))

    def in_mm(self, rows: Float[AnyArray, "r *k m"], by_tip: Float[AnyArray, "r 3 m"]) -> Float[AnyArray, "c *k m"]:
        return displacement(rows, by_tip)

    def whole_intrinsics(self, unknowns: Unknowns) -> Float[AnyArray, "i _"]:
        """All intrinsics as columns, with the unknown ones."""
        columns = list(self.intrinsics[:, None])
        for part, places in self.optical.items():
            for place, value in zip(places, unknowns[part], strict=True):
                columns[place] = value
        wide = max((column.shape[0] for column in columns), default=1)
        xp = namespace(columns)
        return (
            xp.stack([xp.broadcast_to(column, (wide,)) for column in columns]) if columns else self.intrinsics[:, None]
        )

    def start(self, tips: Tips, offset: Float[AnyArray, " 3"]) -> Parts:
        assert self.views is not None  # see `completed`
        xp = namespace(tips, offset, self.views)
        axes = xp.stack(tips.axes, axis=1)  # (3, 3, m): columns are axes
        turns, shifts = xp.moveaxis(rotation_matrix(self.views[:, :3].T), -1, 0), self.views[:, 3:]
        counted = xp.where(xp.any(shifts != 0, axis=1), 1.0, 0.0)
        if not self.on_arm:  # the camera in the target's frame
            turns = xp.swapaxes(turns, 1, 2)
            shifts = -xp.einsum("mij,mj->mi", turns, shifts)
        origins = tips.position - xp.einsum("cpm,p->cm", axes, offset)
        place, turn, frame = hand_eye(origins, axes, turns, shifts, counted)
        parts = {self.frame: frame, self.orientation: turn, offset_of(self.target): place}
        parts |= {part: self.intrinsics[np.array(places)] for part, places in self.optical.items()}
        return parts | {name: value for name, (value, _) in self.certified_values().items()}

    def residual(self, tips: Tips, unknowns: Unknowns) -> Rows:
        xp, (m, c, d) = namespace(tips, unknowns, self.corners), self.corners.shape
        still, by_still = rotation_and_derivative(unknowns[self.frame][:3])
        held, by_held = rotation_and_derivative(unknowns[self.orientation])
        axes = xp.stack(tips.axes, axis=1)
        carried = products_by_column(axes, xp.broadcast_to(held, (3, 3, m)))  # axes in the base frame, as columns
        origin, here = unknowns[self.frame][3:], tips.position
        camera, board = (carried, still) if self.on_arm else (still, carried)
        between = origin - here if self.on_arm else here - origin  # from the camera to the target
        scale = unknowns[self.scale][0] if self.scale in unknowns else None
        flat = xp.moveaxis(self.points, -1, 0)  # (3, m, c)
        turned = xp.einsum("ijm,jmc->imc", xp.broadcast_to(board, (3, 3, m)), flat)
        arms = turned if scale is None else turned * scale[None, :, None]
        sight = arms + between[:, :, None]
        camera = xp.broadcast_to(camera, (3, 3, m))
        intrinsics = self.whole_intrinsics(unknowns)[:, :, None]
        seen = self.camera_model.project(xp.einsum("ijm,imc->jmc", camera, sight), intrinsics)
        # By a shift of the target in the base frame, (3, d, m, c); all other derivatives follow from these.
        by_shift = xp.einsum("djmc,ijm->idmc", seen.by_point, camera)
        of_board = _crossed(arms, by_shift)
        of_camera = -_crossed(sight, by_shift)
        sign, by_carried, by_frame = (-1.0, of_camera, of_board) if self.on_arm else (1.0, of_board, of_camera)
        inside = products_by_column(axes, xp.broadcast_to(by_held, (3, 3, m)))
        by = {
            self.frame: xp.concatenate(
                [xp.einsum("ikm,idmc->kdmc", xp.broadcast_to(by_still, (3, 3, m)), by_frame), -sign * by_shift]
            ),
            self.orientation: xp.einsum("ikm,idmc->kdmc", inside, by_carried),
        }
        by |= {part: seen.by_intrinsics[np.array(places)] for part, places in self.optical.items()}
        if self.scale in unknowns:
            by[self.scale] = xp.sum(by_shift * turned[:, None], axis=0)[None]
        present = xp.asarray(self.seen)

        def rows(values: AnyArray) -> AnyArray:  # (..., d, m, c) to (..., r, m); 0 where a corner is absent
            kept = xp.where(present.reshape(*(1,) * (values.ndim - 2), m, c), values, 0.0)
            return xp.moveaxis(kept, (-1, -3, -2), (-3, -2, -1)).reshape(*values.shape[:-3], c * d, m)

        return Rows(
            values=rows(seen.values - xp.moveaxis(self.corners, -1, 0)),
            by_tip=xp.swapaxes(rows(sign * by_shift), 0, 1),
            by_unknowns={name: rows(values) for name, values in by.items()},
            measured=xp.zeros((m, 0, 0)),
            by_rotation=xp.swapaxes(rows(by_carried), 0, 1),
        )

    def reduced(self, rows: Rows, shift: AnyArray | None = None, weights: Any = None) -> Rows:
        xp, (m, c, d) = namespace(rows.values, self.u), self.corners.shape
        weight = xp.where(xp.asarray(self.seen)[..., None], 1 / self.u, 0.0).reshape(m, c * d)
        return reduced_rows(rows, weight, self.apart, shift, weights)


def _crossed(arms: Float[AnyArray, "3 m c"], by_shift: Float[AnyArray, "3 d m c"]) -> Float[AnyArray, "3 d m c"]:
    """Derivatives by small rotations of what has such lever arms, from those by a shift of it."""
    xp = namespace(arms, by_shift)
    wide = xp.broadcast_to(arms[:, None], by_shift.shape)
    return cross(wide.reshape(3, -1), by_shift.reshape(3, -1)).reshape(by_shift.shape)
