"""A socket or a placement whose readings contradict the others is named, and no other."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.diagnostics import contradictions as groups
from aacmm_jax.diagnostics import findings_of
from aacmm_jax.diagnostics.findings import case_of, sentences

PLACEMENTS = {
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
    return aj.simulate(paper_arm, PLACEMENTS, poses=12, lengths=lengths, seed=3, **noise)


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
    capture = aj.simulate(paper_arm, PLACEMENTS, poses=12, lengths=[aj.ReferenceLength("P/0", "P/1", 200.0)], seed=3)
    assert contradictions(calibrated(paper_arm, capture)) == []


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
