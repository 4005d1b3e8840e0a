"""Cells: obstacles of a file, and bodies from the collision shapes of a URDF."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.files import load_cell
from aacmm_jax.files.cells import bounding_capsule, mesh_path
from aacmm_jax.kinematics import Box, HalfSpace, Post, clearances
from aacmm_jax.kinematics.collisions import capsule_ends
from tests.example_counts import example_count

CELL = """\
clearance = 4.0
[body]
radius = 50.0
[[half_space]]
name = "floor"
normal = [0, 0, 1]
point = [0, 0, -10]
[[box]]
name = "cabinet"
centre = [0, 700, 300]
size = [400, 200, 600]
[[capsule]]
name = "post"
start = [500, 500, 0]
end = [500, 500, 900]
radius = 30.0
"""

LINKS = """\
<robot name="two">
  <link name="base"><collision><origin xyz="0 0 0.1"/><geometry><cylinder radius="0.05" length="0.2"/></geometry>
  </collision></link>
  <link name="one"><collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.06 0.08"/></geometry></collision></link>
  <link name="two"><collision><origin xyz="0.05 0 0" rpy="0 0 0.5"/>
    <geometry><mesh filename="package://two/meshes/two.MESH" scale="0.001 0.001 0.001"/></geometry></collision>
    <collision><geometry><sphere radius="0.03"/></geometry></collision></link>
  <link name="tip"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/><origin xyz="0 0 0.25"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2"/></joint>
  <joint name="b" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.4 0 0"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2"/></joint>
  <joint name="c" type="fixed"><parent link="two"/><child link="tip"/><origin xyz="0.3 0 0"/></joint>
</robot>
"""
VERTICES = np.random.default_rng(0).uniform((-40, -20, -10), (260, 20, 30), (60, 3))  # mm


def stl(vertices, text: bool) -> bytes:
    triangles = vertices.reshape(-1, 3, 3)
    if text:
        rows = ["solid two"]
        for triangle in triangles:
            rows += ["facet normal 0 0 0", "outer loop", *(f"vertex {x:.9g} {y:.9g} {z:.9g}" for x, y, z in triangle)]
            rows += ["endloop", "endfacet"]
        return "\n".join([*rows, "endsolid"]).encode()
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in triangles)
    return b"solid binary".ljust(80) + struct.pack("<I", len(triangles)) + body


MESHES = {
    "binary.stl": stl(VERTICES, False),
    "text.stl": stl(VERTICES, True),
    "mesh.obj": "\n".join(["# a", *(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in VERTICES), "f 1 2 3"]).encode(),
}


def written(folder, name: str):
    """The URDF in a package, with its mesh beside it where there is one."""
    (folder / "two" / "urdf").mkdir(parents=True)
    (folder / "two" / "meshes").mkdir()
    path = folder / "two" / "urdf" / "two.urdf"
    path.write_text(LINKS.replace("two.MESH", name))
    if name in MESHES:
        (folder / "two" / "meshes" / name).write_bytes(MESHES[name])
    return path


def capsule_distance(points, start, end, radius):
    """How far points are outside a capsule."""
    along = end - start
    part = np.clip((points - start) @ along / max(along @ along, 1e-30), 0, 1)
    return np.linalg.norm(points - start - part[:, None] * along, axis=1) - radius


def test_a_cell_of_a_file(tmp_path):
    (tmp_path / "cell.toml").write_text(CELL)
    found = load_cell("panda", tmp_path / "cell.toml")
    assert found.cell.clearance == 4.0
    assert found.cell.obstacles == (
        HalfSpace("floor", (0, 0, 1), (0, 0, -10)),
        Box("cabinet", (0, 700, 300), (400, 200, 600), (0, 0, 0)),
        Post("post", (500, 500, 0), (500, 500, 900), 30.0),
    )
    assert set(found.cell.body.radius[:-1]) == {50.0}
    assert found.notes == ()
    slender = load_cell("panda", radius=None)
    assert "5 % of the total length of the links" in slender.notes[0]
    assert set(load_cell("panda", tmp_path / "cell.toml", radius=33.0).cell.body.radius[:-1]) == {33.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_shapes_of_a_urdf_are_held_by_capsules(tmp_path, name):
    """All vertices of box and mesh, and the cylinder's rims, at several configurations, placed here by the joints."""
    path = written(tmp_path, name)
    arm = to_numpy(aj.load_arm(path))
    body = load_cell(path).cell.body
    assert body.names == ("base", "one", "two/1", "two/2")
    assert body.pairs.tolist() == [[0, 2], [0, 3]]
    q = np.random.default_rng(1).uniform(-2, 2, (5, 2))
    starts, ends = (np.moveaxis(part, -1, 0) for part in capsule_ends(body, arm, q))
    angles = np.linspace(0, 2 * np.pi, 40)
    rim = 50 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    base = np.concatenate([np.hstack([rim, np.full((40, 1), z)]) for z in (0, 200)])
    box = np.array([[x, y, z] for x in (0, 400) for y in (-30, 30) for z in (-40, 40)], dtype=float)
    turned = np.array([[np.cos(0.5), -np.sin(0.5), 0], [np.sin(0.5), np.cos(0.5), 0], [0, 0, 1]])
    mesh = VERTICES @ turned.T + [50, 0, 0]
    for (a, b), start, end in zip(q, starts, ends, strict=True):
        first = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        second = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
        at_one = box @ first.T + [0, 0, 250]
        at_two = (mesh @ second.T + [400, 0, 0]) @ first.T + [0, 0, 250]
        for points, i in ((base, 0), (at_one, 1), (at_two, 2)):
            outside = capsule_distance(points, start[i], end[i], body.radius[i])
            assert outside.max() <= 1e-4  # the mesh is of single precision
            assert outside.max() > -20  # and no larger than needed
    assert np.all(np.isfinite(clearances(load_cell(path).cell, arm, q)))


