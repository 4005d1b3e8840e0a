"""Bodies, obstacles and cones: where capsules are, worked clearances, and configurations brought into cones."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_jax, to_numpy
from aacmm_jax.kinematics import Box, Cell, Cone, HalfSpace, Post, body_along_links, clearances
from aacmm_jax.kinematics.collisions import (
    capsule_ends,
    checked_cell,
    distance_from_box,
    is_clear,
    nearest_contact,
    segment_distance,
)
from aacmm_jax.kinematics.workspace import cones_of, into_cones, skeleton, tilts

UP = (0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def panda():
    return to_numpy(aj.load_arm("panda"))


@pytest.fixture(scope="module")
def planar():
    """Two links of 100 mm in the x, y plane, and a probe of 50 mm."""
    return to_numpy(aj.Arm(alpha=[0, 0, 0], a=[100, 100, 50], d=[0, 0, 0]))


def configurations(arm, count=50):
    return np.random.default_rng(0).uniform(-2, 2, (count, arm.joints))


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("beta", [False, True])
def test_capsules_are_along_the_skeleton(panda, beta):
    """Their ends are corners of the skeleton, which is computed in another way; also with Hayati's angle."""
    arm = panda.replace(beta=np.linspace(0.1, 0.7, 7)) if beta else panda
    q = configurations(arm)
    body = body_along_links(arm, 60.0, 8.0)
    corners = skeleton(arm, q)
    for name, start, end in zip(body.names, *capsule_ends(body, arm, q), strict=True):
        ends = [start.T] if name == "probe" else [start.T, end.T]
        for at in ends:
            assert np.linalg.norm(corners - at[:, None], axis=2).min(axis=1).max() < 1e-9
    tool = capsule_ends(body, arm, q)[1][-1].T
    np.testing.assert_allclose(np.linalg.norm(tool - corners[:, -1], axis=1), 16.0, atol=1e-9)


@pytest.mark.parametrize(
    ("obstacle", "distance"),
    [
        # The arm is straight along x, from 0 to 250, with a radius of 10.
        (HalfSpace("floor", UP, (0, 0, -30)), 20.0),
        (HalfSpace("wall", (-2.0, 0, 0), (265, 0, 0)), 5.0),
        (Box("box", (100, 0, 60), (20, 20, 60)), 20.0),
        (Box("turned", (100, 0, 60), (40, 40, 40), (0, math.pi / 4, 0)), 60 - 20 * math.sqrt(2) - 10),
        (Post("post", (50, 40, -100), (50, 40, 100), 7.0), 23.0),
        (Box("inside", (100, 0, 0), (50, 50, 50)), -10.0),
    ],
    ids=lambda value: value.name if hasattr(value, "name") else "",
)
def test_worked_clearances(planar, obstacle, distance):
    cell = Cell(body_along_links(planar, 10.0), (obstacle,))
    assert float(clearances(cell, planar, np.zeros((1, 3)))[0]) == pytest.approx(distance, abs=1e-9)


def test_an_arm_that_folds_onto_itself(planar):
    """The last link comes back along the first: 100 mm long and bent by a right angle, then parallel at 100 mm."""
    cell = Cell(body_along_links(planar, 10.0))
    assert cell.body.pairs.tolist() == [[0, 2]]
    q = np.array([[0, math.pi / 2, math.pi / 2], [0, math.radians(170), 0.0]])
    found = clearances(cell, planar, q)
    assert found[0] == pytest.approx(80.0)
    assert nearest_contact(cell, planar, q[0]) == ("link a_1", "link a_3")


@pytest.mark.slow
def test_clearances_under_jit(panda):
    cell = Cell(body_along_links(panda, 60.0), (Box("box", (400, 0, 200), (200, 200, 200), (0.1, 0.2, 0.3)),))
    q = configurations(panda, 7)
    traced = jax.jit(lambda arm, q: clearances(cell, arm, q))(to_jax(panda), jax.numpy.asarray(q))
    np.testing.assert_allclose(traced, clearances(cell, panda, q), atol=1e-9)


