"""What no residual shows, or too small residuals: a scale that is wrong, and u that are not those of the values."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.arm_size import size_of
from aacmm_jax.kinematics import ArmSpecification

SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
LENGTHS = [("A", "B", 0.002), ("C", "D", 0.002), ("A", "C", 0.002), ("B", "D", 0.002)]
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)


@pytest.fixture(scope="module")
def capture(paper_arm):
    true = aj.perturbed_arm(aj.Parameters.free_of(paper_arm), length=0.5, angle=1e-3, seed=1)
    return aj.simulate(true, SOCKETS, poses=15, lengths=LENGTHS, noise=NOISE, seed=2)


def record_of(arm, capture, factor=1.0, u=1.0, wrong=(), automatic=False):
    """Calibrated with all lengths times ``factor``, with other u, and with an error in mm of some of them."""
    lengths = [
        aj.ReferenceLength(x.start, x.end, value=factor * x.value + dict(wrong).get(i, 0.0), u=u * x.u)
        for i, x in enumerate(capture.lengths)
    ]
    stated = aj.Capture(capture.sockets, lengths)
    recording = aj.Recording(stated, ArmSpecification(arm, "test"))
    return aj.calibrate_capture(recording, automatic=automatic, cross_validate=False)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.99, 1.0, 1.006])
def test_a_wrong_scale_is_seen_in_all_lengths_of_the_arm(paper_arm, capture, factor):
    record = record_of(paper_arm, capture, factor)
    size = size_of(record)
    assert abs(size.factor - (factor - 1)) < 4 * size.u
    assert size.u < 1e-3
    said = [finding for finding in findings_of(record) if finding.code == "scale-far-from-1"]
    assert [f"{100 * abs(size.factor):.2g} %" in finding.says for finding in said] == [True] * (factor != 1)
    assert all(finding.severity == "doubt" for finding in said)


@pytest.mark.slow
def test_reference_lengths_that_agree_far_better_than_stated_have_too_large_a_u(paper_arm, capture):
    codes = [finding.code for finding in findings_of(record_of(paper_arm, capture, u=40.0))]
    assert "u-too-large" in codes
    assert "u-too-large" not in [finding.code for finding in findings_of(record_of(paper_arm, capture))]


@pytest.mark.slow
def test_no_model_is_taken_to_please_a_mistyped_length(paper_arm, capture):
    record = record_of(paper_arm, capture, wrong={2: 0.5}, automatic=True)
    first, *_ = findings_of(record)
    assert (first.code, first.concerns) == ("lengths-disagree", ("A - C",))
    assert not record.decisions


@pytest.mark.slow
def test_bounds_that_explain_most_stand_before_their_imitations(paper_arm, capture):
    off = paper_arm.replace(theta=np.asarray(paper_arm.theta) + 0.004 * (np.arange(6) == 2))
    nominal = ArmSpecification(off, "test", override={"theta_3": 1e-3})
    record = aj.calibrate_capture(aj.Recording(capture, nominal), automatic=False, cross_validate=False)
    first, *_ = findings_of(record)
    assert (first.code, first.concerns[0]) == ("on-bounds", "theta_3")
    assert first.explains > 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("other", "u", "names"), [(0.02, 0.2, ("near", "far")), (0.2, 0.02, ()), (0.02, 0.02, ())])
def test_an_instrument_that_agrees_far_better_than_stated(paper_arm, other, u, names):
    """A second one that is far worse than it should be makes the first one no better."""
    box = [[200, -300, 100], [600, 300, 500]]
    frames = {"near": (0, 0, 1.0, 2000, 0, 0), "far": (0, 0, 0.2, -3000, 1000, 0)}
    kinds = aj.data.observations
    points = [
        kinds.SimulatedPoints(name, box, 40, frame, u=by)
        for (name, frame), by in zip(frames.items(), (0.02, other), strict=True)
    ]
    seen = aj.simulate(paper_arm, {}, observations=points, noise=aj.Noise(encoder_arcsec=2.0), seed=1)
    stated = [kinds.MeasuredPoints(o.name, o.q, o.points, u=u) for o in seen.observations]
    recording = aj.Recording(aj.Capture({}, observations=stated), ArmSpecification(paper_arm, "test"))
    record = aj.calibrate_capture(recording, automatic=False)
    assert [f.concerns for f in findings_of(record) if f.code == "u-too-large"] == [names] * bool(names)