@settings(max_examples=example_count(15))
@given(arrays.arrays(float, (12, 3), elements=st.integers(-50, 50).map(float)))
def test_a_bounding_capsule_holds_its_points(points):
    start, end, radius = bounding_capsule(points)
    assert capsule_distance(points, start, end, radius).max() <= 1e-9
    widest = np.linalg.norm(points[:, None] - points[None], axis=2).max()
    assert np.linalg.norm(end - start) + 2 * radius <= 2 * widest + 1e-9


@pytest.mark.slow
def test_meshes_that_are_not_at_hand(tmp_path):
    """The links' other shapes stand for them, or capsules about the D-H row; both are said."""
    path = written(tmp_path, "two.dae")
    found = load_cell(path)
    assert found.notes == (
        "the meshes of two are not available as STL or OBJ files; only the other collision shapes that move with the "
        "same joints are checked.",
    )
    assert found.cell.body.names == ("base", "one", "two/2")
    path.write_text(path.read_text().replace('<sphere radius="0.03"/>', "<ellipsoid/>"))
    found = load_cell(path)
    assert "each of these links is modelled as capsules" in found.notes[0]
    assert found.cell.body.names[-1] != "two"
    (path.parent / "plain.urdf").write_text(LINKS.replace("collision", "visual"))
    assert "5 % of the total length of the links" in load_cell(path.parent / "plain.urdf").notes[0]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            ("size = [400, 200, 600]", "size = [400, 0, 600]"),
            "cell.toml: size.1. of obstacle 'cabinet' is 0 mm; it must be positive",
        ),
        (("radius = 30.0", "radius = -30.0"), "cell.toml.*radius"),
        (("[[capsule]]", "[[sphere]]"), "cell.toml.*sphere"),
        (
            ("radius = 50.0", "radius = [1.0, 2.0]"),
            "cell.toml: radius has shape .2,.; give one number, or .joints,. with 7 joints",
        ),
        (("normal = [0, 0, 1]", "normal = [0, 0]"), "cell.toml.*normal"),
    ],
)
def test_refused(tmp_path, change, text):
    (tmp_path / "cell.toml").write_text(CELL.replace(*change))
    with pytest.raises(aj.InputError, match=text):
        load_cell("panda", tmp_path / "cell.toml")


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("change", "text"),
    [
        (('size="0.4 0.06 0.08"', 'size="0.4 0 0.08"'), "<box> of link 'one' has no positive size"),
        (('radius="0.05" length="0.2"', 'radius="0.05"'), "give its radius and length"),
        (('<sphere radius="0.03"/>', '<sphere radius="x"/>'), "<sphere> of link 'two' has radius = 'x'"),
    ],
)
def test_refused_shapes(tmp_path, change, text):
    path = written(tmp_path, "text.stl")
    path.write_text(path.read_text().replace(*change))
    assert aj.load_arm(path).joints == 2
    with pytest.raises(aj.InputError, match=text):
        load_cell(path)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("content", [b"solid nothing\n", b"vertex 1 2 x\n", b"vertex nan 0 0\n"])
def test_refused_meshes(tmp_path, content):
    path = written(tmp_path, "text.stl")
    (tmp_path / "two" / "meshes" / "text.stl").write_bytes(content)
    with pytest.raises(aj.InputError, match=r"text\.stl has"):
        load_cell(path)


def test_a_mesh_on_a_drive_is_found(tmp_path):
    """Windows writes a path with a drive as file:///C:/...; here C: is a folder."""
    (tmp_path / "C:").mkdir()
    (tmp_path / "C:" / "link.stl").write_bytes(b"")
    assert mesh_path("file:///C:/link.stl", tmp_path) == tmp_path / "C:" / "link.stl"
    assert mesh_path(f"file://{tmp_path}/C:/link.stl", tmp_path) == tmp_path / "C:" / "link.stl"
