"""Acceptance tests: metrics by hand and of arms with known errors; decisions at, within and beyond a limit."""

import csv
import itertools
import json
import math
from inspect import unwrap  # calls a function without the run-time type checker of the tests

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import aacmm_jax as aj
from aacmm_jax import acceptance
from aacmm_jax.acceptance import Limit, Measured, enclosing_sphere, fit_sphere, measured_by, run
from aacmm_jax.acceptance.judgement import read_limits
from aacmm_jax.acceptance.procedure import plan_procedure, simulate_procedure
from aacmm_jax.acceptance.record import checked_limits
from aacmm_jax.acceptance.standards import EDITIONS, STANDARDS
from aacmm_jax.files.plans import plan_csv, plan_manifest
from aacmm_jax.kinematics.workspace import Reach
from tests.refusals import assert_refused

AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
ABOVE, MARGIN = 50.0, math.radians(10)
PLACE = np.array([400.0, 200.0, 300.0])


@pytest.fixture(scope="module")
def cheng():
    return aj.files.load_specification("cheng2018-simulation")


@pytest.fixture(scope="module", params=["iso", pytest.param("asme", marks=pytest.mark.slow)])
def procedure(request, cheng):
    """A planned test of the nominal arm."""
    return plan_procedure(cheng.arm, request.param, above=ABOVE, margin=MARGIN)


@pytest.fixture(scope="module")
def recorded(procedure, cheng):
    """A noise-free acceptance test of the nominal arm."""
    return simulate_procedure(procedure, cheng, cheng)


def titled(tests, title):
    """The test of that title."""
    (found,) = [test for test in tests if test.title == title]
    return found


def values_of(tests):
    """All values by the name of their metric."""
    return {metric.name: metric.values for test in tests for metric in test.metrics}


# --- By hand ---


def test_single_point_metrics_by_hand():
    # x spans 0.04, y 0.06, z nothing.
    assert acceptance.half_range([[0, 0, 5], [0.04, 0, 5], [0.01, -0.06, 5]]) == pytest.approx(0.03)
    # The corners of a square of side 0.02 lie 0.01 sqrt(2) from its middle: s^2 = 4 x 2e-4 / 3.
    corners = PLACE + 0.01 * np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    assert acceptance.spat(corners) == pytest.approx((0.01 * math.sqrt(2), 2 * math.sqrt(8e-4 / 3)))
    assert acceptance.two_rms([0.03, -0.04]) == pytest.approx(2 * math.sqrt(12.5e-4))


def test_sphere_metrics_by_hand():
    # Opposite points moved out or in by the same amount leave the centre as it is: 15.5 + (0.02 - 0.01 + 0.02) / 3.
    radii = 15.5 + np.repeat([0.02, -0.01, 0.02], 2)
    points = PLACE + radii[:, None] * AXES
    fitted = fit_sphere(points)
    np.testing.assert_allclose(fitted.centre, PLACE, atol=1e-9)
    assert fitted.radius == pytest.approx(15.51, abs=1e-9)
    # A sphere of 25 mm and a probe of 6 mm make 31; the least-squares diameter is 31.02.
    assert acceptance.size_error(points, 25.0, stylus=6.0) == pytest.approx(0.02, abs=1e-9)
    assert acceptance.form_error(points) == pytest.approx(0.03, abs=1e-9)


@pytest.mark.parametrize(
    ("points", "diameter"),
    [
        ([[1, 2, 3]], 0.0),
        ([[0, 0, 0], [0, 0, 2]], 2.0),
        ([[0, 0, 0], [3, 0, 0], [0, 4, 0]], 5.0),  # a right angle: the hypotenuse
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], 2 * math.sqrt(2 / 3)),  # equilateral, side sqrt(2): 2 s / sqrt(3)
        (
            [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1], [0.5, 0.2, 0]],
            2 * math.sqrt(3),
        ),  # regular tetrahedron, one inside
        ([[0, 0, 0], [0, 0, 0], [0, 0, 1e-6]], 1e-6),
    ],
)
def test_smallest_sphere_by_hand(points, diameter):
    assert 2 * enclosing_sphere(PLACE + np.array(points, dtype=float))[1] == pytest.approx(
        diameter, rel=1e-6, abs=1e-12
    )


@pytest.mark.slow
@given(st.lists(st.tuples(*[st.integers(-20, 20)] * 3), min_size=2, max_size=8))
def test_smallest_sphere_holds_all_and_none_smaller_does(points):
    points = np.array(points, dtype=float)
    _, radius = enclosing_sphere(points)
    # The smallest sphere of a set is that of two, three or four of its points: the largest over all such choices.
    largest = 0.0
    for size in (2, 3, 4):
        for chosen in itertools.combinations(points, size):
            subset = np.array(chosen)
            centre = (
                subset[0]
                + np.linalg.lstsq(
                    2 * (subset[1:] - subset[0]), np.sum((subset[1:] - subset[0]) ** 2, axis=1), rcond=None
                )[0]
            )
            around = np.linalg.norm(subset - centre, axis=1)
            weights = np.linalg.lstsq(np.vstack([subset.T, np.ones(size)]), np.append(centre, 1), rcond=None)[0]
            if np.ptp(around) < 1e-9 and np.all(weights > -1e-9):  # its own smallest sphere
                largest = max(largest, float(around[0]))
    assert radius == pytest.approx(largest, abs=1e-6)


