"""Arms with prismatic joints calibrated: the truth is recovered, and slides in mm say what they can of the scale."""

import warnings

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.scale_anchor import scale_anchor
from aacmm_jax.data.noise import at_tip, tip_covariances
from aacmm_jax.kinematics.chain import joint_motion

from ..prismatic_arms import ARMS, GANTRY, LINEAR_AXIS, SCARA

NOISE = aj.Noise(encoder_arcsec=2.0, linear_encoder=0.005, seating=0.005)
POINTS = {
    "scara": {"A": (400, 200, 150), "B": (250, -350, 250), "C": (500, -100, 50)},
    "gantry": {"A": (500, 400, 500), "B": (300, 300, 700), "C": (450, 500, 300)},
    "linear axis": {"A": (500, 200, 300), "B": (-300, 600, 900), "C": (400, -300, 600)},
}


def simulated(name: str) -> tuple[aj.Parameters, aj.Arm, aj.Capture]:
    space = aj.Parameters.independent(ARMS[name])
    true = aj.kinematics.perturbed_arm(space, length=0.5, angle=0.002, seed=1)
    lengths = [("A", "B", 0.002), ("B", "C", 0.002)]
    return space, true, aj.simulate(true, POINTS[name], poses=40, lengths=lengths, noise=NOISE, seed=2)


@pytest.fixture(scope="module", params=ARMS)
def problem(request) -> tuple[str, aj.Parameters, aj.Arm, aj.Capture]:
    return request.param, *simulated(request.param)


def errors_in_u(result, space: aj.Parameters, true: aj.Arm) -> np.ndarray:
    """Of the parameters, in standard uncertainties."""
    deviations = np.asarray(result.parameters) - np.asarray(space.vector(true))
    return deviations / np.sqrt(np.diag(np.asarray(result.covariance)))


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("noise", [None, NOISE], ids=["estimated", "given"])
def test_the_truth_is_recovered_within_its_uncertainty(problem, noise):
    """By the default method, which is the joint solve: slides and lengths fix the scale together.

    Without what tests of the residuals add, which by chance they do in some captures without any fault.
    """
    _, space, true, capture = problem
    options = {"replace_noise": False, "shared_errors": False}
    result = aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space), noise=noise, **options)
    assert result.method == "joint"
    assert result.converged
    errors = errors_in_u(result, space, true)
    assert np.abs(errors).max() < 3.5
    assert 0.5 < np.sqrt(np.mean(errors**2)) < 1.5


def test_what_sets_the_scale(problem):
    """The quill of a SCARA keeps its height in a socket and says nothing; slides of the others say all."""
    name, space, _, capture = problem
    anchor = scale_anchor(space, space.base, "longest", None, capture)
    expected = {"scara": ("a_1", ()), "gantry": (None, ("q_1", "q_2", "q_3")), "linear axis": (None, ("q_1",))}
    assert (anchor.hold, anchor.set_by) == expected[name]
    # Judged by poses all over the workspace where those of the capture are not known.
    assert scale_anchor(space, space.base, "longest").hold == anchor.hold


@pytest.mark.slow
def test_a_linear_axis_that_stands_still_says_nothing():
    space, true, _ = simulated("linear axis")
    rows = {kind: np.asarray(getattr(true, kind))[1:] for kind in ("alpha", "a", "d", "theta", "beta")}
    six = aj.Arm(**rows, probe=true.probe, limits=true.limits[1:])  # what the slide carries
    part = aj.simulate(six, {"A": (300, 200, 500), "B": (-400, 300, 300)}, poses=40, noise=NOISE, seed=3)
    capture = aj.Capture({socket: np.insert(q, 0, 200.0, axis=1) for socket, q in part.sockets.items()})
    anchor = scale_anchor(space, space.base, "longest", None, capture)
    assert (anchor.hold, anchor.set_by) == ("a_3", ())
    with pytest.raises(aj.InputError, match="contains no reference length"):
        aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gantry", pytest.param("linear axis", marks=pytest.mark.slow)])
