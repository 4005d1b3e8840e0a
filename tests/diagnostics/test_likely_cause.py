"""Mistakes of a recording are named by what makes the residuals small; of right data nothing is said."""

import equinox as eqx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics.corrections import likely_cause

BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
SIMULATED = {
    "points": kinds.SimulatedPoints("points", BOX, 20, FRAME, u=0.01),
    "transforms": kinds.SimulatedTransforms("six", BOX, 20, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4),
    "bar 1": kinds.SimulatedArtefact("bar 1", {"a": (0, 0, 0), "b": (300, 0, 0)}, 8, (0, 0, 0, 300, 0, 200)),
    "bar 2": kinds.SimulatedArtefact("bar 2", {"a": (0, 0, 0), "b": (300, 0, 0)}, 8, (0, 0, 1.5, 300, -200, 250)),
    "sphere": kinds.SimulatedSphere("sphere", (300, 0, 300), 50.0, 20, u=0.001),
    "distances": kinds.SimulatedDistances("distances", BOX, 30, (900, 300, 100), u=0.003),
    "planes": kinds.SimulatedPlanes("planes", (200, -200, 100), [(300, 0, 0), (0, 400, 0)], 15, distance=150.0),
}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (lambda q: q, ""),
        (lambda q: q * [1, 1, -1, 1, 1, 1], "joint 3 was read with the wrong sign"),
        (lambda q: q * [1, -1, 1, 1, -1, 1], "joints 2 and 5 were read with the wrong sign"),
        (lambda q: q[:, [0, 1, 3, 2, 4, 5]], "the columns of joints 3 and 4 are exchanged"),
        (lambda q: q[:, ::-1], "the columns are in reverse order"),
        (lambda q: np.roll(q, 1, axis=1), "the first column is that of the last joint"),
        (lambda q: np.roll(q, -1, axis=1), "the last column is that of the first joint"),
        (lambda q: q + np.pi, "the zeros of all joints are half a turn off"),
        (lambda q: q / 0.9, "readings are in gon, but were read as degrees"),
        (np.deg2rad, "readings are in radians, but were read as degrees"),
        (np.rad2deg, "readings are in degrees, but were read as radians"),
        (lambda q: np.random.default_rng(0).uniform(-2, 2, q.shape), ""),
    ],
)
def test_readings_of_sockets(paper_arm, noisy_capture, mistake, cause):
    q = mistake(np.asarray(noisy_capture.q))
    capture = eqx.tree_at(lambda c: c.q, noisy_capture, q)
    check(likely_cause(paper_arm, capture), cause)


def test_poses_under_the_name_of_another_socket(paper_arm, noisy_capture):
    """Neither late rows nor braces in a name, which are no field of a message."""
    (first, *others), (q, *rest) = zip(*noisy_capture.sockets.items(), strict=True)
    sockets = {first: q[:-2], "{x}": np.concatenate([q[-2:], rest[0]])} | dict(zip(others[1:], rest[1:], strict=True))
    cause = f"2 poses recorded under the name of another socket ({first} fits {{x}} pose 1, {{x}} pose 2)"
    check(likely_cause(paper_arm, aj.Capture(sockets)), cause)


def check(mistake, cause):
    said = "" if mistake is None else mistake.says
    assert said.partition(". Correcting")[0] == (f"Likely cause: {cause}" if cause else "")


def requaternioned(read, meant):
    """Rotations whose quaternions are read in one order and meant in another."""

    def mistaken(rotations):
        columns = Rotation.from_matrix(rotations).as_quat(scalar_first=meant == "wxyz")
        return Rotation.from_quat(columns, scalar_first=read == "wxyz").as_matrix()

    return mistaken