def test_articulated_location_by_hand():
    # Five centres: a right triangle of hypotenuse 0.05 and two points inside its circle.
    centres = PLACE + 0.01 * np.array([[0, 0, 0], [3, 0, 0], [0, 4, 0], [1, 1, 0], [2, 1, 0]])
    groups = [centre + 15.5 * AXES for centre in centres]
    assert acceptance.articulated_location(groups) == pytest.approx(0.05, abs=1e-8)


@pytest.mark.parametrize(
    "points", [np.zeros((4, 3)), np.eye(3), np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]])]
)
def test_points_that_fix_no_sphere_are_refused(points):
    assert_refused(lambda: fit_sphere(points), "sphere", "touch the sphere")


# --- Decisions ---


@pytest.mark.parametrize(
    ("error", "limit", "expanded", "expected"),
    [
        (0.040, 0.05, 0.01, "conforms"),  # exactly limit - U
        (0.0399999, 0.05, 0.01, "conforms"),
        (0.0400001, 0.05, 0.01, "undecided"),
        (0.050, 0.05, 0.01, "undecided"),
        (0.0599999, 0.05, 0.01, "undecided"),
        (0.060, 0.05, 0.01, "fails"),  # exactly limit + U
        (0.0600001, 0.05, 0.01, "fails"),
        (-0.040, 0.05, 0.01, "conforms"),
        (-0.060, 0.05, 0.01, "fails"),
        (0.05, 0.05, 0.0, "conforms"),
        (0.0500001, 0.05, 0.0, "fails"),
        (0.0, 0.01, 0.02, "undecided"),  # nothing can conform where U is larger than the limit
        (0.019, 0.03, 0.011, "conforms"),  # 0.03 - 0.011 is a little below 0.019 in binary
        (0.0, 0.0, 0.0, "conforms"),
    ],
)
def test_decisions_with_the_guard_band_of_2013(error, limit, expanded, expected):
    assert acceptance.decide(error, limit, expanded, "iso-2013") == expected


@pytest.mark.parametrize(
    ("error", "limit", "expanded", "rule", "expected"),
    [
        # U = 0.01, u = 0.005: the guard band is 1.65 u = 0.00825.
        (0.04175, 0.05, 0.01, "iso-2017", "conforms"),
        (0.04176, 0.05, 0.01, "iso-2017", "undecided"),
        (-0.05824, 0.05, 0.01, "iso-2017", "undecided"),
        (-0.05825, 0.05, 0.01, "iso-2017", "fails"),
        # Within +-u / 2 of a limit of 1.95 u and 1.97 u: P = 0.949 and 0.951, though the guard band leaves 0.3 u.
        (0.0, 1.95, 2.0, "iso-2017", "undecided"),
        (0.0, 1.97, 2.0, "iso-2017", "conforms"),
        (0.05, 0.05, 0.0, "iso-2017", "conforms"),
        (0.0500001, 0.05, 0.0, "iso-2017", "fails"),
        # Simple acceptance: as soon as the limit is 4 U.
        (0.05, 0.05, 0.0125, "simple", "conforms"),
        (-0.0501, 0.05, 0.0125, "simple", "fails"),
        (0.01, 0.05, 0.0126, "simple", "undecided"),
        (0.08, 0.05, 0.0126, "simple", "undecided"),
    ],
)
def test_decisions_by_rule(error, limit, expanded, rule, expected):
    assert acceptance.decide(error, limit, expanded, rule) == expected


@given(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 0.5), st.sampled_from(sorted(acceptance.RULES)))
def test_a_larger_uncertainty_never_decides_otherwise(error, limit, expanded, more, rule):
    before, after = (acceptance.decide(error, limit, u, rule) for u in (expanded, expanded + more))
    assert after in (before, "undecided")


@given(st.floats(-1, 1), st.floats(0.01, 1), st.floats(0.001, 1))
def test_what_is_proven_is_proven_with_95_percent(error, limit, expanded):
    decision = acceptance.decide(error, limit, expanded)
    inside = np.diff(stats.norm.cdf([-limit, limit], error, expanded / 2))[0]
    assert decision != "conforms" or inside >= 0.95 - 1e-6
    assert decision != "fails" or inside <= 0.05 + 1e-6


