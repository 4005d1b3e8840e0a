"""Stations, placements and sessions that contradict the others: which is named, why, and the calibration without it."""

import equinox as eqx
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics import contradictions as groups
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.contradictions import contradictions_of, remove_contradicting, session_metrics
from aacmm_jax.diagnostics.findings import case_of, sentences

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]
BAR = {"a": (0, 0, 0), "b": (300, 0, 0)}
PLACEMENTS = [(0, 0, 0, 300, 0, 200), (0, 0, 1.5, 300, -200, 250), (0, 1.5, 0, 400, 100, 500)]
PROBE = ("probe_x", "probe_y", "probe_z")
SIMULATED = [
    kinds.SimulatedPoints("T1", BOX, 25, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01),
    kinds.SimulatedPoints("T2", BOX, 25, (0.1, 0.2, -0.5, -1000.0, 2000.0, -300.0), u=0.01),
    *(
        kinds.SimulatedArtefact(f"bar {i}", BAR, 7, frame, u=0.001, artefact="bar")
        for i, frame in enumerate(PLACEMENTS)
    ),
]


@pytest.fixture(scope="module")
def specification(paper_arm):
    return aj.kinematics.ArmSpecification(paper_arm, "test", held=aj.Parameters.independent(paper_arm).held)


@pytest.fixture(scope="module")
def true(paper_arm):
    return aj.perturbed_arm(aj.Parameters.independent(paper_arm), length=1.0, angle=np.deg2rad(0.1), seed=1)


@pytest.fixture(scope="module")
def calibrate(specification):
    def run(capture, **options):
        bounds = specification.bounds()
        result = aj.calibrate(specification.arm, capture, bounds, undetermined="ignore", **options)
        return aj.calibration.record_of(result, aj.Recording(capture, specification))

    return run


@pytest.fixture(scope="module")
def mixed(true):
    return aj.simulate(true, {}, observations=SIMULATED, noise=NOISE, seed=0)


def changed(capture, name, field, change):
    def of(capture):
        return next(getattr(one, field) for one in capture.observations if one.name == name)

    return eqx.tree_at(of, capture, np.asarray(of(capture)) + change)


def named(found):
    return [(one.kind, [suspect.group for suspect in one.suspects]) for one in found]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("T2", "station"), ("bar 1", "placement")])
def test_joint_3_shifted_in_one_station_or_placement(calibrate, mixed, name, kind):
    record = calibrate(changed(mixed, name, "q", 3e-4 * np.eye(6)[2]))
    (found,) = contradictions_of(record)
    assert named([found]) == [(kind, [name])]
    cause = found.suspects[0].cause
    assert cause.names == ("theta_3",)
    assert cause.values[0] == pytest.approx(-3e-4, rel=0.1)
    if kind == "placement":
        return
    rest = remove_contradicting(record, lambda part: solved(record, part))
    assert [removed.members for removed in rest.removed] == [(name,)]
    assert name not in rest.observed.names
    assert rest.removed[0].rms_without < 0.8 * rest.removed[0].rms_with
    assert contradictions_of(rest) == []


def solved(record, capture):
    arm = record.recording.nominal.arm
    return aj.calibrate(arm, capture, record.recording.nominal.bounds(), undetermined="ignore")


@pytest.mark.slow
def test_nothing_is_left_out_of_right_data(calibrate, mixed):
    record = calibrate(mixed)
    assert contradictions_of(record) == []
    assert remove_contradicting(record, lambda part: pytest.fail("there was nothing to leave out")) is record


@pytest.mark.slow
def test_of_two_parts_of_a_bumped_station_either_may_be_wrong(calibrate, mixed):
    first, second = (mixed.observations[0].select(rows) for rows in (range(12), range(12, 25)))
    moved = np.asarray(second.points) + np.array([0.2, 0, 0])
    bumped = kinds.MeasuredPoints("T1 later", second.q, moved, u=0.01, station="T1")
    record = calibrate(aj.Capture({}, [], [first, bumped, *mixed.observations[1:]]))
    (found,) = contradictions_of(record)
    assert {suspect.group for suspect in found.suspects} == {"T1", "T1 later"}
    assert remove_contradicting(record, lambda part: pytest.fail("the data do not show which is wrong")) is record


@pytest.mark.slow
@pytest.mark.parametrize(
    ("offset", "joint", "expected"),
    [((0, 0, 0), 0.0, []), ((0.05, -0.03, 0.04), 0.0, PROBE), ((0, 0, 0), 5e-4, ("theta_3",))],
    ids=["clean", "remounted", "joint 3"],
)
def test_sessions(calibrate, true, offset, joint, expected):
    """Three sessions with one probe, the second with an error of its own."""
    captures = {}
    for number, day in enumerate(("monday", "tuesday", "friday")):
        arm = true.replace(probe=np.asarray(true.probe) + np.array(offset)) if number == 1 else true
        points = {"A": (400 + 20 * number, 200, 300), "B": (500, 300, 100), "C": (300, -300 + 40 * number, 300)}
        lengths = [("A", "B", 0.001)]
        captures[day] = aj.simulate(arm, points, poses=20, lengths=lengths, noise=NOISE, seed=number)
    q = np.asarray(captures["tuesday"].q) + joint * np.eye(6)[2]
    captures["tuesday"] = eqx.tree_at(lambda c: c.q, captures["tuesday"], q)
    record = calibrate(aj.join_sessions(captures, own_probe=False))
    found = contradictions_of(record)
    metrics = session_metrics(record)
    alone = {day: aj.evaluate(calibrate(capture).stage1.arm, capture) for day, capture in captures.items()}
    for day, (poses, _, rms) in metrics.items():
        assert poses == 60
        assert rms == pytest.approx(float(alone[day].repeatability.rms), rel=0.05)
    if not expected:
        assert found == []
        return
    assert named(found)[0] == ("session", ["tuesday"])
    cause = found[0].suspects[0].cause
    assert cause.names == expected
    np.testing.assert_allclose(cause.values, offset if expected == PROBE else [-joint], atol=0.01)


