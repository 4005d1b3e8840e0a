"""Directions that have a rank of their own and are poorly determined all the same: named, fixed by choice, part of
u."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.findings import sentences

ENDS = {"A": (400, 200, 300), "B": (450, 200, 300)}
REDUNDANT = ("theta_1", "d_1", "alpha_7", "a_7", "theta_7", "d_7")  # what ranks alone call redundant


@pytest.fixture(scope="module")
def panda() -> aj.Arm:
    """With its probe 0.6 mm off the last axis, as a ball is that somebody mounted."""
    return aj.load_arm("panda").replace(probe=(0.36, -0.48, 130.0))


@pytest.fixture(scope="module")
def capture(panda) -> aj.Capture:
    return aj.simulate(panda, ENDS, poses=60, lengths=[("A", "B")], encoder_arcsec=1.0, seating=0.1)


def described(trade_offs) -> set[tuple[str, str]]:
    return {trade_off.names[:2] for trade_off in trade_offs}


def test_a_probe_nearly_on_the_last_axis(panda, capture):
    seen = aj.observability(panda, capture, aj.Parameters.free_of(panda, held=REDUNDANT))
    assert seen.rank == len(seen.names)  # ranks alone call everything determined
    assert described(seen.trade_offs) == {("theta_6", "a_6"), ("alpha_6", "d_6")}
    (sentence,) = seen.sentences()
    assert "theta_6 and a_6 trade off: 1 mrad of theta_6 has the same effect as 0.24 mm of a_6" in sentence
    assert "wider bounds do not help" in sentence


def test_imitation_is_what_a_finite_step_shows(panda, capture):
    """One mrad, imitated by the stated amounts, moves the tips of every socket together, to the stated movement."""
    space = aj.Parameters.free_of(panda, held=REDUNDANT)
    quiet = aj.simulate(panda, ENDS, poses=60)
    q = np.asarray(quiet.q)
    for trade_off in aj.observability(panda, capture, space).trade_offs:
        step = np.zeros(len(space.names))
        for name, amount in zip(trade_off.names, (1.0, *(-x for x in trade_off.amounts[1:])), strict=True):
            step[space.names.index(name)] = amount
        moved = np.asarray(space.arm(np.asarray(space.vector()) + step * np.asarray(space.scale)).position(q))
        moved = moved - np.asarray(panda.position(q))
        spread = [moved[quiet.owner == i] - moved[quiet.owner == i].mean(axis=0) for i in range(2)]
        # Partners below a twentieth of the strongest are left out of the name, and with them some of the imitation.
        assert np.sqrt(np.mean(np.sum(np.concatenate(spread) ** 2, axis=1))) < 0.01
        assert trade_off.movement < 0.001


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("off_axis", [0.0, 0.6, 50.0])
def test_size_decides(off_axis):
    """With a probe far off the last axis, joint 6 is determined; on the axis it is not."""
    arm = aj.load_arm("panda").replace(probe_x=off_axis)
    capture = aj.simulate(arm, ENDS, poses=60, lengths=[("A", "B")])
    chosen = set(aj.Parameters.independent(arm, capture).names)
    assert ({"theta_6", "alpha_6"} <= chosen) == (off_axis == 50.0)
    assert ({"theta_6", "alpha_6"} & chosen == set()) == (off_axis < 50.0)


def test_noise_and_bounds_decide(paper_arm, paper_capture):
    """The paper's arm is well conditioned; but bounds narrower than the data resolve make a direction
    near-degenerate."""
    assert aj.observability(paper_arm, paper_capture).trade_offs == ()
    space = aj.Parameters.free_of(paper_arm)
    for width, found in ((10.0, False), (1e-3, True)):
        bounds = aj.Bounds.around(paper_arm, space, length=width, angle=width * 1e-3)
        seen = aj.observability(paper_arm, paper_capture, bounds=bounds, sigma=0.05)
        assert bool(seen.trade_offs) == found


@pytest.mark.slow
def test_shipped_arms_are_what_independent_chooses():
    for name in aj.files.shipped_arms():
        specification = aj.files.load_specification(name)
        assert aj.Parameters.independent(specification.arm).names == specification.space().names, name


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two-stage", pytest.param("joint", marks=pytest.mark.slow)])
def test_a_bound_that_ends_such_a_direction_is_part_of_u(panda, capture, method):
    """The arm is right but for 2 mm of a_6, so theta_6 goes to its bound; a_6 and theta_6 must not pass as exactly
    known."""
    nominal = panda.replace(a_6=90.0)
    space = aj.Parameters.free_of(nominal, held=REDUNDANT)
    override = {"a_6": 5.0, "theta_6": 0.001, "probe_x": 60.0, "probe_y": 60.0, "probe_z": 60.0}
    bounds = aj.Bounds.around(nominal, space, override=override)
    with pytest.warns(aj.IdentifiabilityWarning, match="theta_6 and a_6 trade off"):
        result = aj.calibrate(nominal, capture, bounds, method=method)
    i, j = space.names.index("theta_6"), space.names.index("a_6")
    assert int(result.stage1.active[i]) != 0
    u = np.sqrt(np.diag(result.covariance))
    assert u[i] == pytest.approx(2 * 0.001 / np.sqrt(3))
    assert u[j] > 0.237 * 1e3 * u[i] * 0.95
    correlation = result.covariance[i, j] / (u[i] * u[j])
    assert abs(correlation) > 0.9
    specification = aj.kinematics.ArmSpecification(nominal, "test", held=REDUNDANT)
    record = aj.calibration.record_of(result, aj.Recording(capture, specification))
    text = " ".join(sentences(findings_of(record)))
    assert "On a bound because the data determine these parameters poorly: theta_6" in text
    assert "do not widen the bounds" in text
    assert "widen the bounds unless they are known limits" not in text
