"""The mistakes that a laboratory makes are named before any number is printed."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.results import plausible
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.findings import case_of, diagnostics, finding_rows, sentences
from aacmm_jax.diagnostics.recorded import of_recording
from aacmm_jax.kinematics.parameters import ArmSpecification


def test_the_record_of_a_calibration_has_its_capture(noisy_capture, paper_arm):
    recording = aj.Recording(noisy_capture, ArmSpecification(paper_arm))
    record = aj.calibrate_capture(recording, automatic=False, cross_validate=False, shared_errors=False)
    said = aj.warnings_of(record)
    assert said
    assert said == sentences(findings_of(record))
    with pytest.raises(aj.InputError, match="does not contain its capture"):
        aj.warnings_of(aj.calibrate(paper_arm, noisy_capture))


def warnings_of(capture, arm, **options):
    """Warnings of a calibration of the paper's arm on a capture."""
    specification = aj.kinematics.ArmSpecification(arm, "test")
    result = aj.calibrate(arm, capture, specification.bounds(), **options)
    record = aj.calibration.record_of(result, aj.Recording(capture, specification))
    return result, " ".join(sentences(findings_of(record)))


def with_lengths(capture, *lengths):
    return aj.Capture(capture.sockets, [aj.ReferenceLength(*length) for length in lengths])


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (1.0, None),
        (1 / 1000, "Are the reference lengths in m by mistake?"),
        (1 / 10, "Are the reference lengths in cm by mistake?"),
        (1 / 25.4, "Are the reference lengths in inches by mistake?"),
        (1000, "Is the arm in m, or are the reference lengths in um by mistake?"),
        (25.4, "Is the arm in inches by mistake?"),
        (3.0, "Check units, sockets, lengths and arm."),
        (1.02, "the scale of the lengths (A - B) is wrong"),
    ],
)
def test_a_wrong_reference_length(paper_arm, noisy_capture, factor, said):
    true = float(noisy_capture.lengths[0].value)
    result, text = warnings_of(with_lengths(noisy_capture, ("A", "B", factor * true, 0.002)), paper_arm)
    assert plausible(float(result.scale.value)) == (factor in (1.0, 1.02))
    assert ("is not plausible (expected 0.5 to 2)" in text) == (factor not in (1.0, 1.02))
    assert said is None or said in text
    assert "Converged" not in text  # whatever the solver says


@pytest.mark.slow
@pytest.mark.parametrize(
    ("narrow", "held", "noise", "named"),
    [
        ({}, (), None, ()),
        ({"d_5": 0.05}, (), None, ("d_5 (upper bound)",)),  # on it after stage 1
        ({"d_3": 0.5}, (), None, ("d_3 (lower bound)",)),  # beyond it after the division
        ({}, ("a_2",), aj.Noise(encoder_arcsec=60.0), ("a_2 (fixed length)",)),
        ({}, ("a_2",), None, ()),  # it sets the scale, so that nothing is divided
    ],
)
@pytest.mark.filterwarnings("ignore:.* already sets the scale")
def test_what_stands_against_the_division_is_named(tmp_path, narrow, held, noise, named):
    arm = aj.load_arm("cheng2018-simulation")
    true = aj.perturbed_arm(aj.Parameters.free_of(arm), length=1.0, angle=0.0017, seed=1)
    sockets, poses = {"A": (400, 200, 300), "B": (700, 500, 500)}, {"A": 70, "B": 10}
    capture = aj.simulate(true, sockets, poses=poses, lengths=[("A", "B", 0.002)], encoder_arcsec=2.0, seed=1)
    held = (*aj.Parameters.free_of(arm).held, *held)
    nominal = ArmSpecification(arm, "test", held=held, override=narrow)
    result = aj.calibrate(arm, capture, nominal.bounds(), noise=noise, undetermined="ignore")
    aj.files.save_calibration(tmp_path / "c.h5", aj.calibration.record_of(result, aj.Recording(capture, nominal)))
    record = aj.files.load_calibration(tmp_path / "c.h5")
    assert record.against_division == named
    assert record.final_method == ("joint" if named else "two-stage")
    assert record.divided == record.fixed_by_one_length == (not named and not record.scale_set_by)
    said = [text for text in sentences(findings_of(record)) if "division" in text]
    assert [named[0] in text for text in said] == [True] * len(named)