@pytest.mark.parametrize(
    ("text", "at_zero", "at_metre"),
    [
        ("E_Uni=0.02", 0.02, 0.02),
        ("e_uni=0.02+L/40000", 0.02, 0.045),
        ("E_Uni = 0.02 + l / 4e4", 0.02, 0.045),
        ("E_Uni=0+L/5", 0, 200),
    ],
)
def test_limits_are_read(text, at_zero, at_metre):
    limit = read_limits([text], acceptance.METRICS)["E_Uni"]
    assert (limit.at(), limit.at(1000.0)) == pytest.approx((at_zero, at_metre))


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["E_Uni"], "NAME=A+L/K"),
        (["E_Uny=1"], "did you mean 'E_Uni'"),
        (["E_Uni=a"], "numbers"),
        (["E_Uni=-1"], "not negative"),
        (["E_Uni=1+L/0"], "K must be at least"),
        (["E_Uni=1+L/1e-320"], "K must be at least"),
        (["E_Uni=1e308"], "finite"),
        (["E_Uni=nan"], "not negative"),
        (["E_Uni=1", "e_uni=2"], "two limits"),
    ],
)
def test_limits_that_cannot_be_are_refused(texts, said):
    assert_refused(lambda: read_limits(texts, acceptance.METRICS), "--mpe", said)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: acceptance.decide("a", 1, 0), "error is 'a'; give a number"),
        (lambda: acceptance.decide(np.array([1.0, 2.0]), 1, 0), "give a number"),
        (lambda: acceptance.decide(math.nan, 1, 0), "error is nan; give a number"),
        (lambda: acceptance.decide(0.0, 1.0, 0.0, "din"), "choose one of iso-2017, iso-2013, simple"),
        (lambda: run(Measured({"A": np.eye(3)}, measuring_range=-1.0)), "measuring_range"),
        (lambda: run(Measured({"A": [[1, 2]]})), "'A'"),
        (lambda: run(Measured({"A": np.full((2, 3), 1e200)})), "beyond"),
        (lambda: run(Measured({"A": np.eye(3)}, (aj.ReferenceLength("A", "B", 1.0),))), "unknown socket 'B'"),
        (lambda: unwrap(checked_limits)({"Deltam": "x"}), "limit of Deltam"),
        (lambda: unwrap(checked_limits)({"E_Bi": 0.05}), "opposite directions cannot be recorded"),
        (lambda: run(Measured({"A": np.eye(3)}), {"Delta": 1.0}), "did you mean 'Deltam'"),
        (lambda: run(Measured({"A": np.eye(3)}), {"Deltam": Limit(1, -1000)}), "K must be at least"),
        (lambda: run(Measured({"A": np.eye(3)}), u_test=-1), "u_test is -1 mm; it must be zero or positive"),
        (
            lambda: run(Measured({}, spheres=(aj.data.ProbedSphere("S", "probing", (PLACE + AXES,), math.nan),))),
            "sphere 'S'",
        ),
        (
            lambda: run(Measured({}, spheres=(aj.data.ProbedSphere("S", "probe", (PLACE + AXES,), 25.0),))),
            "test of sphere 'S' is 'probe'; did you mean 'probing'?",
        ),
        (
            lambda: run(Measured({}, spheres=(aj.data.ProbedSphere("S", "probing", (AXES, AXES[:3]), 25.0),))),
            "sphere 'S', group 2",
        ),
    ],
)
def test_what_cannot_be_tested_is_refused(call, said):
    assert_refused(call, said)


def test_a_plain_number_is_a_limit():
    (test,) = run(Measured({"A": np.array([[0, 0, 0], [0.1, 0, 0]])}), {"Deltam": 0.04})
    assert test.decision == "fails"


def test_every_value_has_its_own_limit_and_the_worst_decides():
    sockets = {name: np.array([[x, 0.0, 0.0]]) for name, x in (("A", 0), ("B", 100.03), ("C", 1000.03))}
    lengths = (aj.ReferenceLength("A", "B", 100.0, 0.002), aj.ReferenceLength("A", "C", 1000.0, 0.002))
    found = titled(run(Measured(sockets, lengths), {"E_Uni": Limit(0.02, 40_000)}), "length error")
    (metric,) = found.metrics
    # Both are off by 0.03, U is 0.004; the limits are 0.0225 and 0.045.
    assert [value.limit for value in metric.values] == pytest.approx([0.0225, 0.045])
    assert [value.expanded for value in metric.values] == pytest.approx([0.004, 0.004])
    assert [value.decision for value in metric.values] == ["fails", "conforms"]
    assert found.decision == metric.decision == "fails"
    assert metric.worst.where == "A - B"


def lengths_of(*entries):
    """Points on a line, and lengths from the first: (error, u, calibrated value) each."""
    sockets = {"O": np.zeros((1, 3))} | {
        f"P{i}": np.array([[value + error, 0, 0]]) for i, (error, _, value) in enumerate(entries)
    }
    lengths = tuple(aj.ReferenceLength("O", f"P{i}", value, u) for i, (_, u, value) in enumerate(entries))
    return Measured(sockets, lengths)


