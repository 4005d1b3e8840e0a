"""What observations determine: ranks that follow from geometry, and the words for what is open."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data import observations as kinds
from aacmm_jax.uncertainty.observed_identifiability import Agreeing
from aacmm_jax.uncertainty.target_parameters import independent_of_targets

from ..conftest import EXAMPLES

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
SLOW = pytest.mark.slow
BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
CORNER, SIDES = (200, -200, 100), [(300, 0, 0), (0, 400, 0)]
CENTRES = [(300, 0, 300), (500, 200, 200), (300, -300, 150)]
CYLINDERS = [
    [(300, 0, 300), (330, 40, 330)],
    [(500, 200, 150), (500, 200, 250)],
    [(250, -300, 200), (400, -300, 220)],
]
RIGID = {"d_1", "theta_1"}  # they move the whole arm
LAST = {"a_6 and theta_6 trade off", "alpha_6 and d_6 trade off"}
SCALE = "all lengths together: the scale"

# Observations, the geometry that follows a motion of the whole arm, and whether they determine the scale.
CASES = {
    "points": ([kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01)], "frame of T", True),
    "certified spheres": (
        [kinds.SimulatedSphere(f"s{i}", centre, 50.0, 25) for i, centre in enumerate(CENTRES)],
        "centre of s0, centre of s1 and centre of s2",
        True,
    ),
    "spheres": (
        [kinds.SimulatedSphere(f"s{i}", centre, 50.0, 25, certified=False) for i, centre in enumerate(CENTRES)],
        "centre of s0, centre of s1 and centre of s2",
        False,
    ),
    "certified cylinders": (
        [kinds.SimulatedCylinder(f"c{i}", CYLINDERS[i], 50.0, 30, stylus=6.0, inside=i == 1) for i in range(3)],
        "axis of c0, axis of c1 and axis of c2",
        True,
    ),
    "one plane": ([kinds.SimulatedPlanes("wall", CORNER, SIDES, 100)], "plane wall", False),
    "parallel planes": (
        [kinds.SimulatedPlanes("pair", CORNER, SIDES, 60, distance=150.0, u=0.001)],
        "plane pair",
        True,
    ),
    "distances": ([kinds.SimulatedDistances("d", BOX, 90, (900, 300, 100), u=0.003)], "pivot of d", True),
}


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("case", "noise"),
    [
        *(pytest.param(case, None, id=f"{case}-plain") for case in CASES),
        *(
            pytest.param(case, NOISE, id=f"{case}-whitened", marks=() if case in ("points", "spheres") else SLOW)
            for case in CASES
        ),
    ],
)
def test_what_a_kind_alone_determines(paper_arm, case, noise):
    """Of 25 parameters four never; the scale only where a size is certified. The arm is 1 mm and 0.1 degrees off."""
    simulated, geometry, has_scale = CASES[case]
    true = aj.perturbed_arm(aj.Parameters.independent(paper_arm), length=1.0, angle=np.deg2rad(0.1), seed=1)
    capture = aj.simulate(true, {}, observations=simulated, noise=NOISE, seed=3)
    space = aj.Parameters.free_of(paper_arm, held=("probe_x", "probe_y"))
    seen = aj.observability(paper_arm, capture, space, noise=noise)
    joined = "," if " and " in geometry else " and"
    rigid = {f"{name}{joined} {geometry} trade off" for name in RIGID}
    assert set(seen.undetermined) == rigid | LAST | (set() if has_scale else {SCALE})
    assert seen.rank == (21 if has_scale else 20)
    structural = {text for text, never in zip(seen.undetermined, seen.structural, strict=True) if never}
    assert structural == rigid | LAST
    assert seen.remedy == ("" if has_scale else "A reference length would determine these parameters.")
    assert seen.poses == sum(observation.q.shape[0] for observation in capture.observations)


def test_a_target_takes_the_place_of_the_probe(paper_arm):
    simulated = kinds.SimulatedTransforms("T6", BOX, 40, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4)
    space = aj.Parameters.independent(paper_arm)
    true = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)
    capture = aj.simulate(true, {}, observations=[simulated], noise=NOISE, seed=3)
    seen = aj.observability(paper_arm, capture, space)
    assert set(seen.undetermined) == {
        "d_6 and offset of T6 trade off",
        "theta_6, orientation of T6 and offset of T6 trade off",
        "probe_z (has no effect on the measurements)",
    }


@pytest.mark.slow
def test_transforms_that_an_arm_of_five_joints_cannot_take():
    """An arm that is not yet calibrated reaches none of them exactly, and still all that is free is determined."""
    arm, random = to_numpy(aj.load_arm("so100")), np.random.default_rng(0)
    limits = np.asarray(arm.limits)
    q = random.uniform(limits[:, 0], limits[:, 1], (40, 5))
    true = aj.perturbed_arm(aj.Parameters.free_of(arm), length=1.0, angle=np.deg2rad(0.1), seed=1)
    seen = np.asarray(to_numpy(true).pose(q))
    probe = kinds.MeasuredTransforms("T6", q, seen[:, :3, 3], seen[:, :3, :3], u=0.02, u_angle=1e-4)
    capture = aj.Capture({}, observations=[probe])
    space = independent_of_targets(arm, capture)
    both = aj.Parameters(space.base, (*space.names, "a_5"))  # that only moves the target in the last frame
    found = aj.observability(arm, capture, both)
    assert found.rank == len(space.names) == 14
    assert found.undetermined == ("a_5 and offset of T6 trade off",)


def test_one_bar_on_a_platform_that_turns_half_a_revolution(paper_arm):
    """The geometry agrees with any arm that is nearly right, however far apart the indices are."""
    turns = (0, 180)
    bar, origin = {"a": (0, 0, 0), "b": (300, 0, 0)}, np.array([-150, 0, 50])
    observations = [
        kinds.SimulatedArtefact(
            f"index {turn}",
            bar,
            8,
            (0, 0, angle + 0.3, *(np.array([350, 0, 200]) + rotation_matrix(np.array([0, 0, angle])) @ origin)),
            u=0.001,
            artefact="bar",
            placement="on the platform",
            index=str(turn),
        )
        for turn, angle in zip(turns, np.deg2rad(turns), strict=True)
    ]
    true = aj.perturbed_arm(aj.Parameters.independent(paper_arm), length=1.0, angle=np.deg2rad(0.1), seed=1)
    capture = aj.simulate(true, {}, observations=observations, noise=NOISE, seed=4)
    seen = aj.observability(paper_arm, capture, aj.Parameters.independent(paper_arm), noise=NOISE)
    assert seen.rank == 21
    assert not seen.undetermined


def test_indices_agree_with_eliminated_sockets(paper_arm):
    """A socket as an observation is a socket."""
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300)}
    sockets = aj.simulate(paper_arm, points, poses=20, lengths=[("A", "B", 0.001)], noise=NOISE)
    q = sockets.sockets
    written = aj.Capture({name: q[name] for name in "AB"}, sockets.lengths, [kinds.Socket("C", q["C"])])
    space = aj.Parameters.independent(paper_arm)
    for noise in (None, NOISE):
        one, other = (aj.observability(paper_arm, capture, space, noise=noise) for capture in (sockets, written))
        np.testing.assert_allclose(other.singular, one.singular, rtol=1e-9)
        assert other.condition == pytest.approx(one.condition, rel=1e-9)
        assert other.rank == one.rank == len(space.names)


def test_lengths_of_measured_sockets_weigh_as_their_poses_scatter(paper_arm):
    """A length that is exact determines the scale as well as the poses at its ends say where these are."""
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300)}
    capture = aj.simulate(paper_arm, points, poses=20, lengths=[("A", "B", 1e-9)], noise=NOISE)
    few = aj.Capture({name: q[:5] for name, q in capture.sockets.items()}, capture.lengths)
    space = aj.Parameters(paper_arm, ("d_1", "a_2", "a_3", "d_4", "probe_z"))
    many, less = (aj.observability(paper_arm, one, space, sigma=0.01) for one in (capture, few))
    assert many.rank == less.rank == 4  # d_1 moves the whole arm
    agreeing = Agreeing.of(*to_numpy((capture, space)))
    by_sigma = agreeing.eliminated(0.01).relations
    np.testing.assert_allclose(by_sigma, agreeing.eliminated().relations / (0.01 * np.sqrt(2 / 20)), rtol=1e-6)


@pytest.mark.slow
def test_calibrate_warns_of_what_observations_leave_open(paper_arm):
    simulated = kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01)
    capture = aj.simulate(paper_arm, {}, observations=[simulated], noise=NOISE, seed=3)
    space = aj.Parameters.free_of(paper_arm, held=("d_1", "probe_x", "probe_y", "a_6", "alpha_6"))
    with pytest.warns(aj.IdentifiabilityWarning, match="theta_1 and frame of T trade off"):
        aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, space), noise=NOISE)
    with pytest.raises(aj.InputError, match="theta_1 and frame of T trade off"):
        aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, space), noise=NOISE, undetermined="raise")


def test_images_of_other_poses_determine_something_finite():
    """A fit of the geometry that diverges ends where it began."""
    recording = aj.files.read_manifest(EXAMPLES / "webcam/webcam.toml")
    (images,) = recording.capture.observations
    exchanged = images.changed(q=np.random.default_rng(35).permutation(np.asarray(images.q)))
    found = aj.observability(recording.nominal.arm, aj.Capture({}, observations=[exchanged]))
    assert np.isfinite(found.singular).all()
