"""The one line on a result: what it is good for, and whether its numbers can be trusted."""

import pytest

from aacmm_jax.diagnostics import Finding
from aacmm_jax.diagnostics.held_out import IN_TURN
from aacmm_jax.summaries.tables import decimals_for, lengths_sentence, two_digits
from aacmm_jax.summaries.verdicts import (
    calibration_verdict,
    checked_lengths,
    evaluation_verdict,
)

VOLUME = {"length_mm": 300.0, "expanded_length_reading_median_mm": 0.02, "expanded_length_reading_largest_mm": 0.1}
NEAR = VOLUME | {"expanded_length_reading_median_mm": 0.011, "expanded_length_reading_largest_mm": 0.03}
U = {"volume": VOLUME, "where_poses_were_taken": NEAR}
HELD_OUT_RMS = {"rms_mm": 0.1}


def finding(severity, doubt="", says="Something was found."):
    return Finding("code", says, severity=severity, doubt=doubt)


@pytest.mark.parametrize(
    ("findings", "held_out", "mark", "says"),
    [
        (
            [],
            HELD_OUT_RMS,
            "good",
            "Calibrated: U (95 %) of a measured length of 300 mm is 0.011 mm where poses were taken, 0.020 mm over all "
            "joint limits (at worst 0.10 mm); held-out data agree with this U.",
        ),
        ([], None, "neutral", "no held-out data confirm this U"),
        ([finding("note")], HELD_OUT_RMS, "good", "Calibrated: U (95 %)"),
        ([finding("unusable", says="It stopped.")], HELD_OUT_RMS, "bad", "Not usable. It stopped."),
        (
            [finding("unusable", "data and arm differ"), finding("doubt")],
            None,
            "bad",
            "Not usable: data and arm differ.",
        ),
        (
            [finding("doubt"), finding("doubt")],
            HELD_OUT_RMS,
            "unsure",
            "care: the residuals show errors that the model",
        ),
        (
            [finding("doubt", "on a bound: a_2")],
            HELD_OUT_RMS,
            "unsure",
            "on a bound: a_2, so errors may exceed the stated uncertainty. U",
        ),
    ],
)
def test_of_a_calibration(findings, held_out, mark, says):
    verdict = calibration_verdict(findings, U, held_out, simulated=False)
    assert verdict.mark == mark
    assert verdict.achieved == (mark != "bad")
    assert says in verdict.says


def test_of_a_simulation_and_of_what_is_not_determined():
    assert calibration_verdict([], U, None, simulated=True).says.startswith("Calibrated, in simulation: U (95 %)")
    nowhere_near = calibration_verdict([], U | {"where_poses_were_taken": None}, None, simulated=False)
    assert "of 300 mm is 0.020 mm over all joint limits (at worst 0.10 mm)" in nowhere_near.says
    unknown = U | {"volume": VOLUME | {"expanded_length_reading_largest_mm": None}}
    verdict = calibration_verdict([], unknown, HELD_OUT_RMS, simulated=False)
    assert verdict == (
        "unsure",
        "To be used with care: the data do not determine lengths everywhere in the working volume.",
        True,
    )


def evaluated(*decisions, missing=(), found=None, deciding_mm=None, expanded_mm=0.0, where="", **more):
    row = {"nominal_decision": found, "deciding_mm": deciding_mm, "expanded_mm": expanded_mm, "where": where}
    figures = [{"name": f"E_{i}", "decision": decision} | row for i, decision in enumerate(decisions)]
    test = {"decision": decisions[0] if decisions else None, "missing": list(missing), "figures": figures}
    return {"acceptance": [test], "failed": [], "kept": [], "held_out": None} | more


def held_out(probability, predicted=0.1, found=0.2, ratio=0.7, over=(), count=2, of_lengths=None, errors=(0.5, 0.1)):
    """Poses, and lengths: the ratio of their errors to what is predicted, and the errors over U of each."""
    poses = {"rms_mm": found, "rms_predicted_mm": predicted, "probability": probability}
    lengths = {"lengths": count, "probability": of_lengths, "normalised_error_rms": ratio}
    stages = dict(zip(("nominal", "calibrated"), ({"length_error_mean_absolute_mm": x} for x in errors), strict=True))
    rows = [{"error_over_expanded": value} for value in over]
    return {"predicted": {"poses": poses, "lengths": lengths}, "lengths": rows, **stages}


