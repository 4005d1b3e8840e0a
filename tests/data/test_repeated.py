"""Copies of poses and of reference lengths count once, wherever they are used, and are reported."""

import equinox as eqx
import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.diagnostics.findings import sentences
from aacmm_jax.diagnostics.recorded import of_recording


@pytest.fixture
def copied(noisy_capture):
    """The capture with every pose ten times, and its length three times, once in the other direction."""
    sockets = {name: np.tile(np.asarray(q), (10, 1)) for name, q in noisy_capture.sockets.items()}
    (length,) = noisy_capture.lengths
    backward = aj.ReferenceLength(length.end, length.start, length.value, length.u)
    return aj.Capture(sockets, [length, backward, length])


def numbers_of(result):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(result, eqx.is_array))]


@pytest.mark.slow
def test_copies_change_nothing(paper_arm, noisy_capture, copied):
    assert copied.sizes == noisy_capture.sizes
    assert len(copied.lengths) == 1
    bounds = aj.kinematics.ArmSpecification(paper_arm, "test").bounds()
    for method in ("two-stage", "joint"):
        once = aj.calibrate(paper_arm, noisy_capture, bounds, method=method)
        with pytest.warns(aj.IdentifiabilityWarning, match="Duplicates ignored"):
            again = aj.calibrate(paper_arm, copied, bounds, method=method)
        assert again.degrees_of_freedom == once.degrees_of_freedom
        for one, other in zip(numbers_of(once), numbers_of(again), strict=True):
            np.testing.assert_array_equal(one, other)
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    record = aj.calibration.record_of(once, aj.Recording(noisy_capture, specification))
    evaluated = aj.evaluate_capture(record, aj.Recording(copied, specification))
    assert sum(warning.startswith("Duplicates ignored") for warning in evaluated.warnings) == 2
    pairs = ((aj.evaluate(paper_arm, c), aj.fix_scale(paper_arm, c)) for c in (noisy_capture, copied))
    for one, other in zip(*map(numbers_of, pairs), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_was_left_out_is_reported_and_kept(paper_arm, noisy_capture, copied, tmp_path):
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    recording = aj.Recording(copied, specification)
    aj.files.save_capture(tmp_path / "c.h5", recording)
    poses, length = (9 * size for size in noisy_capture.sizes), "A - B"
    counts = ", ".join(f"{name} ({count})" for name, count in zip(noisy_capture.names, poses, strict=True))
    for found in (recording, aj.files.load_capture(tmp_path / "c.h5")):
        said = sentences(of_recording(found))
        assert f"as another pose of the same socket or observation: {counts}." in said[0]
        assert said[1].startswith("Duplicates ignored: reference lengths given more than once")
        assert f"{length[::-1]}, {length}; delete" in said[1]
    only = copied.select(only="A")
    assert only.repeated == (copied.repeated.poses[:1], ())
    assert not any("Duplicates" in text for text in sentences(of_recording(aj.Recording(noisy_capture, specification))))


def test_only_copies_are_left_out():
    q = np.arange(12.0).reshape(4, 3) / 20
    q[3] = q[1]
    nearly = q.copy()
    nearly[3, 2] = np.nextafter(nearly[3, 2], 1)
    lengths = [
        aj.ReferenceLength("A", "B", 100.0, 0.1),
        aj.ReferenceLength("B", "A", 100.1, 0.1),  # another certificate
        aj.ReferenceLength("A", "B", 100.0, 0.2),
    ]
    capture = aj.Capture({"A": q, "B": nearly, "C": q[:3] + 0.1}, lengths)
    assert capture.sizes == (3, 4, 3)
    assert len(capture.lengths) == 3
    np.testing.assert_array_equal(capture.sockets["A"], q[:3])
    assert capture.repeated == ((("A", 1),), ())
    # One file given twice is recognised without its copies too.
    with pytest.raises(aj.InputError, match="exactly the same poses"):
        aj.Capture({"A": q, "B": q[:3]})
    # Captures of a batch may have left out different copies.
    assert aj.data.stack_captures([aj.Capture({"A": q}), aj.Capture({"A": nearly[:3]})]).q.shape == (2, 3, 3)
    # Traced values cannot be compared.
    assert jax.eval_shape(lambda x: aj.Capture({"A": x}).q, q).shape == (4, 3)


def observed(name="T", **changes):
    random = np.random.default_rng(0)
    values = {"q": random.normal(size=(5, 6)), "points": random.normal(size=(5, 3)), "u": random.uniform(size=(5, 3))}
    return kinds.MeasuredPoints(name, **(values | changes))


def test_copies_within_observations_count_once(paper_arm, tmp_path):
    """A pose that was measured twice is no copy; one whose measured values are repeated too is."""
    one = observed()
    copied = one.select([0, 1, 1, 2, 3, 4, 0])
    again = eqx.tree_at(lambda o: o.points, one.select([0, 0]), np.asarray(one.points)[:2])
    again = eqx.tree_at(lambda o: o.q, again, np.asarray(again.q) + 0.1)
    object.__setattr__(again, "name", "measured again")
    bar = kinds.Artefact("bar", {"a": (0, 0, 0), "b": (9, 0, 0)}, {"a": one.q[:2], "b": one.q[[0, 3, 3]]})
    capture = aj.Capture({"A": one.q[[1, 1, 2]] + 0.2}, observations=[copied, again, bar])
    kept = {observation.name: observation for observation in capture.observations}
    np.testing.assert_array_equal(kept["T"].points, one.points)
    np.testing.assert_array_equal(kept["T"].covariance, one.covariance)
    assert kept["measured again"].q.shape == (2, 6)
    assert kept["bar"].point == ("a", "a", "b", "b")
    assert capture.repeated.poses == (("A", 1), ("T", 2), ("bar", 1))
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(capture, specification))
    loaded = aj.files.load_capture(tmp_path / "c.h5").capture
    assert loaded.repeated == capture.repeated
    assert "A (1), T (2), bar (1)" in loaded.repeated.sentences()[0]
    assert loaded.select(only="T").repeated.poses == (("T", 2),)
    assert jax.eval_shape(lambda q: aj.Capture({}, [], [kinds.Plane("f", q)]).readings, copied.q).shape == (7, 6)


@pytest.mark.parametrize(
    ("sockets", "observations", "message"),
    [
        ({}, [observed(), observed("U")], "observations 'T' and 'U' have exactly the same poses; was one file"),
        ({"A": observed().q}, [kinds.Socket("B", observed().q)], "sockets 'A' and 'B' have exactly the same poses"),
        ({"T": observed().q}, [observed()], "a socket and an observation have the name 'T'"),
    ],
)
def test_what_is_given_twice_is_refused(sockets, observations, message):
    with pytest.raises(aj.InputError, match=message):
        aj.Capture(sockets, [], observations)
    # Two stations see the same poses, and surfaces of two kinds may be touched in them.
    assert len(aj.Capture({}, [], [observed(), observed("U", u=0.1), kinds.Plane("f", observed().q)]).observations) == 3