@pytest.mark.slow
def test_one_length_of_three_that_disagrees(paper_arm):
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (400, 500, 300)}
    noise = {"encoder_arcsec": 2.0, "seating": 0.005}
    capture = aj.simulate(paper_arm, sockets, poses={"A": 70, "B": 10, "C": 10}, seed=4, **noise)
    diagonal = float(np.hypot(200, 300))
    right = with_lengths(capture, ("A", "B", 200.0, 0.002), ("A", "C", 300.0, 0.002), ("B", "C", diagonal, 0.002))
    assert "disagree" not in warnings_of(right, paper_arm)[1]
    wrong = with_lengths(capture, ("A", "B", 200.0, 0.002), ("A", "C", 301.0, 0.002), ("B", "C", diagonal, 0.002))
    text = warnings_of(wrong, paper_arm)[1]
    assert "Reference lengths disagree with the arm" in text
    assert "A - C differs by -" in text


@pytest.mark.slow
def test_a_pose_that_was_not_seated(paper_arm, noisy_capture):
    q = np.array(noisy_capture.q)
    q[12, 1] += 1e-3  # some tenths of a millimetre at the tip, tens of times the noise
    cut = noisy_capture.sizes[0]
    capture = aj.Capture({"A": q[:cut], "B": q[cut:]}, noisy_capture.lengths)
    text = warnings_of(capture, paper_arm)[1]
    assert text.startswith("Far from where all other poses put the tip: A pose 13 (")
    assert "as if the reading of joint 2 were wrong by 210 arcsec" in text
    assert "Far from" not in warnings_of(noisy_capture, paper_arm)[1]


@pytest.mark.slow
def test_redundant_and_too_few(paper_arm, noisy_capture):
    sockets = noisy_capture.sockets
    few = aj.Capture({"A": sockets["A"][:8], "B": sockets["B"][:2]}, noisy_capture.lengths)
    assert "There are only 4 more equations than unknowns" in warnings_of(few, paper_arm)[1]
    specification = aj.kinematics.ArmSpecification(
        paper_arm, "test", held=("theta_1", "d_1", "a_6", "probe_x", "probe_y")
    )
    with pytest.warns(aj.IdentifiabilityWarning, match="alpha_6 and d_6 trade off"):
        result = aj.calibrate(paper_arm, noisy_capture, specification.bounds())
    record = aj.calibration.record_of(result, aj.Recording(noisy_capture, specification))
    text = " ".join(sentences(findings_of(record)))
    assert "Not determined by any measurement of this kind: alpha_6 and d_6 trade off." in text


def test_readings_outside_the_limits():
    panda = aj.files.load_specification("panda")
    q = np.tile(np.deg2rad([0.0, 0, 0, -90, 0, 90, 0]), (3, 1)) + 0.01 * np.arange(3)[:, None]
    lengths = [aj.ReferenceLength("A", "B", 50.0)]
    right = aj.Capture({"A": q, "B": q + 0.1}, lengths)
    assert [finding.says for finding in of_recording(aj.Recording(right, panda))] == [
        "These lengths are treated as exact, because their u is 0: A - B."
    ]
    near = q.copy()
    near[0, 3] = panda.arm.limits[3][1] + np.deg2rad(0.009)  # as far beyond a limit as noise may take it
    assert of_recording(aj.Recording(aj.Capture({"A": near}), panda)) == []
    near[0, 3] += np.deg2rad(0.002)
    beyond = aj.Recording(aj.Capture({"A": near}), panda)
    assert of_recording(beyond)[0].says.startswith("Joint 4: 1 of 3")
    assert of_recording(beyond._replace(true=panda)) == []
    swapped = aj.Capture({"A": q[:, [0, 1, 3, 2, 4, 5, 6]], "B": jnp.asarray(q + 0.1)}, lengths)
    (finding, *_) = of_recording(aj.Recording(swapped, panda))
    assert finding.says.startswith("Joint 4: 3 of 6 readings lie outside its limits, -176 to -4 deg")