@pytest.mark.parametrize(
    ("entries", "limit", "where", "decision"),
    [
        # Without a limit the largest, whatever its uncertainty.
        ([(0.030, 0.002, 100.0), (-0.029, 0.02, 200.0)], None, "O - P0", None),
        ([(0.029, 0.002, 100.0), (-0.030, 0.02, 200.0)], None, "O - P1", None),
        # What fails comes before what is undecided, even where that is nearer to failing by its U.
        ([(0.050, 0.0005, 100.0), (0.040, 0.01, 200.0)], Limit(0.04), "O - P0", "fails"),
        # With limits that grow, the value farthest beyond its own.
        ([(0.050, 0.0, 100.0), (0.055, 0.0, 1000.0)], Limit(0.01, 40_000), "O - P0", "fails"),
        ([(0.010, 0.0, 100.0), (0.030, 0.0, 1000.0)], Limit(0.05), "O - P1", "conforms"),
    ],
)
def test_the_worst_value_is_that_of_the_metric(entries, limit, where, decision):
    (metric,) = titled(run(lengths_of(*entries), {"E_Uni": limit} if limit else None), "length error").metrics
    assert (metric.worst.where, metric.decision) == (where, decision)
    assert metric.value == pytest.approx(next(error for i, (error, *_) in enumerate(entries) if where == f"O - P{i}"))


def test_names_of_sockets_change_no_limit():
    """Limits depend on the length, not on the names of its sockets."""
    limit = {"E_Uni": Limit(0.01, 10_000)}
    for names in (("A", "B"), ("A, reading 1", "B"), ("A - B", "C"), ("A", "B - C, reading 2")):
        sockets = dict(zip(names, (np.zeros((2, 3)), np.tile([500.04, 0, 0], (2, 1))), strict=True))
        measured = Measured(sockets, (aj.ReferenceLength(*names, 500.0), aj.ReferenceLength(*names, 500.01)))
        assert [value.limit for value in values_of(run(measured, limit))["E_Uni"]] == pytest.approx(
            [0.06, 0.06, 0.060001, 0.060001]
        )


@pytest.mark.parametrize("name", ["Length_Range", "Volumetric_2RMS", "Deltam"])
def test_a_limit_that_grows_needs_a_length(name):
    measured = lengths_of((0.01, 0.0, 100.0), (0.02, 0.0, 200.0))
    measured = measured._replace(sockets={**measured.sockets, "S": PLACE + np.eye(3)})
    assert_refused(lambda: run(measured, {name: Limit(1.0, 1000)}), name, "grows with a length")


def test_uncertainties_of_metrics_by_hand():
    sockets = {name: np.array([[x, 0.0, 0.0]]) for name, x in (("A", 0), ("B", 100.03), ("C", 199.99))}
    lengths = (aj.ReferenceLength("A", "B", 100.0, 0.003), aj.ReferenceLength("A", "C", 200.0, 0.004))
    test = run(Measured(sockets, lengths), u_test=0.012)[0]
    values = {metric.name: (metric.value, metric.worst.expanded) for metric in test.metrics}
    assert values["Length"] == pytest.approx((0.03, 2 * math.hypot(0.003, 0.012)))
    assert values["Length_Range"] == pytest.approx((0.04, 2 * math.sqrt(0.003**2 + 0.004**2 + 2 * 0.012**2)))
    rms_u = math.sqrt((0.003**2 + 0.004**2) / 2)
    assert values["Length_2RMS"] == pytest.approx((2 * math.sqrt(5e-4), 2 * 2 * math.hypot(rms_u, 0.012)))


# --- An arm of known error ---


@pytest.mark.slow
def test_a_perfect_arm_has_no_error_and_the_full_procedure(recorded):
    tests = run(measured_by(recorded.nominal.arm, recorded))
    assert all(abs(found.value) < 1e-6 for values in values_of(tests).values() for found in values)
    standard = "ISO 10360-12" if len(recorded.spheres) == 4 else "ASME B89.4.22"
    assert [test.missing for test in tests if test.standard == standard] == [(), (), ()]
    assert {test.standard for test in tests} <= set(EDITIONS)


