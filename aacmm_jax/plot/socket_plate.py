"""A plate with two conical sockets for a 3-D printer: its solid as STL, and a drawing with its dimensions."""

import math
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from ..camera.printing import MM, pdf_document
from ..core.arguments import Range, checked_fields
from ..core.errors import InputError

_SIDES = 96  # of the polygon that stands for a circle; a multiple of 8, so that corners of squares are among its points
_FLOOR, _BELOW = 1.5, 4.0  # mm: radius of the flat end of a cone, and material below it
_RIM = 8.0  # mm of material around a cone
_CONTACT = math.sqrt(0.5)  # of a ball's radius: that of the circle in which it touches a cone of 90 degrees
_DEEPER = 1.25  # a cone is wider than that circle by this factor
_PAPER = 297.0, 210.0  # mm
_Size = Annotated[float, Range(above=0, unit="mm")]


class SocketPlate(NamedTuple):
    """A plate with two cones of 90 degrees, into which a ball at the tip of an arm is put.

    Args:
        distance: Distance between the axes of the cones, mm.
        ball: Diameter of the ball, mm.

    Example:
        >>> plate = aj.plot.SocketPlate(100.0, 12.7)
        >>> print(f"{plate.width:.1f} mm wide, ball {plate.ball_height:.2f} mm above")
        28.0 mm wide, ball 2.98 mm above
    """

    distance: _Size = 100.0
    ball: _Size = 12.7

    @property
    def radius(self) -> float:
        """Radius of a cone at the upper face, mm: a multiple of 0.5 mm."""
        return math.ceil(_DEEPER * _CONTACT * self.ball) / 2

    @property
    def width(self) -> float:
        """Width of the plate, mm."""
        return 2 * (self.radius + _RIM)

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and thickness, mm."""
        return self.distance + self.width, self.width, self.radius - _FLOOR + _BELOW

    @property
    def ball_height(self) -> float:
        """Height of the centre of a ball above the upper face, mm."""
        return self.ball / 2 / _CONTACT - self.radius


def _checked(plate: SocketPlate) -> SocketPlate:
    plate = checked_fields(plate, "the plate")
    if plate.distance < plate.width or plate.radius <= _FLOOR:
        raise InputError(
            f"sockets for balls of {plate.ball:g} mm that are {plate.distance:g} mm apart do not fit; the distance "
            f"must be at least {plate.width:.1f} mm, and the ball at least {2 * _FLOOR / _DEEPER / _CONTACT:.1f} mm."
        )
    return plate


def socket_plate_stl(plate: SocketPlate) -> bytes:
    """The solid as binary STL, mm, closed; the upper face is z = 0, and the first cone is at the origin.

    Args:
        plate: The plate.

    Returns:
        The file.

    Raises:
        InputError: The sockets do not fit.

    Example:
        >>> len(aj.plot.socket_plate_stl(aj.plot.SocketPlate(100.0, 12.7)))
        77084
    """
    triangles = _triangles(_checked(plate)).astype("<f4")
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    facets = np.zeros(len(triangles), dtype=[("corners", "<f4", (4, 3)), ("attribute", "<u2")])
    facets["corners"] = np.concatenate([normals[:, None], triangles], axis=1)
    header = f"aacmm sockets, mm, distance {plate.distance:g}, ball {plate.ball:g}".encode("ascii").ljust(80)
    return header[:80] + np.uint32(len(triangles)).tobytes() + facets.tobytes()


def _triangles(plate: SocketPlate) -> Float[np.ndarray, "t 3 3"]:
    """Triangles of the surface, counter-clockwise as seen from outside."""
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle, half, depth = np.stack([np.cos(angle), np.sin(angle)], axis=1), plate.width / 2, plate.radius - _FLOOR
    square = half * circle / np.abs(circle).max(axis=1, keepdims=True)
    parts = []

    def ring(flat: np.ndarray, z: float, centre: float) -> np.ndarray:
        return np.column_stack([flat[:, 0] + centre, flat[:, 1], np.full(len(flat), z)])

    def band(outer: np.ndarray, inner: np.ndarray, closed: bool = True) -> None:
        nexts = [np.roll(part, -1, axis=0) for part in (outer, inner)]
        first, second = np.stack([outer, nexts[0], nexts[1]], axis=1), np.stack([outer, nexts[1], inner], axis=1)
        stop = None if closed else -1
        parts.extend([first[:stop], second[:stop]])

    sides = np.isclose(square[:, 0], half), np.isclose(square[:, 0], -half)
    for centre, open_side in ((0.0, sides[0]), (plate.distance, sides[1])):
        top, bottom = ring(square, 0.0, centre), ring(square, -plate.size[2], centre)
        mouth, floor = (ring(radius * circle, z, centre) for radius, z in ((plate.radius, 0.0), (_FLOOR, -depth)))
        band(top, mouth)
        band(mouth, floor)
        for edge, z in ((floor, -depth), (bottom[::-1], -plate.size[2])):
            middle = np.tile([centre, 0.0, z], (_SIDES, 1))
            parts.append(np.stack([edge, np.roll(edge, -1, axis=0), middle], axis=1))
        # The wall, but for the side where the middle of the plate continues.
        wall = ~(open_side & np.roll(open_side, -1))
        follow = [np.roll(part, -1, axis=0) for part in (bottom, top)]
        parts.append(np.stack([bottom, follow[0], follow[1]], axis=1)[wall])
        parts.append(np.stack([bottom, follow[1], top], axis=1)[wall])
    ends = [square[side][np.argsort(square[side][:, 1])] for side in sides]
    left, right = ring(ends[0], 0.0, 0.0), ring(ends[1], 0.0, plate.distance)
    band(right, left, closed=False)
    below = np.array([0.0, 0.0, plate.size[2]])
    band(left - below, right - below, closed=False)
    for row, turned in ((0, False), (-1, True)):
        corners = np.array([left[row] - below, right[row] - below, right[row], left[row]])
        corners = corners[::-1] if turned else corners
        parts.append(corners[[[0, 1, 2], [0, 2, 3]]])
    return np.concatenate(parts)


def socket_plate_pdf(plate: SocketPlate) -> bytes:
    """The drawing, true to scale on A4: from above and in section, with the dimensions in mm.

    Args:
        plate: The plate.

    Returns:
        The PDF.

    Raises:
        InputError: The sockets do not fit, or the plate not on the paper.

    Example:
        >>> aj.plot.socket_plate_pdf(aj.plot.SocketPlate(100.0, 12.7))[:8]
        b'%PDF-1.4'
    """
    (length, width, thick), radius = _checked(plate).size, plate.radius
    if length > _PAPER[0] - 30 or width > _PAPER[1] - 110:
        raise InputError(
            f"a plate of {length:.0f} x {width:.0f} mm does not fit on A4; leave out the drawing, or make it smaller."
        )
    left, above, section = (_PAPER[0] - plate.distance) / 2, 140.0, 60.0
    content = [f"0 G 0 g {MM:.6f} 0 0 {MM:.6f} 0 0 cm 0.25 w"]

    def path(*points: tuple[float, float]) -> None:
        steps = " ".join(f"{x:.4f} {y:.4f} {'l' if i else 'm'}" for i, (x, y) in enumerate(points))
        content.append(f"{steps} S")

    def text(x: float, y: float, words: str) -> None:
        content.append(f"BT /F1 3.2 Tf {x:.3f} {y:.3f} Td ({words}) Tj ET")

    def dimension(start: tuple[float, float], end: tuple[float, float], away: tuple[float, float], words: str) -> None:
        a, b = (np.array(point) + away for point in (start, end))
        path(start, tuple(a))
        path(end, tuple(b))
        path(tuple(a), tuple(b))
        along = 1.5 * (b - a) / np.linalg.norm(b - a)
        for point, step in ((a, along), (b, -along)):
            side = 0.4 * np.array([-step[1], step[0]])
            path(tuple(point + step + side), tuple(point), tuple(point + step - side))
        x, y = (a + b) / 2
        text(x - 0.9 * len(words) if away[1] else x + 1.5, y + 1.2, words)

    ends = left - width / 2, left + plate.distance + width / 2
    low, high, foot = above - width / 2, above + width / 2, section - thick
    path((ends[0], low), (ends[1], low), (ends[1], high), (ends[0], high), (ends[0], low))
    profile, turn = [(ends[0], section)], 2 * np.pi * np.arange(_SIDES + 1) / _SIDES
    for x in (left, left + plate.distance):
        for size in (radius, _FLOOR):
            path(*zip(x + size * np.cos(turn), above + size * np.sin(turn), strict=True))
        path((x - radius - 3, above), (x + radius + 3, above))
        path((x, above - radius - 3), (x, above + radius + 3))
        floor = section - radius + _FLOOR
        profile += [(x - radius, section), (x - _FLOOR, floor), (x + _FLOOR, floor), (x + radius, section)]
        ball = section + plate.ball_height
        path(*zip(x + plate.ball / 2 * np.cos(turn), ball + plate.ball / 2 * np.sin(turn), strict=True))
    path(*profile, (ends[1], section), (ends[1], foot), (ends[0], foot), (ends[0], section))
    second = left + plate.distance
    dimension((left, high), (second, high), (0, 8), f"{plate.distance:g}")
    dimension((ends[0], low), (ends[1], low), (0, -8), f"{length:g}")
    dimension((ends[1], low), (ends[1], high), (8, 0), f"{width:g}")
    dimension((ends[1], foot), (ends[1], section), (8, 0), f"{thick:g}")
    dimension((left - radius, section), (left + radius, section), (0, -thick - 8), f"{2 * radius:g}")
    text(15, 190, f"Cones of 90 deg, {2 * radius:g} mm wide, with a flat end {2 * _FLOOR:g} mm wide.")
    dimension((second, section), (second, ball), (radius + 6, 0), f"{plate.ball_height:.2f}")
    over = plate.distance + plate.ball
    top = ball + plate.ball / 2
    dimension(
        (left - plate.ball / 2, ball), (second + plate.ball / 2, ball), (0, top - ball + 12), f"over balls {over:g}"
    )
    text(15, 200, f"Plate with two sockets for a ball of {plate.ball:g} mm. Dimensions in mm; print at 100 %.")
    text(15, 195, "Measure over two balls with callipers, and state in the manifest what you measured less the ball.")
    return pdf_document("\n".join(content), (_PAPER[0] * MM, _PAPER[1] * MM))