def test_slides_fix_the_scale_without_a_reference_length(name):
    """All lengths come out in the mm of the slides: a reference length of the capture agrees to its uncertainty."""
    space, true, capture = simulated(name)
    bounds = aj.Bounds.around(space.base, space)
    result = aj.calibrate(space.base, aj.Capture(capture.sockets), bounds)
    assert np.abs(errors_in_u(result, space, true)).max() < 3.5
    k = aj.fix_scale(result.arm, capture).scale
    assert abs(float(k.value) - 1) < 1e-4
    stage1 = aj.identify(space.base, capture, bounds)
    assert stage1.scale_set_by
    np.testing.assert_allclose((stage1.parameters - result.parameters) / space.scale, 0, atol=0.2)


@pytest.mark.slow
def test_two_stages_where_slides_set_the_scale_and_where_not():
    """The lengths then change nothing, which is said; of a SCARA they do, and slides are not divided by k."""
    for name, says in (("linear axis", "readings of joint 1 in mm already set the scale"), ("scara", None)):
        space, true, capture = simulated(name)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = aj.calibrate(space.base, capture, aj.Bounds.around(space.base, space), method="two-stage")
        assert [says in str(one.message) for one in caught] == ([True] if says else [])
        assert result.converged
        assert np.abs(errors_in_u(result, space, true)).max() < 3.5


@pytest.mark.slow
def test_a_batch_equals_single_calibrations():
    space, _, capture = simulated("linear axis")
    bounds = aj.Bounds.around(space.base, space)
    starts = np.asarray(space.vector()) + np.array([[0.0], [0.1]]) * np.asarray(space.scale)
    many = aj.identify_many(space.base, capture, bounds, start=starts, noise=NOISE)
    for start, found in zip(starts, many.parameters, strict=True):
        one = aj.identify(space.base, capture, bounds, start=start, noise=NOISE)
        np.testing.assert_allclose(found, one.parameters, rtol=0, atol=1e-6)


@pytest.mark.slow
def test_noise_of_linear_encoders():
    """By hand: a slide errs along its axis by its own encoder, or as much as the others do at 1 m."""
    q = np.array([[300.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    for noise, expected in (
        (aj.Noise(linear_encoder=0.02), 0.02),
        (aj.Noise(encoder_arcsec=1.0), 1e3 * aj.units.ARCSEC),
    ):
        geometry = LINEAR_AXIS.geometry
        covariance = np.asarray(tip_covariances(geometry, joint_motion(geometry, q), noise))[..., 0]
        if noise.linear_encoder is None:
            columns = np.asarray(LINEAR_AXIS.jacobian(q, [f"q_{i}" for i in range(2, 8)]))[0] * aj.units.ARCSEC
            covariance = covariance - columns @ columns.T
        np.testing.assert_allclose(covariance, np.diag([0, 0, expected**2]), atol=2e-12)
    assert at_tip(NOISE, SCARA, 1000.0) == pytest.approx((2e3 * aj.units.ARCSEC, 0.005, 0.005))
    per_joint = aj.Noise(encoder_arcsec=[1, 2, 3, 4], linear_encoder=[0, 0, 0.01, 0])
    each = np.asarray(per_joint.of_readings(SCARA.geometry.kinds))
    np.testing.assert_allclose(each, [aj.units.ARCSEC, 2 * aj.units.ARCSEC, 0.01, 4 * aj.units.ARCSEC])
    with pytest.raises(aj.InputError, match="linear_encoder has 2 values, but the arm has 6 joints"):
        aj.Noise(linear_encoder=[1, 2]).check(GANTRY.joints)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["SCARA", "six axes on a linear axis"])
def test_intervals_hold_the_truth(name):
    """As `benchmarks/prismatic.py` shows for 2,000 trials."""
    from benchmarks.prismatic import coverage

    found = coverage(name, 200, NOISE)
    assert found["converged"] == 1
    assert 93 < found["coverage of parameters"][1] < 97
    assert 93 < found["coverage of lengths"][1] < 97