@pytest.mark.slow
def test_an_arm_that_is_too_large_measures_everything_too_large(recorded):
    grown = 1.0001
    arm = recorded.nominal.arm
    large = aj.Arm(alpha=arm.alpha, a=grown * arm.a, d=grown * arm.d, theta=arm.theta, probe=grown * arm.probe)
    lengths = [float(length.value) for length in recorded.capture.lengths]
    span, rms = 1e-4 * (max(lengths) - min(lengths)), 1e-4 * math.sqrt(np.mean(np.square(lengths)))
    expected = {"Length_Range": span, "Volumetric_Range": span, "Length_2RMS": 2 * rms, "Volumetric_2RMS": 2 * rms}
    expected |= {"D_Eff": 1e-4 * 31.0, "P_Size": 1e-4 * 31.0}  # of the sphere and of the probe's ball
    for name, values in values_of(run(measured_by(large, recorded))).items():
        for found in values:
            error = 1e-4 * found.length if name in ("E_Uni", "Volumetric", "Length") else expected.get(name, 0.0)
            assert found.value == pytest.approx(error, abs=2e-6), (name, found.where)


@pytest.mark.slow
def test_a_probe_that_is_off_scatters_tips_on_a_sphere(cheng):
    recorded = simulate_procedure(plan_procedure(cheng.arm, "asme"), cheng, cheng)
    off = 0.1
    space = aj.Parameters(cheng.arm, ("probe_z",))
    arm = space.arm(space.vector() + off)
    tests = run(measured_by(arm, recorded))
    for name, q in recorded.capture.sockets.items():
        if not name.startswith("spat"):
            continue
        # Every tip is off along the last frame's z axis, by the same amount.
        tips = off * np.asarray(cheng.arm.pose(q))[:, :3, 2]
        spans = tips.max(axis=0) - tips.min(axis=0)
        away = np.linalg.norm(tips - tips.mean(axis=0), axis=1)
        found = {
            metric: value.value for metric, values in values_of(tests).items() for value in values
            if value.where.startswith(name)
        }  # fmt: skip
        assert found["Deltam"] == pytest.approx(spans.max() / 2, abs=1e-8)
        assert found["SPAT"] == pytest.approx(away.max(), abs=1e-8)
        assert found["SPAT_2s"] == pytest.approx(2 * np.sqrt(np.sum(away**2) / 9), abs=1e-8)


# --- What a capture contains ---


@pytest.mark.parametrize(
    ("sockets", "lengths", "reach", "missing"),
    [
        ({"A": 10}, [], None, {"single-point articulation": ["reach and the shoulder", "elbow", "measuring range"]}),
        (
            {"A": 10, "B": 1, "C": 1},
            [("B", "C", 100.0)],
            1000.0,
            {
                "single-point articulation": ["at 0 to 20 % of the reach (0 to 200 mm", "elbow", "measuring range"],
                "volumetric": [
                    "Exactly two bars are required",
                    "500 to 750 mm) and one of 120 to 150 % of the reach (1200 to 1500 mm",
                    "20 different positions are required (1 given)",
                    "not all in one plane",
                    "scatter by 0.0 % of the size of the volume",
                    "measuring range",
                ],
                "length error": [
                    "5 different lengths are required (1 given)",
                    "7 different positions of every length are required (one length has 1)",
                    "3 readings in each position are required (one position has 1)",
                    "not all in one plane",
                    "at least 10 % is required",
                    "measuring range",
                ],
            },
        ),
    ],
)
def test_what_a_full_procedure_would_also_need(sockets, lengths, reach, missing):
    points = {name: PLACE + 100.0 * number + np.zeros((size, 3)) for number, (name, size) in enumerate(sockets.items())}
    ball = None if reach is None else Reach(np.zeros(3), reach)
    references = tuple(aj.ReferenceLength(*length) for length in lengths)
    found = {test.title: test.missing for test in run(Measured(points, references, reach=ball))}
    for title, wanted in missing.items():
        assert len(found[title]) == len(wanted), found[title]
        for sentence, words in zip(found[title], wanted, strict=True):
            assert words in sentence


def test_zones_depend_on_the_distance_from_the_shoulder():
    shoulder = np.array([0.0, 0.0, 376.5])
    fractions = (0.1, 0.2, 0.21, 0.8, 0.81, 1.1)
    points = {f"{x}": np.tile(shoulder + np.array([x * 1000.0, 0, 0]), (10, 1)) for x in fractions}
    values = values_of(run(Measured(points, reach=Reach(shoulder, 1000.0))))["SPAT"]
    found = [value.where.split("(")[1].split(" %")[0] for value in values]
    assert found == ["0 to 20", "0 to 20", "20 to 80", "20 to 80", "80 to 100", "80 to 100"]


def test_reach_of_arms():
    # Two links in a plane and a probe along the second: 300 + 200 + 50 when stretched; with the elbow's limits less.
    limits = [(-3, 3), (math.pi / 2, 3)]
    arm = aj.Arm(alpha=[0, 0], a=[300, 200], d=[100, 0], theta=[0, 0], probe=[50, 0, 0])
    assert aj.kinematics.arm_reach(arm).radius == pytest.approx(550)
    bent = aj.Arm(alpha=[0, 0], a=[300, 200], d=[100, 0], theta=[0, 0], probe=[50, 0, 0], limits=limits)
    assert aj.kinematics.arm_reach(bent).radius == pytest.approx(math.hypot(300, 250))