@pytest.fixture(scope="module")
def captures(paper_arm):
    """Of an arm 1 mm and 0.1 degrees off the nominal one."""
    true = aj.perturbed_arm(aj.Parameters.independent(paper_arm), length=1.0, angle=np.deg2rad(0.1), seed=1)
    noise = aj.Noise(encoder_arcsec=2, seating=0.005)

    def made(names):
        return aj.simulate(true, {}, observations=[SIMULATED[name] for name in names.split(", ")], noise=noise)

    return {names: made(names) for names in {row[0] for row in MISTAKES}}


LEFT_HANDED = "measured coordinates are left-handed: two columns are exchanged, or one has the wrong sign (points)"
METRES = "measured values are in m, but were read as mm"
MISTAKES = [
    ("points", "points", lambda x: x / 1000, f"{METRES} (points)"),
    ("points", "points", lambda x: x / 25.4, "measured values are in inches, but were read as mm (points)"),
    (
        "points",
        "points",
        lambda x: x * 1000,
        "measured values are in um, but were read as mm (or are in mm, but were read as m) (points)",
    ),
    ("points", "points", lambda x: x[:, [1, 0, 2]], LEFT_HANDED),
    ("points", "points", lambda x: x * [1, -1, 1], LEFT_HANDED),
    ("points", "q", lambda q: q * [-1, 1, 1, 1, 1, 1], "joint 1 was read with the wrong sign"),
    ("points", "q", lambda q: q[:, [1, 0, 2, 3, 4, 5]], "the columns of joints 1 and 2 are exchanged"),
    ("points", "q", np.deg2rad, "readings are in radians, but were read as degrees"),
    ("transforms", "points", lambda x: x[:, [1, 2, 0]], "the columns of positions are y z x (six)"),
    ("transforms", "points", lambda x: x * [-1, 1, 1], "the columns of positions are -x y z (six)"),
    (
        *("transforms", "rotations", requaternioned("wxyz", "xyzw")),
        "quaternions are in the order x y z w, but were read as w x y z (six)",
    ),
    (
        *("transforms", "rotations", requaternioned("xyzw", "wxyz")),
        "quaternions are in the order w x y z, but were read as x y z w (six)",
    ),
    (
        *("transforms", "rotations", lambda rotations: rotations.swapaxes(1, 2)),
        "orientations are those of the instrument in the target's frame (six)",
    ),
    ("bar 1, bar 2", "coordinates", lambda x: x / 1000, f"{METRES} (bar 1, bar 2)"),
    ("sphere, bar 1", "diameter", lambda x: x / 1000, f"{METRES} (sphere)"),
    ("distances, bar 1", "values", lambda x: x / 1000, f"{METRES} (distances)"),
    ("planes, bar 1", "distance", lambda x: x / 1000, f"{METRES} (planes)"),
]


def marked(rows):
    """The first mistake in each field of each observation, and the others among the slow tests, as are distances and
    planes in metres, of which coordinates and diameters are examples."""
    seen = {("distances, bar 1", "values"), ("planes, bar 1", "distance")}
    for names, field, mistake, cause in rows:
        marks = pytest.mark.slow if (names, field) in seen else ()
        seen.add((names, field))
        yield pytest.param(names, field, mistake, cause, marks=marks, id=f"{names}-{cause}")


@pytest.mark.slow
@pytest.mark.parametrize(("names", "field", "mistake", "cause"), list(marked(MISTAKES)))
def test_observations(paper_arm, captures, names, field, mistake, cause):
    def concerned(capture):
        return [getattr(one, field) for one in capture.observations if one.name in cause or field == "q"]

    capture = captures[names]
    wrong = eqx.tree_at(concerned, capture, [mistake(np.asarray(values)) for values in concerned(capture)])
    said = likely_cause(paper_arm, wrong)
    check(said, cause)
    assert (f'write units = {{ {field} = "m" }}.' in said.says) == cause.startswith(METRES)


@pytest.mark.parametrize("names", sorted({row[0] for row in MISTAKES}))
def test_of_right_data_nothing_is_said(paper_arm, captures, names):
    check(likely_cause(paper_arm, captures[names]), "")
