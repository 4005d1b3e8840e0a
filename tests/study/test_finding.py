"""The sentence with which a study begins."""

import pytest

from aacmm_jax.study.finding import finding

BOUND, NOISE, ANCHOR = "bounds.length_mm", "noise.encoder_arcsec", "identification.hold"


def summary(factors, medians, se=1e-4):
    """A study whose cells, all combinations of levels, have these medians of the largest length error, mm."""
    combinations = [{}]
    for name, levels in factors.items():
        combinations = [{**row, name: level} for row in combinations for level in levels]
    rows = [
        {
            "cell": i + 1,
            "factors": row,
            "figures": {"length_error": {"p50": {"value": median, "se": se}, "p95": {"value": 2 * median, "se": se}}},
        }
        for i, (row, median) in enumerate(zip(combinations, medians, strict=True))
    ]
    return {"factors": factors, "results": rows}


@pytest.mark.parametrize(
    ("factors", "medians", "says"),
    [
        (
            {BOUND: [0.3, 0.5, 1.0, 5.0]},
            [0.9, 0.1, 0.1, 0.1],
            "Half-width of lengths 0.3 mm makes length errors 9 times as large; from 0.5 mm on, it makes no "
            "difference.",
        ),
        (
            {NOISE: [1.0, 2.0, 20.0]},
            [0.1, 0.105, 1.5],
            "Encoder noise 20 arcsec makes length errors 15 times as large; up to 2 arcsec, it makes no difference.",
        ),
        (
            {NOISE: [1.0, 2.0, 4.0]},
            [0.1, 0.2, 0.4],
            "Encoder noise 4 arcsec makes length errors 4 times as large as with 1 arcsec.",
        ),
        (
            {ANCHOR: ["longest", "none"]},
            [0.1, 0.3],
            "Scale anchor none makes length errors 3 times as large as with longest.",
        ),
        (
            {BOUND: [1.0, 5.0], NOISE: [1.0, 2.0]},
            [0.1, 0.2, 0.1, 0.2],
            "Encoder noise 2 arcsec makes length errors 2 times as large as with 1 arcsec (means over the other "
            "factors).",
        ),
        (
            {BOUND: [1.0, 5.0]},
            [0.1, 0.105],
            "No level of half-width of lengths changes the length errors by more than 10 %.",
        ),
        ({BOUND: [1.0]}, [0.1], "The length errors have a median of 0.1 mm; 95 % are below 0.2 mm."),
    ],
)
def test_a_study_says_how_far_its_factors_change_the_errors(factors, medians, says):
    assert finding(summary(factors, medians)) == says


def test_a_difference_within_monte_carlo_errors_is_none():
    assert finding(summary({NOISE: [1.0, 2.0]}, [0.1, 0.15], se=0.05)).startswith("No level of encoder noise changes")


def test_no_finding_while_no_trial_has_converged():
    assert finding({"factors": {}, "results": [{"figures": {}}]}) == ""
