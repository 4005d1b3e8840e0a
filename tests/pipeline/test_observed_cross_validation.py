"""Cross-validation of observations: what is left out together, and errors found against those predicted."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.prediction import unseen_errors
from aacmm_jax.data import observations as kinds
from aacmm_jax.pipeline.cross_validation import _parts_of, groups_of, rms_by

from ..calibration.test_observed import BOX, FRAME, NOISE, PLATE, SIMULATED

STATIONS = [kinds.SimulatedPoints(f"T{i}", BOX, 40, FRAME, u=0.01) for i in range(3)]
CASES = {
    "stations": STATIONS,
    "placements": SIMULATED["bars"]
    + [kinds.SimulatedArtefact(f"plate{i}", PLATE, 4, (0, 0, 0.3, 250, -150, z)) for i, z in enumerate((200, 300))],
    "region": [kinds.SimulatedPoints("T", BOX, 160, FRAME, u=0.01)],
    "kinds": [*SIMULATED["spheres"], *SIMULATED["planes"], *SIMULATED["distances"]],
}


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters.independent(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def true(space):
    return aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow if case != "region" else ()) for case in CASES]
)
def test_honest_data_err_as_predicted(paper_arm, true, bounds, case):
    capture = aj.simulate(true, {}, observations=CASES[case], noise=NOISE, seed=3)
    checked = aj.cross_validate(paper_arm, capture, bounds, noise=NOISE)
    assert len(checked.groups) == (4 if case == "region" else len(CASES[case]))
    assert all(group.converged for group in checked.groups)
    assert checked.rms / checked.rms_predicted == pytest.approx(1.0, abs=0.15)
    for group in checked.groups:
        assert 0.6 < group.rms / group.rms_predicted < 1.6
    assert not checked.surprising


@pytest.mark.slow
def test_sockets_and_lengths_with_observations(paper_arm, true, bounds):
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300)}
    capture = aj.simulate(
        true, points, poses=25, lengths=[("A", "B", 0.001)], observations=STATIONS[:1], noise=NOISE, seed=5
    )
    assert groups_of(capture) == (("A", "B"), ("C",), ("T0",))
    checked = aj.cross_validate(paper_arm, capture, bounds, noise=NOISE)
    assert [group.poses for group in checked.groups] == [50, 25, 40]
    assert checked.rms / checked.rms_predicted == pytest.approx(1.0, abs=0.2)
    assert abs(float(checked.groups[0].length_error[0])) < 3 * checked.groups[0].length_u[0]


@pytest.mark.slow
def test_the_group_that_disagrees_is_seen(paper_arm, true, bounds):
    """A station in whose poses the arm gave way: found errors of that group are far above the predicted ones."""
    bent = true.replace(a=np.asarray(true.a) + np.array([0, 0.3, 0, 0, 0, 0]))
    parts = [
        aj.simulate(arm, {}, observations=[one], noise=NOISE, seed=i).observations[0]
        for i, (arm, one) in enumerate(zip((true, true, bent), STATIONS, strict=True))
    ]
    checked = aj.cross_validate(paper_arm, aj.Capture({}, [], parts), bounds, noise=NOISE)
    ratios = [group.rms / group.rms_predicted for group in checked.groups]
    assert np.argmax(ratios) == 2
    assert checked.surprising


@pytest.mark.slow
def test_shared_geometry_is_left_out_together(paper_arm):
    capture = aj.simulate(paper_arm, {}, observations=[*STATIONS[:2], *SIMULATED["bars"]], noise=NOISE)
    assert groups_of(capture) == (("T0",), ("T1",), ("bar0",), ("bar1",), ("bar2",))
    points = [kinds.MeasuredPoints(o.name, o.q, o.points, u=0.01, station="S") for o in capture.observations[:2]]
    capture = aj.Capture({}, [], [*points, *capture.observations[2:]])
    assert groups_of(capture) == (("T0", "T1"), ("bar0",), ("bar1",), ("bar2",))
    few = aj.simulate(paper_arm, {}, observations=[kinds.SimulatedPoints("T", BOX, 20, FRAME, u=0.01)], noise=NOISE)
    with pytest.raises(aj.InputError, match="4 regions of joint space, which needs at least 40 poses"):
        aj.cross_validate(paper_arm, few, aj.Bounds.around(paper_arm, aj.Parameters.independent(paper_arm)))


def test_a_recording_that_the_user_has_divided_is_held_out_as_divided():
    """Octants of one station and target; two parts only, or one, are halved in joint space instead."""
    q, points = np.random.default_rng(0).uniform(-1, 1, (120, 6)), np.zeros((120, 3))

    def held_out(parts):
        rows = np.array_split(np.arange(120), parts)
        grid = [kinds.MeasuredPoints(f"grid/{i}", q[r], points[r], u=0.1, station="S") for i, r in enumerate(rows)]
        return [(names, len(left.readings)) for _, left, names in _parts_of(aj.Capture({}, [], grid))]

    assert held_out(8) == [((f"grid/{i}",), 15) for i in range(8)]
    assert held_out(2) == [((f"region {i}",), 30) for i in range(1, 5)]
    assert held_out(1) == [((f"grid/0, region {i}",), 30) for i in range(1, 5)]
    assert held_out(13) == []


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("kind", SIMULATED)
def test_some_poses_of_an_observation(paper_arm, kind):
    """Residuals of the poses that remain are what they were."""
    capture = aj.simulate(paper_arm, {}, observations=SIMULATED[kind], noise=NOISE, seed=3)
    whole = aj.evaluate(paper_arm, capture, noise=NOISE).observed
    poses = np.flatnonzero(np.random.default_rng(0).uniform(size=len(capture.observations[0].q)) < 0.7)
    rest = aj.Capture({}, [], [capture.observations[0].select(poses), *capture.observations[1:]])
    part = aj.evaluate(paper_arm, rest, noise=NOISE, geometry=whole.geometry).observed
    np.testing.assert_allclose(part.residuals[0], np.asarray(whole.residuals[0])[:, poses], atol=1e-9)
    np.testing.assert_allclose(part.normalised[0], np.asarray(whole.normalised[0])[:, poses], rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_errors_of_the_nominal_arm_are_those_that_the_calibrated_one_has_by_the_same_rule(paper_arm, true, bounds):
    points = {"A": (400, 200, 300), "B": (500, 300, 100)}
    used = aj.simulate(true, points, poses=25, lengths=[("A", "B", 0.001)], noise=NOISE, seed=5)
    left = aj.simulate(true, points, poses=6, observations=SIMULATED["bars"], noise=NOISE, seed=6)
    left = aj.Capture({**left.sockets, "single": left.readings[:1]}, [], left.observations)
    uncertainty = aj.uncertainty_of(aj.calibrate(paper_arm, used, bounds, noise=NOISE, shared_errors=False))
    errors = unseen_errors(uncertainty, left)
    by_calibrated, by_nominal = (rms_by(arm, left, NOISE) for arm in (uncertainty.arm, paper_arm))
    assert by_calibrated == pytest.approx(errors.of(errors.parts).rms, rel=1e-6)
    assert by_nominal > 10 * by_calibrated