@pytest.mark.parametrize("test", ["effective-diameter", "probing", "articulation"])
def test_metrics_that_could_not_fail_are_left_out(test):
    """A sphere goes through four points exactly, and the sphere around one centre has no size."""
    points = PLACE + 12.5 * AXES[[0, 1, 2, 4]]
    names = values_of(run(Measured({}, spheres=(aj.data.ProbedSphere("S", test, (points,), 25.0),)))).keys()
    assert names == {"effective-diameter": {"D_Eff"}, "probing": {"P_Size"}, "articulation": set()}[test]


def test_a_limit_without_data_is_refused():
    sockets = {"A": PLACE + np.eye(3)}
    assert_refused(lambda: run(Measured(sockets), {"P_Size": Limit(0.1)}), "P_Size", "no data for this metric")


# --- Files ---


@pytest.mark.slow
def test_readings_taken_by_the_plan_come_back_through_its_manifest(procedure, recorded, cheng, tmp_path):
    """As in a laboratory: plan, record one file per socket and per group of touches, import."""
    (tmp_path / "acceptance.toml").write_text(plan_manifest(procedure, "cheng2018-simulation"))
    files: dict[str, list[str]] = {}
    for row in csv.DictReader(plan_csv(procedure).splitlines()):
        files.setdefault(row["file"], []).append(" ".join(row[f"q_{i}_deg"] for i in range(1, 7)))
    for name, rows in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("\n".join(rows))
    imported = aj.files.read_manifest(tmp_path / "acceptance.toml")
    assert sorted(imported.capture.names) == sorted(recorded.capture.names)
    assert imported.acceptance == recorded.acceptance == (procedure.standard,)
    assert len(imported.capture.lengths) == len(recorded.capture.lengths)
    assert len(imported.sources) == 1 + len(files)
    # The plan prints angles to 0.001 deg: 0.02 mm at the end of the arm, several joints together.
    for name, values in values_of(run(measured_by(cheng.arm, imported))).items():
        assert max(abs(found.value) for found in values) < (0.2 if "2RMS" not in name else 0.3), name
    # And through HDF5.
    aj.files.save_capture(tmp_path / "capture.h5", imported)
    again = aj.files.load_capture(tmp_path / "capture.h5")
    assert [sphere.name for sphere in again.spheres] == [sphere.name for sphere in imported.spheres]
    for one, other in zip(again.spheres, imported.spheres, strict=True):
        assert (one.test, one.diameter, one.u, one.stylus) == (other.test, other.diameter, other.u, other.stylus)
        for rows, others in zip(one.groups, other.groups, strict=True):
            np.testing.assert_array_equal(rows, others)
    assert again.sources == imported.sources


POINTS = """
[points]
unit = "um"
reach = 1000
shoulder = [0, 0, 0]
[[socket]]
name = "{end}"
file = "{end}.txt"
[[length]]
from = "a"
to = "b"
value = 100
u = 0.001
[[sphere]]
name = "S"
test = "probing"
file = "sphere/touch.txt"
diameter = 30.98
"""


def test_points_are_evaluated_without_an_arm(aacmm, tmp_path):
    (tmp_path / "points.toml").write_text(POINTS)
    (tmp_path / "a.txt").write_text("0 0 0\n")
    (tmp_path / "b.txt").write_text("100030 0 0\n")
    (tmp_path / "sphere").mkdir()
    np.savetxt(tmp_path / "sphere" / "touch.txt", 1000 * (PLACE + 15.5 * AXES))
    found = json.loads(aacmm("evaluate", "points.toml", "--mpe", "E_Uni=0.05", "--json").stdout)
    values = {figure["name"]: figure["value_mm"] for test in found["acceptance"] for figure in test["figures"]}
    assert (values["E_Uni"], values["P_Size"], values["P_Form"]) == pytest.approx((0.03, 0.02, 0), abs=1e-9)
    printed = aacmm("evaluate", "points.toml", "--mpe", "E_Uni=0.03", expect=1).stdout
    assert "undecided" in printed
    assert "25 points per group are required (fewer: 'S', group 1" in " ".join(printed.split())
    assert "based on ISO 10360-12:2016" in printed


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('to = "b"', 'to = "c"'), "unknown socket 'c'"),
        (('test = "probing"', 'test = "probe"'), "'sphere 1.test'"),
        (("diameter = 30.98", "diameter = 0"), "diameter"),
        (('file = "sphere/touch.txt"', ""), "either file or files"),
        (('unit = "um"', 'unit = "um"\ncolumns = [1, 2, 4]'), "column '4'"),
        (('unit = "um"', 'unit = "um"\ncolumns = [1, 1, 2]'), "pick the same column twice"),
        (("reach = 1000", "reech = 1000"), "did you mean 'reach'"),
        (("shoulder = [0, 0, 0]", ""), "reach and shoulder are needed together"),
        (
            ('name = "{end}"', 'name = "{end}"\ntarget = "ball"'),
            "target, session, temperature_C and load_kg apply only to",
        ),
    ],
)
def test_wrong_manifests_of_points(tmp_path, change, said):
    for name in ("a.txt", "b.txt", "touch.txt"):
        np.savetxt(tmp_path / name, 1000 * (PLACE + 15.5 * AXES + (name == "b.txt")))
    text = POINTS.replace("sphere/touch", "touch")
    (tmp_path / "points.toml").write_text(text.replace(*(part.replace("sphere/touch", "touch") for part in change)))
    assert_refused(lambda: aj.files.read_points(tmp_path / "points.toml"), "points.toml", said)


