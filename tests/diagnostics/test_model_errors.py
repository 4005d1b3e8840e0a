"""What a model lacks, and noise that is not as stated, is named; where nothing is wrong, nothing is said."""

import sys
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import (
    causes,
    equations,
    model_errors,
    model_tests,
    noisy_encoders,
    scale,
)
from aacmm_jax.diagnostics.findings import case_of, sentences
from aacmm_jax.diagnostics.model_errors import rows_of_tests

MODULES = (causes, model_errors, noisy_encoders, scale)
ARCSEC = aj.units.ARCSEC
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
FIVE_TIMES = aj.Noise(encoder_arcsec=[2.0, 2.0, 10.0, 2.0, 2.0, 2.0], seating=0.005)


def eccentric(q):
    return 10 * ARCSEC * np.cos(q + 0.5) * np.isin(np.arange(6), (1, 2))


def tilted(q):
    return 10 * ARCSEC * np.sin(2 * q) * (np.arange(6) == 1)


def geared(q):
    return 1e-4 * q * (np.arange(6) == 2)


def warming(q):
    return 10 * ARCSEC * np.linspace(-1, 1, len(q))[:, None] * (np.arange(6) == 2)


@pytest.fixture(scope="module")
def captured(paper_arm):
    """Captures with noise, and with what the joints do beyond their readings."""
    exact = {}

    def make(errors=None, noise=NOISE, wrong=0.0):
        if id(noise) not in exact:
            lengths = [("A", "B", 0.002), ("C", "D", 0.002), ("A", "C", 0.002)]
            exact[id(noise)] = aj.simulate(paper_arm, SOCKETS, poses=20, lengths=lengths, noise=noise, seed=2)
        capture = exact[id(noise)]
        q = read = np.asarray(capture.q)
        for _ in range(10 if errors is not None else 0):
            read = q - errors(read)
        one, *others = capture.lengths
        lengths = [aj.ReferenceLength(one.start, one.end, float(one.value) + wrong, 0.002), *others]
        return aj.Capture(dict(zip(capture.names, np.split(read, 4), strict=True)), lengths)

    return make


def calibrated(arm, capture, given, **options):
    space = aj.Parameters.free_of(arm)
    bounds = aj.Bounds.around(arm, space, length=10.0, angle=0.0175)
    options = {"noise": NOISE if given else None, "undetermined": "ignore"} | options
    return aj.calibrate(arm, capture, bounds, **options)


def checked(arm, capture, given, **options):
    """The tests, and the sentences of their findings."""
    result = calibrated(arm, capture, given, replace_noise=False)
    case = case_of(result, capture, **options)
    tests = model_errors.model_tests(result, capture, **options)
    return tests, sentences(finding for module in MODULES for finding in module.test(case))


@pytest.mark.slow
@pytest.mark.parametrize("given", [True, False])
def test_nothing_wrong(paper_arm, captured, given):
    found, said = checked(paper_arm, captured(), given)
    assert not found.warns
    assert said == []
    assert (found.misfit is not None) == given
    assert found.lengths is not None
    assert found.lengths.degrees_of_freedom == 2
    assert rows_of_tests(found)["missing_terms"] == []


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize(
    ("errors", "expected", "amplitude", "cause"),
    [
        (eccentric, {("first harmonic", 2), ("first harmonic", 3)}, 10 * ARCSEC, "an eccentric encoder"),
        (tilted, {("second harmonic", 2)}, 10 * ARCSEC, "a tilted or oval encoder"),
        (geared, {("gear ratio", 3)}, 1e-4, "a wrong gear ratio"),
        (warming, {("drifting zero", 3)}, 10 * ARCSEC, "a zero offset that drifts"),
    ],
)
def test_what_the_model_lacks_is_named(paper_arm, captured, given, errors, expected, amplitude, cause):
    found, said = checked(paper_arm, captured(errors), given)
    named = {(term.kind, term.joint): term for term in found.terms}
    assert expected <= named.keys() | {other for term in found.terms for other in term.alternatives}
    for term in expected & named.keys():
        assert named[term].amplitude == pytest.approx(amplitude, rel=0.5)
    (sentence,) = (text for text in said if text.startswith("Residuals follow"))
    assert cause in sentence


@pytest.mark.slow
def test_gravity_is_named(paper_arm, captured):
    """Joint 2 bends under a weight at the tip, in proportion to how far it reaches out from the vertical axis 1."""

    def errors(q):
        reach = np.asarray(paper_arm.position(q * (np.arange(6) != 0)))[:, :1]
        return 1e-7 * reach * (np.arange(6) == 1)

    found, said = checked(paper_arm, captured(errors), True)
    named = {(term.kind, term.joint) for term in found.terms}
    assert ("gravity", 2) in named | {other for term in found.terms for other in term.alternatives}
    assert any("a joint or link that bends" in text for text in said)


@pytest.mark.slow
@pytest.mark.parametrize("given", [True, False])
def test_a_noisy_encoder_is_named(paper_arm, captured, given):
    found, said = checked(paper_arm, captured(noise=FIVE_TIMES), given)
    assert (found.noisy_joint.joint, found.noisy_joint.probability < 1e-4) == (3, True)
    assert any("reading of joint 3 moves the tip" in text for text in said)
    assert found.lengths.probability > model_errors.LEVEL