_WORSE = "Held-out lengths are worse than with the nominal arm: their errors (0.5 mm on average) are 5 times as large"
_OVER = "Errors on held-out data exceed the prediction"
_CHANCE = "Errors on held-out data are larger than predicted, but this may be chance"
_EXPECTED = "Errors on held-out data are about as predicted, or smaller"


@pytest.mark.parametrize(
    ("summary", "mark", "begins", "code"),
    [
        (evaluated("conforms"), "good", "Conforms", 0),
        (evaluated("undecided"), "unsure", "Undecided", 1),
        (evaluated("conforms", undecided=["About 9 poses."]), "unsure", "Undecided: About 9 poses.", 1),
        (
            evaluated("undecided", deciding_mm=0.0123, expanded_mm=0.03, where="bar 1"),
            "unsure",
            "Undecided: the measurement is too uncertain for a decision on E_0: its U at bar 1 would have to be at "
            "most 0.012 mm instead of 0.030 mm",
            1,
        ),
        (evaluated("fails", undecided=["About 9 poses."]), "bad", "Fails", 1),
        (evaluated("fails"), "bad", "Fails", 1),
        (evaluated("fails", calibration_unusable="x"), "bad", "Fails", 1),
        # Whatever the errors are, a calibration that is not usable does not hold.
        (evaluated("conforms", calibration_unusable="it stopped"), "bad", "Not usable, because the calibration is", 1),
        (evaluated(held_out=held_out(0.9), calibration_unusable="it stopped"), "bad", "Not usable, because the", 1),
        (evaluated(), "neutral", "Measured; no limit was given.", 0),
        (evaluated(held_out=held_out(0.9, 0.2)), "neutral", _EXPECTED, 0),
        (evaluated(held_out=held_out(0.001)), "unsure", f"{_OVER} (p = 0.001)", 1),
        (evaluated(held_out=held_out(0.2, 0.1)), "unsure", _CHANCE, 0),
        (evaluated(held_out=held_out(0.2, 0.019)), "unsure", _OVER, 1),  # ten times the prediction: no chance
        # "1.67 mm, predicted 432 mm"
        (evaluated(held_out=held_out(1.0, 432.0, 1.67)), "unsure", "Not confirmed: the prediction is over 10", 1),
        (evaluated(held_out=held_out(0.9, 0.2, ratio=0.05)), "unsure", "Not confirmed", 1),
        (evaluated(held_out=held_out(0.9, 0.2, ratio=0.05, count=1)), "neutral", _EXPECTED, 0),
        # "the lengths are 170 times worse"
        (evaluated(held_out=held_out(0.5, 0.2, ratio=170.0, over=[85.0], count=1)), "unsure", _OVER, 1),
        (evaluated(held_out=held_out(0.5, 0.2, over=[1.2], errors=(0.1, 0.5))), "bad", _WORSE, 1),
        (evaluated(held_out=held_out(0.5, 0.2, over=[0.9], errors=(0.1, 0.5))), "neutral", _EXPECTED, 0),
        # RMS 0.0162 where 0.0170 was predicted, with lengths within their U
        (
            evaluated(held_out=held_out(0.6, 0.0170, 0.0162, 1.5, [0.7, -0.8], of_lengths=0.004)),
            "neutral",
            _EXPECTED,
            0,
        ),
        (evaluated(held_out=held_out(0.6, 0.0170, 0.0162, 1.5, [0.7, -1.1], of_lengths=0.2)), "unsure", _CHANCE, 0),
        (evaluated(held_out=held_out(0.6, 0.0170, 0.0162, 2.5, [1.7, -0.8], of_lengths=0.004)), "unsure", _OVER, 1),
    ],
)
def test_situations(summary, mark, begins, code):
    verdict = evaluation_verdict(summary)
    assert (verdict.mark, int(not verdict.achieved)) == (mark, code), verdict.says
    assert verdict.says.startswith(begins)


