"""Of several findings the cause stands first, with the part of the residuals that it explains, and no imitation after
it."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.culprits import culprits_of, is_clear
from aacmm_jax.diagnostics.findings import Case, case_of
from aacmm_jax.kinematics import ArmSpecification

ARCSEC = aj.units.ARCSEC
SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -300, 300), "D": (500, 300, 100)}
LENGTHS = [("A", "B", 0.002), ("C", "D", 0.002), ("A", "C", 0.002)]
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
SHIFT = np.array([0.04, -0.03, 0.02])  # mm


@pytest.fixture(scope="module")
def capture(paper_arm):
    return aj.simulate(paper_arm, SOCKETS, poses=20, lengths=LENGTHS, noise=NOISE, seed=2)


def joint(number, size):
    """An error of one joint, rad."""
    return lambda arm, q: np.outer(size(np.arange(len(q)), q), np.arange(6) == number - 1)


def moved(poses, shift):
    """Readings with which the tip is elsewhere in some poses; ``shift`` is in the base frame, or that of the flange."""

    def errors(arm, q):
        slopes = np.asarray(arm.jacobian(q, [f"q_{i + 1}" for i in range(6)]))
        return poses(len(q))[:, None] * np.einsum("nab,nb->na", np.linalg.pinv(slopes), shift(arm, q))

    return errors


def of_flange(arm, q):
    return np.asarray(arm.pose(q))[:, :3, :3] @ (2 * SHIFT)


def at_base(arm, q):
    return np.broadcast_to(SHIFT, (len(q), 3))


def load(arm, q):
    """Joint 2 bends under a weight at the tip, in proportion to how far it reaches out from the vertical axis 1."""
    reach = np.asarray(arm.position(q * (np.arange(6) != 0)))[:, :1]
    return 3e-7 * reach * from_pose(40)(len(q))[:, None] * (np.arange(6) == 1)


def from_pose(first, last=80):
    return lambda count: ((np.arange(count) >= first) & (np.arange(count) < last)).astype(float)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("errors", "code", "concerns", "words"),
    [
        (joint(3, lambda n, q: np.radians(0.05) * (n == 25)), "outlying-poses", "B pose 6", "joint 3 were wrong by"),
        (joint(3, lambda n, q: np.radians(1.0) * (n == 25)), "outlying-poses", "B pose 6", "joint 3 were wrong by 1 d"),
        (joint(3, lambda n, q: 20 * ARCSEC * (n >= 47)), "missing-terms", "joint 3", "zero of joint 3 from C pose 8"),
        (joint(3, lambda n, q: 1e-4 * q[:, 0]), "missing-terms", "joint 3", "joint 3 with the reading of joint 1"),
        (load, "missing-terms", "joint 2", "load on joint 2 from"),
        (moved(from_pose(30, 40), at_base), "missing-terms", "B", "a displacement of B from B pose 11 on"),
        # C and D, which were recorded afterwards, have places of their own, so that this is the same.
        (moved(from_pose(33), at_base), "missing-terms", "B", "Equally likely: a displacement of the base"),
        (moved(from_pose(33), of_flange), "missing-terms", "tip", "a displacement of the probe on the arm"),
    ],
)
def test_the_cause_stands_first(paper_arm, capture, errors, code, concerns, words):
    q = read = np.asarray(capture.q)
    for _ in range(10):
        read = q - errors(paper_arm, read)
    wrong = aj.Capture(dict(zip(capture.names, np.split(read, 4), strict=True)), capture.lengths)
    nominal = ArmSpecification(paper_arm, "test")
    record = aj.calibrate_capture(aj.Recording(wrong, nominal), automatic=False, cross_validate=False)
    first, *others = findings_of(record)
    assert (first.code, first.concerns) == (code, (concerns,))
    assert words in first.says
    assert first.explains > 0.8
    assert not record.noisy_encoders
    assert [finding.code for finding in others if finding.severity != "note"] == []
    halted, whole = Case(record), Case(record)  # a search that stopped at the first cause, and went on, is the same
    assert is_clear(halted, 1e-4)
    names = [[(c.kind, c.name, c.explains) for c in culprits_of(case)] for case in (halted, whole)]
    assert names[0] == names[1]


@pytest.mark.slow
def test_a_sound_capture_has_no_cause(paper_arm, capture):
    nominal = ArmSpecification(paper_arm, "test")
    record = aj.calibrate_capture(aj.Recording(capture, nominal), automatic=False, cross_validate=False)
    assert culprits_of(case_of(record)) == ()
    assert not is_clear(Case(record), 1e-4)
    assert [finding for finding in findings_of(record) if finding.severity != "note"] == []


@pytest.mark.slow
@pytest.mark.parametrize("method", ["two-stage", "joint"])
def test_a_parameter_that_is_fixed_at_a_wrong_value(paper_arm, capture, method):
    """An angle shows in the poses; a length that is fixed sets the scale of sockets."""
    held = (*aj.Parameters.free_of(paper_arm).held, "alpha_3")
    bent = paper_arm.replace(alpha_3=float(paper_arm.alpha[2]) + np.radians(0.05))
    recording = aj.Recording(capture, ArmSpecification(bent, "test", held=held))
    record = aj.calibrate_capture(recording, automatic=False, cross_validate=False, method=method)
    first, *_ = findings_of(record)
    assert (first.code, first.concerns) == ("wrong-fixed", ("alpha_3",))
    assert "alpha_3 (off by 0.05 deg)" in first.says
    assert "--free alpha_3" in first.advice


@pytest.mark.slow
@pytest.mark.parametrize("stated", [(), ("parameters",)])
def test_it_is_freed_where_nobody_stated_that_it_is_fixed(paper_arm, capture, stated):
    held = (*aj.Parameters.free_of(paper_arm).held, "alpha_3")
    bent = paper_arm.replace(alpha_3=float(paper_arm.alpha[2]) + np.radians(0.05))
    nominal = ArmSpecification(bent, "test", held=held, stated=stated)
    # A stated scale anchor, so that no models are compared.
    record = aj.calibrate_capture(aj.Recording(capture, nominal), cross_validate=False, hold="d_3")
    assert ("alpha_3" in record.names) == (not stated)
    assert [says.startswith("Freed") and "alpha_3 (-0.05" in says for says in record.decisions] == [True] * (not stated)
    assert [finding.code for finding in findings_of(record) if finding.severity == "doubt"] == ["wrong-fixed"] * len(
        stated
    )


@pytest.mark.slow
def test_a_wrong_length_is_fixed(paper_arm, capture):
    held = (*aj.Parameters.free_of(paper_arm).held, "a_2")
    longer = paper_arm.replace(a_2=float(paper_arm.a[1]) + 1.0)
    recording = aj.Recording(capture, ArmSpecification(longer, "test", held=held))
    record = aj.calibrate_capture(recording, automatic=False, cross_validate=False)
    first = next(finding for finding in findings_of(record))
    assert (first.code, first.severity, first.concerns) == ("scale-set-by-fixed-lengths", "doubt", ("a_2",))


@pytest.mark.slow
def test_one_of_two_lengths_is_mistyped(paper_arm):
    """The poses agree, so that no compliance is to be suspected."""
    drawn = aj.simulate(paper_arm, SOCKETS, poses=20, lengths=LENGTHS[:2], noise=NOISE, seed=3)
    length, other = drawn.lengths
    wrong = aj.ReferenceLength(other.start, other.end, float(other.value) + 0.5, 0.002)
    recording = aj.Recording(aj.Capture(drawn.sockets, [length, wrong]), ArmSpecification(paper_arm, "test"))
    record = aj.calibrate_capture(recording, automatic=False, cross_validate=True)
    first, *others = findings_of(record)
    assert (first.code, first.concerns) == ("lengths-disagree", ("A - B", "C - D"))
    assert "most likely wrong: A - B or C - D" in first.sentence
    assert not any("compliant" in finding.sentence for finding in others)


@pytest.mark.slow
def test_lengths_that_all_scatter_accuse_no_single_one(paper_arm):
    """As errors of places make them scatter on a real arm."""
    pairs = [("A", "B"), ("C", "D"), ("A", "C"), ("B", "D"), ("A", "D"), ("B", "C")]
    lengths = [(*pair, 0.002) for pair in pairs]
    sound = aj.simulate(paper_arm, SOCKETS, poses=20, lengths=lengths, noise=NOISE, seed=2)
    errors = np.array([0.02, -0.016, 0.024, -0.022, 0.014, -0.018])
    wrong = [aj.ReferenceLength(r.start, r.end, r.value + e, r.u) for r, e in zip(sound.lengths, errors, strict=True)]
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm))
    result = aj.calibrate(paper_arm, aj.Capture(sound.sockets, wrong), bounds, method="joint", noise=NOISE)
    record = aj.calibration.record_of(
        result, aj.Recording(aj.Capture(sound.sockets, wrong), ArmSpecification(paper_arm, "test"))
    )
    assert not [culprit.name for culprit in culprits_of(case_of(record)) if culprit.kind == "certified"]


def test_a_certified_coordinate_is_mistyped(paper_arm):
    holes = {"1": (0, 0, 0), "2": (300, 0, 0), "3": (300, 300, 0), "4": (0, 300, 50), "5": (150, 100, 80)}
    places = [(0.1, 0.2, 0.3, 300.0, -100.0, 100.0), (-0.2, 0.3, 1.0, 350.0, 100.0, 200.0)]
    plates = [
        aj.data.observations.SimulatedArtefact(f"p{i}", holes, 8, frame=place, u=0.003, artefact="plate")
        for i, place in enumerate(places)
    ]
    capture = aj.simulate(paper_arm, {}, observations=plates, noise=NOISE, seed=1)
    changed = []
    for plate in capture.observations:
        coordinates = np.array(plate.coordinates)
        coordinates[1, 0] += 0.1
        by_hole = {name: np.asarray(plate.q)[np.array(plate.point) == name] for name in holes}
        points = dict(zip(plate.names, coordinates, strict=True))
        changed.append(aj.data.observations.Artefact(plate.name, points, by_hole, u=0.003, artefact="plate"))
    recording = aj.Recording(aj.Capture({}, observations=changed), ArmSpecification(paper_arm, "test"))
    first, *_ = findings_of(aj.calibrate_capture(recording, automatic=False, cross_validate=False))
    assert (first.code, first.concerns) == ("lengths-disagree", ("2",))
