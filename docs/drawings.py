"""Draws the logo, the Denavit-Hartenberg conventions and the set-ups as SVG, for light and dark pages.

``python docs/drawings.py [NAME ...]``; by default all of them.
"""

import sys
from collections.abc import Callable, Sequence

import numpy as np
from figures import BLUE, COLOURS, DOCS, ORANGE

Point = Sequence[float] | np.ndarray
TEXT = "var(--text)"
FAINT = 0.35  # opacity of the other poses of an arm
SETUP = (640, 300)  # pixels of a set-up, whose table is at y = 250
VIEW = np.array([[0.8, -0.6, 0.0], [0.3, 0.42, -0.86]])  # from x, y, z to the right and down


class Drawing:
    """Shapes in pixels from the upper left corner, written as one SVG."""

    def __init__(self, size: tuple[int, int], title: str) -> None:
        self.size, self.title, self.parts = size, title, []

    def add(self, tag: str, content: object = "", **attributes: object) -> None:
        """One element; underscores in names of attributes stand for hyphens."""
        written = " ".join(f'{name.replace("_", "-")}="{value}"' for name, value in attributes.items())
        self.parts.append(f"<{tag} {written}>{content}</{tag}>")

    def line(self, points: Sequence[Point], colour: str = TEXT, width: float = 1.5, **more: object) -> None:
        """A polyline with round ends."""
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        round_ends = {"stroke_linecap": "round", "stroke_linejoin": "round"}
        self.add("polyline", points=at, fill="none", stroke=colour, stroke_width=width, **round_ends, **more)

    def disc(self, at: Point, radius: float, colour: str = TEXT, **more: object) -> None:
        """A filled circle."""
        self.add("circle", cx=f"{at[0]:.1f}", cy=f"{at[1]:.1f}", r=radius, fill=colour, **more)

    def text(self, at: Point, text: str, colour: str = TEXT, anchor: str = "middle") -> None:
        """A label; an underscore puts the letters after it below the line: d_i."""
        word, _, index = text.partition("_")
        below = f'<tspan dy="4" font-size="11">{index}</tspan>' if index else ""
        self.add("text", word + below, x=f"{at[0]:.1f}", y=f"{at[1]:.1f}", fill=colour, text_anchor=anchor)

    def arrow(self, start: Point, end: Point, colour: str = TEXT, width: float = 1.5, both: bool = False) -> None:
        """A line with a head at its end, or at both."""
        self.line([start, end], colour, width)
        for tip, tail in ((end, start), (start, end))[: 1 + both]:
            back = np.subtract(tail, tip) / max(float(np.linalg.norm(np.subtract(tail, tip))), 1e-9)
            side = np.array([-back[1], back[0]])
            head = [tip + 8 * back + 3.5 * side, tip, tip + 8 * back - 3.5 * side]
            self.line([np.asarray(point) for point in head], colour, width)

    def save(self, name: str) -> None:
        """Write the file."""
        width, height = self.size
        body = "\n".join(self.parts)
        (DOCS / f"{name}.svg").write_text(
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
            f'height="{height}" font-family="system-ui, sans-serif" font-size="14">\n'
            f"<title>{self.title}</title>\n{COLOURS}{body}\n</svg>\n",
            encoding="utf-8",
        )

    def arm(self, base: Point, joints: Sequence[Point], tip: Point, colour: str = BLUE, opacity: float = 1.0) -> None:
        """An arm that stands on a table: links, joints, and a probe with a ball at its end."""
        x, y = base
        self.add("g", opacity=opacity)
        self.parts[-1] = f'<g opacity="{opacity}">'
        self.add("path", d=f"M{x - 26},{y} l10,-26 h32 l10,26 z", fill=colour)
        self.line([(x, y - 20), *joints], colour, 11)
        self.line([joints[-1], tip], colour, 3)
        for joint in joints[:-1]:
            self.disc(joint, 8.5, colour)
            self.disc(joint, 3.5, "#ffffff")
        self.disc(tip, 6, ORANGE)
        self.parts.append("</g>")