@pytest.mark.parametrize(
    ("u", "said"),
    [
        (0.02, []),
        (1e-4, []),
        (1.0, []),
        (20e-6, ["u < 0.1 um is implausibly small: {} (u = 0.02 um). u must be in mm; was it given in m?"]),
        (20.0, ["u > 1 mm is implausibly large: {} (u = 20,000 um). u must be in mm; was it given in um?"]),
    ],
)
def test_uncertainties_in_another_unit_are_named(paper_arm, u, said):
    q = np.random.default_rng(0).uniform(-1, 1, (8, 6))
    points = np.asarray(paper_arm.position(q))
    kinds = aj.data.observations
    length = aj.Capture({"A": q[:4], "B": q[4:]}, [aj.ReferenceLength("A", "B", 300.0, u)])
    tracker = aj.Capture({}, observations=[kinds.MeasuredPoints("T", q, points, u=u)])
    sphere = aj.Capture({}, observations=[kinds.Sphere("S", q, diameter=25.0, u=u)])
    wheres = ("[[length]] A - B", "[[points]] T", "[[touched_sphere]] S")
    for where, capture in zip(wheres, (length, tracker, sphere), strict=True):
        recording = aj.Recording(capture, ArmSpecification(paper_arm))
        assert sentences(of_recording(recording)) == [text.format(where) for text in said]
        assert of_recording(recording._replace(true=recording.nominal)) == []


@pytest.mark.slow
def test_every_diagnostic_says_where_it_stands(noisy_capture, paper_arm):
    """A module with a ``test`` is found by itself; its findings have all that a reader needs."""
    modules = diagnostics()
    assert {"causes", "scale", "likely_cause"} & {m.__name__.rpartition(".")[2] for m in modules} == {
        "causes",
        "scale",
    }
    assert len({module.ORDER for module in modules}) == len(modules)
    assert {module.NEEDS for module in modules} <= {"nothing", "scale", "fit"}
    specification = aj.kinematics.ArmSpecification(paper_arm, "test", override={"a_2": 1e-4})
    result = aj.calibrate(paper_arm, noisy_capture, specification.bounds(), undetermined="ignore")
    record = aj.calibration.record_of(result, aj.Recording(noisy_capture, specification))
    findings = findings_of(record)
    assert [finding.code for finding in findings][:1] == ["weak-on-bounds"]
    assert "one-reference-length" in [finding.code for finding in findings]
    bound = findings[0]
    assert (bound.severity, bound.concerns) == ("doubt", ("a_2",))
    assert bound.sentence == f"{bound.says} {bound.costs} {bound.advice}"
    assert aj.warnings_of(result, noisy_capture) == sentences(findings)
    assert finding_rows(findings)[0]["concerns"] == ["a_2"]
    assert case_of(record) is case_of(record)


def test_equations_and_noise_of_a_calibration_are_tested_once(paper_arm, monkeypatch):
    """By the calibration, and again for what is said of it; another record has equations of its own."""
    from aacmm_jax.diagnostics import findings, noisy_encoders

    counts = Counter()

    def counted(module, name):
        function = getattr(module, name)

        def count(*arguments):
            counts[name] += 1
            return function(*arguments)

        monkeypatch.setattr(module, name, count)

    counted(findings, "equations_of")
    counted(noisy_encoders, "_noisiest")
    specification = ArmSpecification(paper_arm, "test")
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (500, 400, 400), "D": (300, 400, 600)}
    lengths, noise = [("A", "B", 0.002), ("C", "D", 0.002)], {"encoder_arcsec": 2.0, "seating": 0.005}
    capture = aj.simulate(paper_arm, sockets, poses=20, lengths=lengths, seed=1, **noise)
    recording = aj.Recording(capture, specification)
    # An estimated noise changes with shared errors, and the equations with it.
    record = aj.calibrate_capture(recording, cross_validate=True, automatic=False, noise=aj.Noise(**noise))
    folds = len(record.validation.groups)
    assert counts["_noisiest"] == 1 + folds
    tests = aj.diagnostics.model_tests(record)
    assert tests.noisy_joint is not None
    assert not tests.terms
    assert counts == {"equations_of": 1 + folds, "_noisiest": 1 + folds}
    # As tested by itself.
    findings._last.clear()
    findings._solved.clear()
    assert aj.diagnostics.model_tests(record) == tests
    assert counts == {"equations_of": 2 + folds, "_noisiest": 2 + folds}
    twice = record._replace(noise=jax.tree.map(lambda value: 2 * value, record.noise))
    cost = case_of(record).left.cost
    assert case_of(twice).left.cost == pytest.approx(cost / 4, rel=1e-6)
