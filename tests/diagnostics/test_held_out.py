"""What is said of errors on data that a calibration has not seen."""

import math

import numpy as np
import pytest

from aacmm_jax.calibration.agreement import NOTHING, Agreement, CrossValidation, LeftOut
from aacmm_jax.diagnostics.findings import sentences
from aacmm_jax.diagnostics.held_out import contradicted_prediction, no_better, surprise
from aacmm_jax.summaries.calibration import cross_validation_summary


def group(place, rms=0.1, error=0.01, poses=30):
    return LeftOut((f"{place}/0", f"{place}/1"), poses, rms, 0.1, np.array([error]), np.array([0.01]), True)


def said(*groups):
    return " ".join(sentences(contradicted_prediction(CrossValidation(groups))))


def test_the_placement_that_disagrees_is_named():
    """As in panda_2: one of nine placements is almost four times its prediction, pooled 1.5 times."""
    others = [group(f"place_{i}") for i in range(8)]
    assert said(*others, group("last")) == ""
    text = said(*others, group("high", 0.38))
    assert "some groups disagree with the others by more than predicted: high (0.38 mm RMS, 3.8 times" in text
    assert "the remaining 8 agree" in text
    text = said(group("a"), group("b"), group("place_1", error=0.05))
    assert "place_1 (length error 0.05 mm RMS, 5.0 times its u)" in text
    # Where most of them do, the model is at fault and not a placement.
    assert "each placement is held out in turn, the errors are larger than predicted" in said(
        *(group(f"place_{i}", 0.2) for i in range(3))
    )


def test_few_degrees_of_freedom_allow_more():
    """Poses that share the errors of parameters, and a noise that is an estimate from few residuals."""
    ratio = [group("a", 0.16), group("b"), group("c")]
    assert said(*ratio) != ""
    assert said(*(one._replace(rms_degrees_of_freedom=4.0) for one in ratio)) == ""
    assert said(*(one._replace(noise_degrees_of_freedom=5.0) for one in ratio)) == ""


def test_groups_that_scatter_more_than_chance_are_no_contradiction():
    """Placements of one robot whose poses scatter by 0.07 to 0.14 mm where 0.1 is predicted: one of 0.16 mm is usual.

    Without such differences, 0.16 mm contradicts the prediction; and so do differences if all are on one side.
    """
    differing = [group(name, error) for name, error in zip("abcde", (0.07, 0.08, 0.09, 0.13, 0.14), strict=True)]
    assert said(*differing, group("f", 0.16)) == ""
    assert said(*(group(name) for name in "abcde"), group("f", 0.16)) != ""
    assert "larger than predicted" in said(*(one._replace(rms=2 * one.rms) for one in differing))
    between = CrossValidation(tuple(differing)).between()
    assert between.ratio == pytest.approx(1.0)
    found = Agreement(30, 0.16, 0.1, 90.0, 200.0)
    assert found.probability < 0.001 < 0.02 < found.by_groups(between).probability
    assert found.by_groups(None) is found
    # Groups with errors three times as large as predicted: further ones are expected to have such errors.
    between = CrossValidation(tuple(group(name, 0.3) for name in "abc")).between()
    assert between.ratio == pytest.approx(9.0)
    assert Agreement(30, 0.3, 0.1, 90.0, 200.0).by_groups(between).probability > 0.2
    assert CrossValidation((group("a"),)).between() is None


def test_the_worst_comes_first():
    alike = (group(name) for name in "ade")
    rows = cross_validation_summary(CrossValidation((*alike, group("b", 0.3), group("c", 0.2, poses=60))))
    assert [row["group"] for row in rows["left_out"]][:2] == ["b", "c"]
    assert [row["disagrees"] for row in rows["left_out"]] == [True, True, False, False, False]
    assert rows["surprising"]
    unknown = LeftOut(("x", "y"), 30, 0.1, math.inf, np.zeros(0), np.zeros(0), True)
    (row,) = cross_validation_summary(CrossValidation((unknown,)))["left_out"]
    assert (row["group"], row["rms_predicted_mm"], row["length_u_mm"], row["probability"]) == ("x, y", None, None, None)


def agreement(rms, poses=30, freedom=60.0):
    return Agreement(poses, rms, 0.1, freedom, 200.0)


def unknown():
    return None


def test_a_remounted_probe_is_named():
    """Where most of the excess is gone once the place of the probe is fitted, and only there."""
    bad = agreement(0.25, 90, 180.0)
    (text,) = sentences(surprise(bad, NOTHING, {}, lambda: agreement(0.1)))
    assert "fitted to these data, the poses are only 0.1 mm RMS from their geometry: the tip was remounted" in text
    (text,) = sentences(surprise(bad, NOTHING, {}, lambda: agreement(0.2)))
    assert "the tip was remounted" not in text
    assert "a remounted tip" in text


def test_unseen_data_that_scatter_more_than_predicted():
    parts = {"A": agreement(0.11), "B": agreement(0.35), "C": agreement(0.25)}
    (text,) = sentences(surprise(agreement(0.25, 90, 180.0), NOTHING, parts, unknown))
    assert (
        "0.25 mm RMS from their geometry, 2.5 times the predicted 0.1 mm, most of all in B (0.35 mm RMS, 3.5 times"
        in text
    )
    assert "A (" not in text
    assert "reference lengths" not in text
    assert surprise(agreement(0.11), agreement(0.11), parts, unknown) == []
    (text,) = sentences(surprise(agreement(0.1), agreement(0.3, 5, 5.0), parts, unknown))
    assert "the errors of the reference lengths are 3.0 times their" in text
    assert surprise(NOTHING, NOTHING, {}, unknown) == []


@pytest.mark.parametrize(("nominal", "calibrated", "told"), [(0.5, 0.6, True), (0.6, 0.5, False), (None, None, False)])
def test_a_calibration_that_does_not_help(nominal, calibrated, told):
    assert bool(no_better(nominal, calibrated)) == told
