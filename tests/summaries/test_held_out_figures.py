"""Figures of held-out poses that stand in one output: which of them is to be stated."""

from aacmm_jax.core.text import MODEL_CHOSEN
from aacmm_jax.summaries.result_tables import validation_tables
from aacmm_jax.summaries.tables import cross_validated_sentence, decided_of

POOLED = {"of_sockets": False, "rms_mm": 0.06, "rms_predicted_mm": 0.06, "length_error_rms_mm": None}
POOLED |= {"rms_nominal_mm": None}


def test_the_choice_of_a_model_says_what_its_figures_are_of():
    """As found by a reader: 0.111 mm in held-out regions, and 0.060 mm in the cross-validation of the same output."""
    model = f"{MODEL_CHOSEN}: gravity. In held-out regions its errors are 0.111 mm RMS."
    other = "Default bounds were widened."
    summary = {"decisions": [model, other], "cross_validation": {}}
    first, explained, last = decided_of(summary)
    assert (first, last) == (f"Decided by default: {model}", f"Decided by default: {other}")
    assert "is not fitted to it again" in explained
    assert "State the figure of the table Cross-validation" in explained
    assert "State the figure of the line Held out" in list(decided_of(summary | {"held_out_poses": {}}))[1]
    assert list(decided_of(summary | {"cross_validation": None})) == [first, last]


def test_the_table_says_that_geometry_is_fitted_again():
    many, one = (validation_tables(POOLED | {"length_u_mm": None, "groups": count})[0].title for count in (8, 1))
    assert many.startswith("Cross-validation: each of 8 groups held out once, with its geometry (frame, target, ")
    assert one.startswith("The group held out, with its geometry (frame, target, ...) fitted to it again")


def test_the_nominal_arm_stands_beside_where_it_is_known():
    summary = POOLED | {"length_u_mm": None, "groups": 8}
    before, after = (validation_tables(summary | {"rms_nominal_mm": value})[0] for value in (None, 0.503))
    assert list(before.headings)[1:] == ["calibrated arm", "predicted by u"]
    assert list(after.headings)[1:] == ["nominal arm", "calibrated arm", "predicted by u"]
    says = cross_validated_sentence(summary | {"rms_nominal_mm": 0.503})
    assert says.endswith("fitted to them again, 0.503 mm nominal, 0.0600 mm calibrated (predicted 0.0600 mm).")
    assert "nominal" not in cross_validated_sentence(summary)