def test_what_always_touches_is_left_out_and_named(panda):
    limits = np.asarray(panda.limits)
    table = HalfSpace("table", UP, (0, 0, 0))
    cell = checked_cell(panda, Cell(body_along_links(panda, 60.0), (table,)), limits)
    assert cell.unchecked == (("offset d_1", "table"),)
    fat = checked_cell(panda, Cell(body_along_links(panda, 60.0)._replace(radius=np.full(8, 140.0))), limits)
    assert fat.unchecked == (("offset d_5", "probe"),)
    assert len(fat.body.pairs) == len(cell.body.pairs) - 1
    down = np.array([[0, 1.5, 0, -0.3, 0, 1.0, 0]])  # an elbow that is stretched downwards
    assert is_clear(cell, panda, configurations(panda, 200)).sum() > 20
    assert not is_clear(cell._replace(obstacles=(HalfSpace("ceiling", (0, 0, -1.0), (0, 0, 400)),)), panda, down)[0]


@pytest.mark.parametrize(
    ("obstacles", "text"),
    [
        ((HalfSpace("w", (0.0, 0, 0), (0.0, 0, 0)),), "normal of obstacle 'w' has the length 0"),
        ((Box("b", (0.0, 0, 0), (1.0, -1, 1)),), "size\\[1\\] of obstacle 'b' is -1 mm; it must be positive"),
        ((Post("p", (0.0, 0, 0), (1.0, 0, 0), 0.0),), "radius of obstacle 'p' is 0; it must be positive"),
        ((Box("b", (math.nan, 0, 0), (1.0, 1, 1)),), "centre\\[0\\] of obstacle 'b' is nan; give finite numbers"),
        ((Post("p", (0.0, 0, 0), (1.0, 0, 0), 1.0),) * 2, "two obstacles have the name 'p'"),
    ],
)
def test_refused_obstacles(planar, obstacles, text):
    limits = np.tile([-2.0, 2.0], (3, 1))
    with pytest.raises(aj.InputError, match=text):
        checked_cell(planar, Cell(body_along_links(planar, 10.0), obstacles), limits)


@pytest.mark.parametrize(
    ("radius", "text"),
    [
        (0.0, "radius is 0 mm; it must be positive and at most 2000"),
        ([1.0, 2.0], "one number, or .* with 3 joints"),
    ],
)
def test_refused_radii(planar, radius, text):
    with pytest.raises(aj.InputError, match=text):
        body_along_links(planar, radius)


def test_tilts(panda):
    """By hand: the tool of the straight-up Panda points up, and z of its first frame is the base's."""
    q = np.array([[0.0, 0, 0, 0, 0, 0, 0], [0.3, 0, 0, 0, 0, math.pi, 0]])
    axis = np.asarray(panda.pose(q))[:, :3, 2]
    cones = cones_of([Cone(), Cone(normal=(0, 0, 5.0))])
    np.testing.assert_allclose(tilts(panda, q, cones), np.arccos(-axis[:, 2]), atol=1e-7)
    sideways = cones_of([Cone(), Cone()], (0.0, 1.0, 0.0))
    y = np.asarray(panda.pose(q))[:, :3, 1]
    np.testing.assert_allclose(tilts(panda, q, sideways), np.arccos(-y[:, 2]), atol=1e-7)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, -1.0, 0.0)])
def test_configurations_are_brought_into_cones(panda, normal):
    """Half of random starts arrive, hardly any by chance; those that do are there and tilt no more than they may."""
    count, limits = 300, np.asarray(panda.limits)
    starts = np.random.default_rng(1).uniform(limits[:, 0], limits[:, 1], (count, 7))
    target = np.tile([450.0, 100, 300], (count, 1))
    cones = cones_of([Cone(math.radians(15), normal)]).at(np.zeros(count, dtype=int))
    q, good = into_cones(panda, starts, target, limits, cones, 40)
    assert good.mean() > 0.3
    q, cones = q[good], cones.at(np.flatnonzero(good))
    assert np.abs(np.asarray(panda.position(q)) - target[good]).max() < 1e-6
    tool = np.asarray(panda.pose(q))[:, :3, 2]
    unit = np.array(normal) / np.linalg.norm(normal)
    assert np.degrees(np.arccos(np.clip(-tool @ unit, -1, 1))).max() <= 15.0 + 1e-6
    assert np.all((q >= limits[:, 0]) & (q <= limits[:, 1]))


