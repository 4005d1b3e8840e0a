"""What observations cannot determine, or state wrongly, is refused in one sentence: what, where, and what to do."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from tests.refusals import assert_refused

RANDOM = np.random.default_rng(0)
Q = RANDOM.uniform(-1, 1, (30, 6))
POINTS = RANDOM.uniform(-300, 300, (30, 3))
LINE = np.outer(np.arange(30.0), [1.0, 2.0, 3.0])


def reaching(arm, points):
    """Readings with the tip in these points."""
    named = {str(i): point for i, point in enumerate(points)}
    return np.concatenate(list(aj.simulate(arm, named, poses=1).sockets.values()))


def on_cap(degrees, count=20):
    """Points of a sphere about its top."""
    angle, turn = np.deg2rad(degrees) * np.sqrt(np.linspace(0, 1, count)), 2.4 * np.arange(count)
    cap = [np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)]
    return np.transpose(cap) * 25 + [400, 100, 300]


def ring(radius):
    """Points of a circle."""
    turn = 2.4 * np.arange(25)
    return [400, 100, 300] + radius * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)


def one_orientation(arm, target):
    """Poses of a target in which joint 1 turns the whole arm by little."""
    q = Q[0] + np.linspace(0, 0.02, 20)[:, None] * np.eye(6)[0]
    return kinds.MeasuredPoints("T", q, np.asarray(arm.position(q)), target=target)


SAME_PLACE = (
    "the observations give 20 equations, but there are 24 unknowns (21 parameters and 3 coordinates of the geometry)"
)
COLLINEAR = (
    "the points of observation 'T' lie on one line, so the rotation of its frame about this line is undetermined; "
    "measure points off the line."
)
REFUSED = {
    "fewer equations than unknowns": (
        lambda arm: kinds.Sphere("s", reaching(arm, on_cap(90)), diameter=50),
        f"{SAME_PLACE}; record more poses, fix more parameters, or give both a prior of the parameters and the noise.",
    ),
    "fewer touches than unknowns": (
        lambda arm: kinds.Sphere("s", Q[:3]),
        "sphere 's' has 3 touches, but there are 4 unknowns; record more touches.",
    ),
    "fewer points than a frame needs": (
        lambda arm: kinds.MeasuredPoints("T", Q[:2], POINTS[:2]),
        "observation 'T' has 2 points, but its frame needs at least three; measure more points.",
    ),
    "fewer distances than unknowns": (
        lambda arm: kinds.Distances("d", Q[:3], np.ones(3)),
        "observation 'd' has 3 distances, but its pivot needs at least four; measure more distances.",
    ),
    "a bar of unknown zero": (
        lambda arm: kinds.Distances("d", Q[:4], np.ones(4), constant=True),
        "observation 'd' has 4 distances, but its pivot and constant need at least five; measure more distances.",
    ),
    "collinear points": (
        lambda arm: kinds.MeasuredPoints("T", Q, LINE),
        COLLINEAR,
    ),
    "collinear transforms": (
        lambda arm: kinds.MeasuredTransforms("T", Q, LINE, np.stack([np.eye(3)] * 30), u_angle=1e-3),
        COLLINEAR,
    ),
    "one orientation": (
        lambda arm: one_orientation(arm, "SMR"),
        "target 'SMR' was measured in only one orientation of the last frame, so the position of the target cannot be "
        "distinguished from that of the instrument; record poses in other orientations.",
    ),
    "a plane touched in one line": (
        lambda arm: kinds.Plane("wall", reaching(arm, np.array([400, -100, 200]) + 2 * LINE)),
        "the touches do not determine the geometry of plane 'wall' well enough; record touches that are not on one "
        "line.",
    ),
    "a plane touched twice": (
        lambda arm: kinds.Plane("wall", Q[:2]),
        "plane 'wall' has 2 touches, but there are 3 unknowns; record more touches.",
    ),
    "two planes touched in one line": (
        lambda arm: kinds.ParallelPlanes(
            "block",
            reaching(arm, np.array([400, -100, 200]) + LINE[:15]),
            reaching(arm, np.array([450, -100, 200]) + LINE[:15]),
            50.0,
        ),
        "the touches do not determine the geometry of planes 'block' well enough; record touches that are not on one "
        "line.",
    ),
    "a small cap": (
        lambda arm: kinds.Sphere("s", reaching(arm, on_cap(10))),
        "the touches do not determine the geometry of sphere 's' well enough; distribute the touches over the sphere, "
        "or give its diameter.",
    ),
    "a bore touched in one ring": (
        lambda arm: kinds.Cylinder("bore", reaching(arm, ring(25.0)), diameter=50.0),
        "the touches do not determine the geometry of cylinder 'bore' well enough; distribute the touches around the "
        "cylinder at two heights, or give its diameter.",
    ),
    "a covariance that is not positive": (
        lambda arm: kinds.MeasuredPoints("T", Q, POINTS, covariance=np.diag([1.0, 1.0, -0.1])),
        "covariance of observation 'T' is not symmetric and positive semidefinite; give variances in mm^2.",
    ),
    "a covariance that is not symmetric": (
        lambda arm: kinds.MeasuredTransforms(
            "T", Q, POINTS, np.stack([np.eye(3)] * 30), u_angle=0.1, covariance=np.triu(np.ones((3, 3)))
        ),
        "covariance of observation 'T' is not symmetric and positive semidefinite; give variances in mm^2.",
    ),
    "mixed units": (
        lambda arm: kinds.MeasuredPoints("T", np.rad2deg(Q), POINTS),
        "observation 'T' pose 2 joint 6 is 56.982 rad, more than four revolutions, so the readings are probably in "
        "degrees; convert with numpy.deg2rad.",
    ),
    "a name given twice": (
        lambda arm: [kinds.MeasuredPoints("T", Q, POINTS), kinds.MeasuredPoints("T", Q[:9], POINTS[:9])],
        "two observations have the name 'T'; give them different names.",
    ),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("what", REFUSED)
def test_refused_in_one_sentence(paper_arm, what):
    make, message = REFUSED[what]
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))

    def identified():
        return aj.identify(paper_arm, aj.Capture({}, [], make(paper_arm)), bounds)

    with pytest.raises(aj.InputError) as caught:
        identified()
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ('units = { points = "m" }', ["says mm, but the manifest says m", "correct one of the two"]),
        ('[[points]]\nname = "a"\nfile = "b.csv"', ["two observations have the name 'a'", "give them different names"]),
        ('target = "a\\nb"', ["target of observation 'a' has the name", "a text of one line"]),
    ],
)
def test_refused_in_a_manifest(tmp_path, text, parts):
    header = ",".join([*(f"q{i}_rad" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"])
    for name, rows in (("a.csv", Q), ("b.csv", Q[:9])):
        lines = [",".join(map(repr, map(float, row))) for row in np.hstack([rows, POINTS[: len(rows)]])]
        (tmp_path / name).write_text("\n".join([header, *lines]))
    head = 'arm = "cheng2018-simulation"\n[[points]]\npreset = "ipa"\nfile = "a.csv"\n'
    (tmp_path / "m.toml").write_text(head + text.replace("b.csv", 'b.csv"\npreset = "ipa', 1))
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "m.toml"), tmp_path / "m.toml", *parts)