@pytest.mark.parametrize(
    ("summary", "own", "mark", "says"),
    [
        (evaluated("conforms"), 0, "good", "Conforms: all limits given are met (E_0)."),
        (evaluated("conforms", None), 0, "good", "met (E_0); no limit was given for E_1."),
        (
            evaluated("conforms", found="conforms"),
            0,
            "good",
            "Conforms (calibrated arm): all limits given are",
        ),
        (evaluated("conforms", found="fails"), 0, "good", "met (E_0); the nominal arm fails (E_0)."),
        (evaluated("conforms"), 1, "unsure", "Conforms"),
        (evaluated("conforms", missing=["more bars"]), 0, "unsure", "the procedure of a test was not complete"),
        (evaluated("conforms", "fails", "undecided"), 0, "bad", "Fails: E_1 is over its limit."),
        (evaluated("conforms", failed=["RMS is 2 mm, over."]), 0, "bad", "Fails: RMS is 2 mm, over."),
        (evaluated("conforms", "undecided"), 0, "unsure", "too uncertain for a decision on E_1"),
        (evaluated(kept=["RMS is 2 mm."]), 0, "good", "Conforms"),
        (
            evaluated(kept=["RMS is 2 mm."]) | {"failed_before": {"nominal": ["RMS distance: 3 mm"], "as_found": []}},
            *(0, "good", "Conforms: all limits given are met; the nominal arm fails (RMS distance: 3 mm)."),
        ),
        (evaluated(), 0, "neutral", "Measured; no limit was given."),
        (
            evaluated(held_out=held_out(0.001)),
            0,
            "unsure",
            "Errors on held-out data exceed the prediction (p = 0.001): held-out poses deviate by 0.2 mm",
        ),
        (evaluated(held_out=held_out(0.5)), 0, "unsure", "larger than predicted, but this may be chance: held-out"),
        (
            evaluated(held_out=held_out(0.5, 0.19)),
            0,
            "neutral",
            "and length errors are 0.7 times as large as predicted. No largest",
        ),
        (evaluated(held_out=held_out(0.5, None)), 0, "neutral", "Measured on held-out data"),
    ],
)
def test_of_an_evaluation(summary, own, mark, says):
    verdict = evaluation_verdict(summary, own)
    assert verdict.mark == mark
    assert says in verdict.says


def test_held_out_data_that_agree_do_not_hide_that_the_cross_validation_does_not():
    groups = [f"When each group {IN_TURN}, some groups disagree with the others by more than predicted: A."]
    summary = evaluated(held_out=held_out(0.9, 0.2))
    alone, beside = evaluation_verdict(summary), evaluation_verdict(summary | {"calibration_warnings": groups})
    assert "held out in turn" not in alone.says
    assert "poses of the calibration itself, held out in turn, have larger errors than predicted" in beside.says


@pytest.mark.parametrize(
    ("u", "says"), [(0.0123, "0.012"), (0.0996, "0.10"), (0.099, "0.099"), (12.3, "12"), (1.0, "1.0")]
)
def test_uncertainties_have_two_digits(u, says):
    assert two_digits(u) == says


def test_what_has_no_uncertainty_has_the_usual_decimals():
    assert [decimals_for(u) for u in (None, 0.0, float("inf"))] == [4, 4, 4]


ROWS = [
    {"value_mm": 200.0, "error_mm": 0.03, "error_u_mm": 0.01},
    {"value_mm": 650.25, "error_mm": -0.04, "error_u_mm": 0.02},
]
HELD_OUT = {"left_out": [{"lengths": 1}, {"lengths": 0}], "length_error_rms_mm": 0.05, "length_u_mm": 0.04}


@pytest.mark.parametrize(
    ("lengths", "held_out", "says"),
    [
        (
            ROWS,
            None,
            "Lengths tested: 2 (200 to 650.2 mm), none held out; RMS error 0.035 mm, predicted 0.016 mm. Lengths over "
            "650.2 mm are untested.",
        ),
        (ROWS, HELD_OUT, "1 of them held out; RMS error 0.050 mm, predicted 0.040 mm."),
        (ROWS, HELD_OUT | {"length_error_rms_mm": None}, "none held out; RMS error 0.035 mm"),
        (
            ROWS[:1],
            None,
            "Lengths tested: none, because the only reference length (200 mm) fixed the scale. Lengths over 200 mm are",
        ),
    ],
)
def test_checked_lengths(lengths, held_out, says):
    found = checked_lengths(lengths, held_out, len(lengths) == 1)
    assert found is not None
    assert says in lengths_sentence(found)


def test_no_lengths_are_tested_without_any():
    assert checked_lengths([], None, False) is None
