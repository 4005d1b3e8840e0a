"""A plate with two sockets: a closed solid of the volume that its dimensions say, its file and its drawing."""

import collections

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.plot.socket_plate import socket_plate_pdf, socket_plate_stl


@pytest.mark.parametrize(("distance", "ball"), [(100.0, 12.7), (60.0, 10.0), (210.0, 38.1)])
def test_the_solid(distance, ball):
    plate = aj.plot.SocketPlate(distance, ball)
    content = socket_plate_stl(plate)
    count = int(np.frombuffer(content[80:84], "<u4")[0])
    assert len(content) == 84 + 50 * count
    facets = np.frombuffer(content[84:], dtype=[("corners", "<f4", (4, 3)), ("attribute", "<u2")])["corners"]
    triangles = facets[:, 1:].astype(float)
    edges = collections.Counter(
        (tuple(triangle[i]), tuple(triangle[i - 2])) for triangle in triangles for i in range(3)
    )
    assert all(n == 1 and edges[end, start] == 1 for (start, end), n in edges.items())  # closed, turned one way
    volume = np.sum(triangles[:, 0] * np.cross(triangles[:, 1], triangles[:, 2])) / 6
    circle, deep = 48 * np.sin(2 * np.pi / 96), plate.radius - 1.5  # area of a polygon of 96 sides
    cone = circle * deep / 3 * (plate.radius**2 + 1.5 * plate.radius + 1.5**2)
    assert volume == pytest.approx(np.prod(plate.size) - 2 * cone, rel=1e-6)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.testing.assert_allclose(np.sum(normals * facets[:, 0], axis=1), np.linalg.norm(normals, axis=1), rtol=1e-4)
    # A ball at the stated height touches the cone, which is wider than the circle of contact.
    surface = (plate.ball_height + plate.radius) * np.sqrt(0.5)  # distance of its centre from the cone
    assert surface == pytest.approx(ball / 2)
    assert ball / 2 * np.sqrt(0.5) < plate.radius


def test_the_drawing_states_the_dimensions():
    plate = aj.plot.SocketPlate(100.0, 12.7)
    text = socket_plate_pdf(plate).decode("ascii")
    for number in ("(100)", f"({plate.size[0]:g})", f"({plate.size[2]:g})", "(over balls 112.7)"):
        assert number in text


@pytest.mark.parametrize(("distance", "ball"), [(20.0, 12.7), (100.0, 1.0), (0.0, 12.7)])
def test_what_does_not_fit(distance, ball):
    with pytest.raises(aj.InputError):
        socket_plate_stl(aj.plot.SocketPlate(distance, ball))


def test_a_plate_that_is_larger_than_the_paper():
    with pytest.raises(aj.InputError, match="does not fit on A4"):
        socket_plate_pdf(aj.plot.SocketPlate(400.0, 12.7))