@pytest.mark.parametrize(
    ("cone", "axis", "text"),
    [
        (Cone(0.0), UP, "half_angle.0. is 0 deg; it must be positive and at most 180"),
        (Cone(4.0), UP, "half_angle.0. is 229"),
        (Cone(normal=(0, 0, 0.0)), UP, "has the length 0"),
        (Cone(), (0.0, 0.0, 0.0), "has the length 0"),
    ],
)
def test_refused_cones(cone, axis, text):
    with pytest.raises(aj.InputError, match=text):
        cones_of([cone], axis)


COORDINATE = st.integers(-6, 6).map(lambda x: 20.0 * x)  # on a grid, so that parallel and touching ones come often
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE)
FRACTIONS = np.linspace(0, 1, 161)


def column(point) -> np.ndarray:
    return np.array(point, dtype=float)[:, None]


def along(start, end) -> np.ndarray:
    """Points of a segment, close to each other."""
    return column(start).T + FRACTIONS[:, None] * (column(end) - column(start)).T


@given(POINT, POINT, POINT, POINT)
def test_segments(a, b, c, d):
    """No two points are nearer than the distance, and some are as near but for the steps between samples."""
    found = float(segment_distance(*map(column, (a, b, c, d)))[0])
    sampled = np.linalg.norm(along(a, b)[:, None] - along(c, d)[None], axis=-1).min()
    step = (np.linalg.norm(np.subtract(a, b)) + np.linalg.norm(np.subtract(c, d))) / 160 / 2
    assert found - 1e-6 <= sampled <= found + step + 1e-6
    assert found == pytest.approx(float(segment_distance(*map(column, (d, c, a, b)))[0]), abs=1e-5)


@given(POINT, POINT, st.tuples(*[st.sampled_from([10.0, 40.0, 75.0])] * 3))
def test_boxes(a, b, half):
    found = float(distance_from_box(column(a), column(b), column(half))[0])
    points = along(a, b)
    sampled = np.linalg.norm(points - np.clip(points, -np.array(half), np.array(half)), axis=-1).min()
    assert found - 1e-9 <= sampled <= found + np.linalg.norm(np.subtract(a, b)) / 160 / 2 + 1e-9


@pytest.mark.parametrize(
    ("segments", "distance"),
    [
        (((0, 0, 0), (10, 0, 0), (5, -5, 3), (5, 5, 3)), 3.0),  # crossing
        (((0, 0, 0), (10, 0, 0), (4, 4, 0), (14, 4, 0)), 4.0),  # parallel, side by side
        (((0, 0, 0), (10, 0, 0), (13, 4, 0), (20, 4, 0)), 5.0),  # parallel, one after the other
        (((0, 0, 0), (0, 0, 0), (3, 4, 0), (3, 4, 0)), 5.0),  # points
        (((0, 0, 0), (10, 0, 0), (5, 0, 0), (5, 9, 0)), 0.0),  # touching
    ],
)
def test_worked_distances(segments, distance):
    assert float(segment_distance(*map(column, segments))[0]) == pytest.approx(distance, abs=1e-12)


@pytest.mark.slow
def test_under_jax_with_derivatives():
    """The same numbers under jit, and derivatives as differences say."""
    points = jnp.asarray(np.random.default_rng(0).normal(size=(4, 3, 5)) * 100)
    half = np.array([[20.0], [30.0], [10.0]])

    def total(points):
        return jnp.sum(segment_distance(*points)) + jnp.sum(distance_from_box(points[0], points[1], half))

    value, gradient = jax.jit(jax.value_and_grad(total))(points)
    assert float(value) == pytest.approx(float(total(np.asarray(points))), rel=1e-12)
    change = 1e-4 * np.random.default_rng(1).normal(size=points.shape)
    difference = (total(np.asarray(points) + change) - total(np.asarray(points) - change)) / 2
    assert float(jnp.sum(gradient * change)) == pytest.approx(float(difference), rel=1e-4)