@pytest.mark.slow
def test_seats_that_shift_are_noticed(paper_arm, captured):
    """Four visits of five poses to each socket, which is elsewhere by 20 um each time."""
    shifts = np.repeat(np.random.default_rng(1).normal(0, 0.02, (16, 3)), 5, axis=0)

    def errors(q):
        slopes = np.asarray(paper_arm.jacobian(q, [f"q_{i + 1}" for i in range(6)]))
        return np.einsum("nab,nb->na", np.linalg.pinv(slopes), shifts)

    capture = captured(errors)
    alone = aj.Capture(capture.sockets, [aj.ReferenceLength("A", "B", 200.0, 0.05)])
    found, said = checked(paper_arm, alone, False)
    assert found.successive.probability < 1e-4
    assert found.successive.correlation > 0.1
    assert any("successive poses are autocorrelated" in text for text in said)
    assert found.lengths is None  # a single one cannot disagree


@pytest.mark.slow
def test_a_wrong_length_among_three(paper_arm, captured):
    found, _ = checked(paper_arm, captured(wrong=0.1), True)
    assert found.lengths.probability < 1e-6
    assert found.lengths.odd == "A - B"
    assert found.lengths.difference == pytest.approx(-0.1, abs=0.02)
    assert found.misfit.probability > model_errors.LEVEL


@pytest.mark.slow
def test_estimated_noise_against_that_of_the_class(paper_arm, captured):
    usual, _ = checked(paper_arm, captured(), False, class_noise=NOISE)
    assert usual.misfit.usual
    assert usual.misfit.ratio == pytest.approx(1, abs=0.15)
    fine = aj.Noise(encoder_arcsec=0.4, seating=0.001)
    unusual, said = checked(paper_arm, captured(), False, class_noise=fine)
    assert unusual.misfit.ratio == pytest.approx(5 * usual.misfit.ratio, rel=0.02)
    assert unusual.misfit.probability < model_errors.LEVEL < usual.misfit.probability
    assert any("usual for such an arm" in text for text in said)


@pytest.mark.slow
@pytest.mark.parametrize(("stated", "too"), [(0.5, "small"), (2.0, "large")])
def test_noise_that_is_stated_wrongly(paper_arm, captured, stated, too):
    noise = aj.Noise(encoder_arcsec=2.0 * stated, seating=0.005 * stated)
    result = calibrated(paper_arm, captured(), True, noise=noise)
    said = [text for text in aj.warnings_of(result, captured()) if "given noise" in text]
    assert len(said) == 1
    assert f"times too {too}" in said[0]
    with pytest.raises(aj.InputError, match="give the capture"):
        model_tests(result)


@pytest.mark.slow
def test_observations_and_their_division_into_chunks(paper_arm, monkeypatch):
    """A tracker's points: encoder error and a wrong u are named, whether or not the poses are taken in chunks."""
    corners = [[200, -300, 100], [600, 300, 500]]
    station = kinds.SimulatedPoints("tracker", corners, 60, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.005)
    other = kinds.SimulatedPoints("camera", corners, 30, (0.3, 0.1, 0.2, 900.0, 1000.0, -300.0), u=0.1)
    capture = aj.simulate(paper_arm, {}, observations=[station, other], noise=NOISE, seed=3)
    assert not checked(paper_arm, capture, True)[0].warns
    first, second = capture.observations

    def changed(errors, u):
        one, two = (np.asarray(points.q) for points in (first, second))
        points = [
            kinds.MeasuredPoints("tracker", one - errors(one), np.asarray(first.points), u=0.005),
            kinds.MeasuredPoints("camera", two - errors(two), np.asarray(second.points), u=u),
        ]
        return aj.Capture({}, observations=points)

    found, said = checked(paper_arm, changed(eccentric, 0.1), False)
    assert {("first harmonic", 2), ("first harmonic", 3)} <= {(term.kind, term.joint) for term in found.terms}
    wrong = changed(eccentric, 0.02)
    found, said = checked(paper_arm, wrong, True)
    assert [one.name for one in found.noisy_observations][:1] == ["camera"]
    assert any("camera (" in text and "their stated standard uncertainties" in text for text in said)
    monkeypatch.setattr(equations, "_CHUNK", 25)
    divided, _ = checked(paper_arm, wrong, True)
    assert divided.misfit.ratio == pytest.approx(found.misfit.ratio)
    assert [term[:2] for term in divided.terms] == [term[:2] for term in found.terms]
    assert divided.noisy_joint.ratio == pytest.approx(found.noisy_joint.ratio)
    monkeypatch.setattr(equations, "_MOST_POSES", 45)
    assert checked(paper_arm, wrong, True)[0].misfit.degrees_of_freedom < found.misfit.degrees_of_freedom / 1.5


@pytest.mark.slow
def test_without_noise_nothing_is_checked(paper_arm):
    capture = aj.simulate(paper_arm, SOCKETS, poses=10, lengths=[("A", "B"), ("C", "D")], seed=0)
    found, _ = checked(paper_arm, capture, False)
    assert found == model_errors.ModelTests()
    assert not found.warns


@pytest.mark.exhaustive
def test_rates_of_false_alarms_and_of_warnings(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import model_warnings

    trials = model_warnings.Trials(model_warnings.PAPER, 3)
    right = model_warnings.rates(trials, 160)
    assert right["any"] < 0.12
    wrong = model_warnings.rates(trials, 32, errors=model_warnings.eccentric(10.0))
    assert wrong["missing term"] > 0.9
    sys.modules.pop("model_warnings")