@pytest.mark.slow
def test_an_evaluation_is_stored_whole(recorded, tmp_path):
    used = frozenset(recorded.capture.names[:1])
    limits = {"E_Uni": Limit(0.1, 4e4), "Deltam": Limit(0.1)}
    warm = acceptance.Influences(0.0, 2e-6, acceptance.Expansion(11.5e-6, 1e-6, 21.0, 0.2))
    record = acceptance.EvaluationRecord(recorded, recorded.nominal, used, ("x",), limits, 0.001, {"rms_mm": 0.2})
    record = record._replace(influences=warm, rule="iso-2013")
    aj.files.save_evaluation(tmp_path / "e.h5", record)
    again = aj.files.load_evaluation(tmp_path / "e.h5")
    assert (again.used, again.warnings, again.limits, again.u_test, again.maxima) == record[2:7]
    assert (again.influences, again.rule) == (record.influences, record.rule)
    assert (again.standards, again.uncertainty) == (("jjf", "asme", "iso"), None)
    # To rounding of the last bit of poses read back, the same tests come out.
    assert again.acceptance()["calibrated"] == record.acceptance()["calibrated"]
    # Sockets that the arm was identified from are no test of repeatability.
    assert not {value.where for value in values_of(again.acceptance()["calibrated"])["Deltam"]} & used


@pytest.fixture(scope="module")
def calibrated(cheng):
    """A calibration from sockets A and B, and a recording that also has C."""
    sockets = {"A": (400, 200, 300), "B": (700, 500, 500), "C": (-300, 600, 400)}
    lengths = [("A", "B", 0.002), ("A", "C", 0.002)]
    capture = aj.simulate(
        cheng.arm, sockets, poses={"A": 40, "B": 12, "C": 12}, lengths=lengths, encoder_arcsec=2.0, seed=1
    )
    seen = capture.select(without="C")
    space = aj.Parameters.free_of(cheng.arm)
    result = aj.calibrate(cheng.arm, seen, aj.Bounds.around(cheng.arm, space, length=10.0, angle=0.0175))
    return aj.calibration.record_of(result, aj.Recording(seen, cheng)), aj.Recording(capture, cheng)


@pytest.mark.slow
def test_only_held_out_data_are_tested_with_the_uncertainty_that_is_stated(calibrated):
    record, recording = calibrated
    found = values_of(
        aj.evaluate_capture(record, recording, u_test=0.01, standards=STANDARDS).acceptance()["calibrated"]
    )
    assert {value.where for value in found["Deltam"]} == {"C"}
    assert {value.where.partition(",")[0] for value in found["E_Uni"]} == {"A - C"}
    assert found["Deltam"][0].expanded == pytest.approx(0.02)
    assert found["E_Uni"][0].expanded == pytest.approx(2 * math.hypot(0.002, 0.01))


@pytest.mark.slow
def test_sockets_that_share_poses_with_the_calibration_are_not_new(calibrated):
    record, recording = calibrated
    # C is new, B is known except for two poses.
    q = recording.capture.sockets
    more = {"A": q["A"], "B": np.concatenate([q["B"], q["C"][:2] + 0.001]), "C": q["C"]}
    evaluation = aj.evaluate_capture(
        record, recording._replace(capture=aj.Capture(more, recording.capture.lengths)), limits={"Deltam": 1.0}
    )
    assert evaluation.limits == {"Deltam": Limit(1.0)}
    assert evaluation.used == {"A", "B"}
    assert "B (12 of 14 poses)" in " ".join(evaluation.warnings)


@pytest.mark.slow
def test_procedures_are_run_where_they_are_asked_for(calibrated, procedure, recorded):
    """By name, by a limit, or because the capture was made for them: as it says, or as its touched spheres say."""
    record, recording = calibrated

    def standards(recording, **options):
        found = aj.evaluate_capture(record, recording, **options).acceptance()
        nominal, calibrated = ({test.standard for test in found[stage]} for stage in ("nominal", "calibrated"))
        assert nominal == calibrated
        return calibrated

    assert standards(recording) == set()
    assert standards(recording, standards=["iso"]) == {"ISO 10360-12"}
    assert standards(recording, limits={"Volumetric": 1.0}) == {"ASME B89.4.22"}
    assert standards(recording._replace(acceptance=("jjf",))) == {"JJF 1408"}
    assert standards(recorded._replace(acceptance=())) == {STANDARDS[procedure.standard]}
    assert_refused(lambda: standards(recording, standards=["din"]), "'din'", "jjf, asme, iso")