def _on_table(title: str) -> Drawing:
    drawing = Drawing(SETUP, title)
    drawing.line([(20, 250), (620, 250)], width=2)
    return drawing


def logo() -> None:
    """The logo: an arm whose ball rests in a socket."""
    drawing = Drawing((120, 120), "aacmm_jax")
    drawing.add("path", d="M14,108 l7,-18 h26 l7,18 z", fill=BLUE)
    drawing.line([(34, 92), (28, 46), (66, 20), (86, 56)], BLUE, 10)
    for joint in ((28, 46), (66, 20)):
        drawing.disc(joint, 8, BLUE)
        drawing.disc(joint, 3.2, "#ffffff")
    drawing.line([(86, 56), (90, 84)], BLUE, 4)
    drawing.add("path", d="M74,108 v-10 l8,-6 h16 l8,6 v10 z", fill=TEXT)
    drawing.disc((90, 86), 8, ORANGE)
    drawing.save("static/logo")


def _turn(axis: str, angle: float) -> np.ndarray:
    """Rotation about x or z as a 4 x 4 matrix."""
    cosine, sine = np.cos(angle), np.sin(angle)
    i, j = (1, 2) if axis == "x" else (0, 1)
    matrix = np.eye(4)
    matrix[[i, i, j, j], [i, j, i, j]] = cosine, -sine, sine, cosine
    return matrix


