"""What is recorded beside the joints' readings: which columns it is, and readings that lack some of it."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.kinematics.arm import reading_as
from aacmm_jax.kinematics.beside import ALL, Beside
from aacmm_jax.kinematics.parameters import ArmSpecification

BOTH = ("directions", "thermometer")


@pytest.mark.parametrize(
    ("recorded", "possible", "columns", "names"),
    [
        ((), (), 6, ()),
        (BOTH, BOTH, 13, BOTH),
        (BOTH, BOTH, 12, ("directions",)),
        (BOTH, BOTH, 6, ()),
        (("directions",), ("torques", "directions"), 12, ("directions",)),  # what is stated comes first
        (("load",), ("load", "thermometer"), 7, ("load",)),
        ((), ALL, 20, ALL),
    ],
)
def test_columns_are_told_by_their_number(recorded, possible, columns, names):
    beside = Beside(6, recorded, possible)
    assert beside.names(columns) == names
    parts = beside.split(np.arange(float(columns))[:, None])
    shown = [parts.joints, *(getattr(parts, name) for name in names)]
    np.testing.assert_array_equal(np.concatenate(shown)[:, 0], np.arange(columns))
    assert all(getattr(parts, name) is None for name in set(ALL) - set(names))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (12, "may be their torques or their directions of approach; use an arm with torques=True or directions=True"),
        (9, "but the arm has 6 joints; give one column per joint, their torques, their directions"),
    ],
)
def test_columns_that_are_not_clear_are_refused(columns, message):
    with pytest.raises(aj.InputError, match=message):
        Beside(6, (), ("torques", "directions")).names(columns)


def test_an_arm_takes_what_another_one_recorded():
    """Without what it does not have; with what changes nothing where its columns would not be clear."""
    readings = np.arange(20.0)[None]
    arm = Beside(6, (), ("torques", "directions", "load", "thermometer"))
    np.testing.assert_array_equal(Beside(6).laid_out(readings, ALL), readings[:, :6])
    np.testing.assert_array_equal(arm.laid_out(readings, ALL), readings)
    for names, there in ((("directions",), range(6, 12)), (("load",), [6]), (("load", "thermometer"), [6, 7])):
        given = readings[:, : 6 + len(there)]
        found = arm.split(arm.laid_out(given, names).T)
        told = [getattr(found, name) for name in names]
        np.testing.assert_array_equal(np.concatenate(told)[:, 0], list(there))
        if found.thermometer is not None and "thermometer" not in names:
            assert found.thermometer == 20.0


def test_a_simulated_capture_has_all_columns_and_comes_back(paper_arm, tmp_path):
    arm = reading_as(paper_arm, ["directions", "load", "thermometer"])
    capture = aj.simulate(arm, {"A": (500, 200, 300)}, poses=20, temperature=[15, 25], load=[0, 2])
    q = np.asarray(capture.q)
    parts = arm.beside.split(q.T)
    assert q.shape == (20, 14)
    assert set(np.unique(parts.directions)) == {-1.0, 1.0}
    assert 0 <= parts.load.min() < parts.load.max() <= 2
    assert 15 <= parts.thermometer.min() < parts.thermometer.max() <= 25
    np.testing.assert_allclose(arm.position(q), np.tile([500, 200, 300], (20, 1)), atol=1e-6)
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(capture, ArmSpecification(arm)))
    loaded = aj.files.load_capture(tmp_path / "c.h5")
    np.testing.assert_array_equal(loaded.capture.q, q)
    assert loaded.nominal.arm.recorded == arm.recorded


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        (7, 0.5, "socket 'A' pose 1 has the direction 0.5 of joint 2; give 1 where the reading was rising"),
        (12, -3, "socket 'A' has a load of -3 kg; give the mass at the tip"),
        (13, 293.0, "socket 'A' has a temperature of 293 C"),
    ],
)
def test_what_cannot_be_is_refused(paper_arm, column, value, message):
    arm = reading_as(paper_arm, ["directions", "load", "thermometer"])
    q = np.asarray(aj.simulate(arm, {"A": (500, 200, 300)}, poses=5).q).copy()
    q[0, column] = value
    with pytest.raises(aj.InputError, match=message):
        aj.evaluate(arm, aj.Capture({"A": q}))