@pytest.mark.slow
def test_what_makes_an_evaluation_doubtful_is_said_first(calibrated):
    record, recording = calibrated
    seen = aj.evaluate_capture(record, record.recording, limits={"Deltam": Limit(1.0)})
    words = " ".join(seen.warnings)
    assert "too favourable and are not a test" in words
    assert "No uncertainty was stated for Deltam" in words
    assert all(test.missing for test in seen.acceptance()["calibrated"])
    failed = aj.evaluate_capture(record._replace(converged=False, reason="It did not."), recording)
    assert "The calibration is not usable" in failed.warnings[0]
    simulated = aj.evaluate_capture(record, recording._replace(true=recording.nominal))
    assert "simulated" in simulated.warnings[0]


def test_an_evaluation_of_points_is_stored_whole(tmp_path):
    from aacmm_jax.files.evaluations import load_evaluation, save_evaluation

    spheres = (aj.data.ProbedSphere("S", "probing", (PLACE + 15.5 * AXES,), 31.0, 0.001, 0.0, 0.0002, 0.0001),)
    measured = lengths_of((0.01, 0.001, 100.0))._replace(
        spheres=spheres, reach=Reach(np.ones(3), 900.0), measured="2026-01-31", measuring_range=1800.0
    )
    cold = acceptance.Influences(arm=acceptance.Expansion(23e-6, 0.0, 15.0))
    record = acceptance.PointsRecord(measured, {"E_Uni": Limit(0.02, 49)}, 0.001, influences=cold)
    save_evaluation(tmp_path / "points.h5", record)
    again = load_evaluation(tmp_path / "points.h5")
    assert again.acceptance() == record.acceptance()
    assert (again.limits, again.u_test, again.measured.measured) == (record.limits, record.u_test, "2026-01-31")
    written = aj.report.write_report(tmp_path / "points.h5", tmp_path / "points.html")
    assert written["verdict"].startswith("Conforms: all limits given are met")


@pytest.mark.slow
def test_bars_at_hand_are_planned_for(cheng):
    procedure = plan_procedure(cheng.arm, "asme", bars=[1000.0, 500.5])
    assert sorted({value for *_, value in procedure.lengths}) == [500.5, 1000.0]
    assert len(procedure.left_out) == 2  # neither is within the ranges of the standard, for a reach of 1359 mm
    for start, end, value in procedure.lengths:
        ends = [next(item for item in procedure.sockets if item.name == name).points[0] for name in (start, end)]
        assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(value, abs=1e-5)
    assert_refused(lambda: plan_procedure(cheng.arm, "iso", bars=[500.0]), "needs 5")


@pytest.mark.slow
def test_an_arm_that_cannot_take_a_zone_goes_without_it():
    procedure = plan_procedure(aj.load_arm("iiwa14"), "asme")
    assert "0 to 20 %" in procedure.left_out[0]
    assert {item.name for item in procedure.sockets if item.name.startswith("spat")} == {"spat/middle", "spat/far"}
    assert_refused(lambda: plan_procedure(aj.load_arm("iiwa14"), "asme", margin=3.0), "margin")
    assert_refused(lambda: plan_procedure(aj.load_arm("iiwa14"), "vdi"), "choose one of jjf, asme, iso")


@pytest.mark.slow
def test_planned_poses_can_be_taken(cheng, procedure):
    limits = np.array(cheng.arm.limits or [(-math.pi, math.pi)] * 6)
    for item in (*procedure.sockets, *procedure.touches):
        np.testing.assert_allclose(cheng.arm.position(item.q), item.points, atol=1e-5)
        assert np.all((item.q >= limits[:, 0] + MARGIN - 1e-9) & (item.q <= limits[:, 1] - MARGIN + 1e-9))
        assert item.points[:, 2].min() >= ABOVE
    for sphere in procedure.spheres:
        for item in (item for item in procedure.touches if item.name == sphere.name):
            distances = np.linalg.norm(item.points - sphere.centre, axis=1)
            np.testing.assert_allclose(distances, (sphere.diameter + sphere.stylus) / 2, atol=1e-9)
            # From outside: the probe points against the normal of the surface.
            towards = np.asarray(cheng.arm.pose(item.q))[:, :3, :3] @ np.asarray(cheng.arm.probe)
            assert np.all(np.sum(towards * (item.points - sphere.centre), axis=1) < 0)