def _shift(axis: str, by: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix["xyz".index(axis), 3] = by
    return matrix


def _convention(name: str, title: str, steps: Sequence[tuple[str, str, float, str]], first: float) -> None:
    """One joint: from frame i-1, first turned about z, by four steps (kind, axis, amount, label) to frame i."""
    drawing = Drawing((560, 360), title)
    origin = np.array([90.0, 215.0])

    def seen(frame: np.ndarray, *local: float) -> np.ndarray:
        return origin + VIEW @ (frame @ [*local, 1.0])[:3]

    def axes(frame: np.ndarray, index: str) -> None:
        drawing.line([seen(frame, 0, 0, -60), seen(frame, 0, 0, 190)], width=1, stroke_dasharray="9 3 2 3")
        for axis, colour in (("z", TEXT), ("x", TEXT)):
            end = [80.0 * (letter == axis) for letter in "xyz"]
            drawing.arrow(seen(frame, 0, 0, 0), seen(frame, *end), colour, 2.4)
            drawing.text(
                seen(frame, *[1.2 * value for value in end]) + ((-16, 5) if axis == "z" else (2, -4)), f"{axis}_{index}"
            )
        drawing.disc(seen(frame, 0, 0, 0), 4)

    frame = _turn("z", first)
    axes(frame, "i-1")
    for kind, axis, amount, label in steps:
        end = frame @ (_turn(axis, amount) if kind == "turn" else _shift(axis, amount))
        if kind == "shift":
            start, stop = seen(frame, 0, 0, 0), seen(end, 0, 0, 0)
            drawing.line([start, stop], BLUE, 4)
            drawing.text(
                (start + stop) / 2 + ((0, 22) if axis == "x" else (-22, 4) if abs(stop[0] - start[0]) < 5 else (24, 4)),
                label,
                BLUE,
            )
        else:
            radius, angles = (58.0 if axis == "z" else 38.0), np.linspace(0, amount, 30)
            local = [(radius * np.cos(t), radius * np.sin(t), 0) if axis == "z" else
                     (0, -radius * np.sin(t), radius * np.cos(t)) for t in angles]  # fmt: skip
            arc = [seen(frame, *point) for point in local]
            # What turned is drawn before and after: x about z, and z about x.
            for of in (frame, end):
                drawing.line([seen(of, 0, 0, 0), seen(of, *((72, 0, 0) if axis == "z" else (0, 0, 72)))], width=1,
                             opacity=0.6)  # fmt: skip
            drawing.line(arc[:-1], ORANGE, 2)
            drawing.arrow(arc[-4], arc[-1], ORANGE, 2)
            middle = 1.75 * np.array(local[15]) if axis == "z" else 1.45 * np.array(local[12])
            drawing.text(seen(frame, *middle) + np.array([0, 5]), label, ORANGE)
        frame = end
    axes(frame, "i")
    drawing.save(name)


def dh_standard() -> None:
    """Standard Denavit-Hartenberg parameters of a joint: turn and shift along z, then along and about the new x."""
    steps = [("turn", "z", 0.85, "q + θ_i"), ("shift", "z", 120.0, "d_i"), ("shift", "x", 300.0, "a_i"),
             ("turn", "x", 1.0, "\N{GREEK SMALL LETTER ALPHA}_i")]  # fmt: skip
    _convention("explanation/dh_standard", "Standard Denavit-Hartenberg parameters", steps, -0.98)


def dh_craig() -> None:
    """Parameters in Craig's (modified) convention: along and about the old x, then turn and shift along the new z."""
    steps = [("shift", "x", 270.0, "a_i-1"), ("turn", "x", 1.0, "\N{GREEK SMALL LETTER ALPHA}_i-1"),
             ("turn", "z", 0.85, "q + θ_i"),
             ("shift", "z", 120.0, "d_i")]  # fmt: skip
    _convention("explanation/dh_craig", "Denavit-Hartenberg parameters in Craig's convention", steps, -0.05)


def _nest(drawing: Drawing, x: float, y: float, label: str) -> None:
    drawing.add("path", d=f"M{x - 16},{y} v-14 l9,-9 h14 l9,9 v14 z", fill=TEXT)
    drawing.text((x, y + 20), label)


def sockets() -> None:
    """Two sockets a certified length apart; the ball rests in A in one pose after another, and some in B."""
    drawing = _on_table("An arm, two sockets and a certified length")
    for joints in ([(130, 70), (300, 60), (335, 175)], [(200, 110), (400, 60), (500, 170)]):
        drawing.arm((150, 250), joints, (360 if joints[0][0] < 150 else 530, 221), opacity=FAINT)
    drawing.arm((150, 250), [(150, 120), (270, 50), (385, 165)], (360, 221))
    drawing.add("rect", x=330, y=246, width=230, height=10, fill=TEXT)
    for x, label in ((360, "A"), (530, "B")):
        _nest(drawing, x, 246, label)
    drawing.arrow((360, 286), (530, 286), ORANGE, both=True)
    drawing.text((445, 280), "certified length L, with u", ORANGE)
    drawing.save("how_to/sockets")


def plate() -> None:
    """A plate with holes at certified coordinates, put where the arm reaches it; its place is not measured."""
    drawing = _on_table("An arm and a plate of holes")
    drawing.arm((130, 250), [(110, 120), (240, 45), (345, 110)], (378, 180))
    drawing.add("path", d="M330,215 L560,215 L600,160 L385,160 z", fill="none", stroke=TEXT, stroke_width=2)
    for row in range(3):
        for column in range(5):
            drawing.disc((366 + 44 * column + 17 * row, 205 - 17 * row), 4)
    drawing.line([(340, 217), (340, 249)], width=4)
    drawing.line([(550, 217), (550, 249)], width=4)
    drawing.text((508, 148), "certified coordinates of every hole", ORANGE)
    drawing.text((465, 275), "place and tilt are found by the calibration")
    drawing.save("how_to/plate")


def bar() -> None:
    """A ball bar in several placements: the distance of its balls is certified, where it stands is not."""
    drawing = _on_table("An arm and a ball bar in three placements")
    for start, end, opacity in (((330, 235), (480, 235), FAINT), ((560, 90), (560, 235), FAINT),
                                ((330, 110), (470, 200), 1.0)):  # fmt: skip
        drawing.line([start, end], TEXT, 6, opacity=opacity)
        for ball in (start, end):
            drawing.disc(ball, 13, TEXT, opacity=opacity)
    drawing.line([(400, 160), (400, 249)], width=3)
    drawing.arm((130, 250), [(110, 130), (220, 50), (290, 80)], (322, 94))
    drawing.text((445, 128), "certified distance", ORANGE, "start")
    drawing.text((430, 275), "placements differ in place, height and direction")
    drawing.save("how_to/bar")


def tracker() -> None:
    """A tracker measures a reflector on the flange, or a measuring camera a target; where it stands is not measured."""
    drawing = _on_table("An arm with a reflector, and a laser tracker")
    drawing.arm((130, 250), [(110, 120), (235, 55), (310, 120)], (326, 128), opacity=FAINT)
    drawing.arm((130, 250), [(140, 115), (265, 90), (340, 155)], (358, 165))
    drawing.line([(535, 172), (364, 166)], ORANGE, 2, stroke_dasharray="6 4")
    drawing.add("rect", x=528, y=150, width=44, height=40, rx=10, fill=TEXT)
    drawing.line([(550, 190), (550, 205)], TEXT, 10)
    for foot in (515, 550, 585):
        drawing.line([(550, 205), (foot, 250)], TEXT, 3)
    drawing.text((450, 150), "x, y, z with u", ORANGE)
    drawing.text((345, 195), "reflector")
    drawing.text((540, 275), "station: its frame is found")
    drawing.save("how_to/tracker")


def _board(drawing: Drawing, x: float, y: float, cell: float) -> None:
    drawing.add("rect", x=x, y=y, width=6 * cell, height=4 * cell, fill="#ffffff", stroke=TEXT, stroke_width=1.5)
    for row in range(4):
        for column in range(row % 2, 6, 2):
            drawing.add("rect", x=x + column * cell, y=y + row * cell, width=cell, height=cell, fill="#404040")


def _camera(drawing: Drawing, at: Point, angle: float) -> None:
    drawing.parts.append(f'<g transform="translate({at[0]} {at[1]}) rotate({angle})">')
    drawing.add("rect", x=-15, y=-11, width=30, height=22, rx=4, fill=TEXT)
    drawing.add("path", d="M15,-6 l12,-6 v24 l-12,-6 z", fill=ORANGE)
    drawing.parts.append("</g>")


def cameras() -> None:
    """Left: a camera on the arm sees a board that stands still. Right: a camera that stands sees a board on the arm."""
    drawing = _on_table("A camera on the arm and a fixed board; a fixed camera and a board on the arm")
    drawing.arm((70, 250), [(60, 130), (150, 60), (215, 90)], (215, 90))
    _camera(drawing, (222, 100), 70)
    for corner in (190, 280):
        drawing.line([(231, 128), (corner, 215)], ORANGE, 1, stroke_dasharray="5 4")
    _board(drawing, 190, 202, 15)
    drawing.text((160, 275), "fixed board, camera on the arm")
    drawing.arm((390, 250), [(380, 130), (455, 70), (500, 95)], (500, 95))
    _board(drawing, 488, 78, 11)
    _camera(drawing, (600, 190), 235)
    drawing.line([(600, 200), (600, 249)], width=4)
    for corner in ((492, 124), (552, 92)):
        drawing.line([(585, 168), corner], ORANGE, 1, stroke_dasharray="5 4")
    drawing.text((500, 275), "fixed camera, board on the arm")
    drawing.save("how_to/cameras")


DRAWINGS: tuple[Callable[[], None], ...] = (
    logo, dh_standard, dh_craig, sockets, bar, plate, tracker, cameras)  # fmt: skip


def main() -> None:
    """Draw those that are named."""
    named = {draw.__name__: draw for draw in DRAWINGS}
    for name in sys.argv[1:] or named:
        named[name]()


if __name__ == "__main__":
    main()