HOLES = {
    f"{place}/{hole}": (350 + 60 * i + 200 * hole, -250 + 120 * i, 150 + 60 * i)
    for i, place in enumerate("PQRS")
    for hole in (0, 1)
}


def contradictions(record):
    return sentences(groups.test(case_of(record)))


def calibrated(arm, capture):
    specification = aj.kinematics.ArmSpecification(arm, "test")
    result = aj.calibrate(arm, capture, specification.bounds(), undetermined="ignore")
    return aj.calibration.record_of(result, aj.Recording(capture, specification))


@pytest.fixture(scope="module")
def several_placements(paper_arm):
    lengths = [aj.ReferenceLength(f"{place}/0", f"{place}/1", 200.0, 0.002) for place in "PQRS"]
    noise = {"encoder_arcsec": 2.0, "seating": 0.005}
    return aj.simulate(paper_arm, HOLES, poses=12, lengths=lengths, seed=3, **noise)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shifted", "radians", "said"),
    [
        ((), 0.02, []),
        pytest.param(("S/1",), 0.02, ["Socket S/1 contradicts the other sockets"], marks=pytest.mark.slow),
        (("S/1",), 0.0005, ["Socket S/1 contradicts the other sockets"]),
        (("Q/0", "Q/1"), 0.002, ["Placement Q contradicts the other placements"]),
        (("Q/0", "R/1"), 0.002, ["Socket R/1 contradicts the other sockets", "Socket Q/0 contradicts"]),
    ],
)
def test_joint_3_shifted_in_some_sockets_only(paper_arm, several_placements, shifted, radians, said):
    shift = radians * np.array([0, 0, 1, 0, 0, 0])
    sockets = {name: q + shift * (name in shifted) for name, q in several_placements.sockets.items()}
    record = calibrated(paper_arm, aj.Capture(sockets, several_placements.lengths))
    found = contradictions(record)
    assert sorted(text.split(":")[0][: len(start)] for text, start in zip(found, said, strict=True)) == sorted(said)
    assert [text for text in sentences(findings_of(record)) if text in found] == found
    if len(said) == 1:
        kept = "'Q/*'" if len(shifted) > 1 else "'S/1'"
        assert f"(--without {kept})" in found[0]
        assert "the others scatter by 0.01" in found[0]


@pytest.mark.slow
def test_of_two_sockets_either_may_be_wrong(paper_arm):
    sockets, noise = {"A": (400, 200, 300), "B": (600, 200, 300)}, {"encoder_arcsec": 2.0, "seating": 0.005}
    lengths = [aj.ReferenceLength("A", "B", 200.0, 0.002)]
    right = aj.simulate(paper_arm, sockets, poses=30, lengths=lengths, seed=3, **noise)
    assert contradictions(calibrated(paper_arm, right)) == []
    wrong = {"A": right.sockets["A"], "B": right.sockets["B"] + [0, 0, 0.002, 0, 0, 0]}
    (said,) = contradictions(calibrated(paper_arm, aj.Capture(wrong, lengths)))
    assert said.startswith("Some sockets contradict each other, and the data do not show which of them is wrong")
    assert "--without 'A'" in said
    assert "--without 'B'" in said


def test_without_noise(paper_arm):
    capture = aj.simulate(paper_arm, HOLES, poses=12, lengths=[aj.ReferenceLength("P/0", "P/1", 200.0)], seed=3)
    assert contradictions(calibrated(paper_arm, capture)) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("removed", "expected"),
    [
        ((), ["Placement high contradicts"]),
        pytest.param(("high/0", "high/1"), [], marks=pytest.mark.slow),
    ],
    ids=["all", "without it"],
)
def test_the_placement_that_its_authors_removed(mukca, removed, expected):
    recording = aj.files.read_manifest(mukca / "capture.toml")
    sockets = dict(recording.capture.sockets)
    for hole in (0, 1):
        sockets[f"high/{hole}"] = np.loadtxt(mukca / "panda_2" / "high" / f"hole_{hole}.csv", delimiter=",")
    capture = aj.Capture({name: q for name, q in sockets.items() if name not in removed}, recording.capture.lengths)
    bounds = recording.nominal.bounds()
    result = aj.calibrate(bounds.space.base, capture, bounds, undetermined="ignore")
    found = contradictions(aj.calibration.record_of(result, recording._replace(capture=capture)))
    assert [text[: len(start)] for text, start in zip(found, expected, strict=True)] == expected
