"""`aj.evaluate_capture` and `aj.evaluate_points`: their options by which data are chosen, and what they refuse.

What an evaluation contains is tested in `tests/acceptance`.
"""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.acceptance import Expansion, Influences
from tests.refusals import assert_refused


@pytest.fixture(scope="module")
def recording():
    nominal = aj.files.load_specification("cheng2018-simulation")
    sockets, lengths = {"A": (400, 200, 300), "B": (600, 200, 300)}, [("A", "B", 0.002)]
    return aj.simulate_capture(
        nominal, sockets, poses={"A": 40, "B": 8}, lengths=lengths, noise=aj.Noise(encoder_arcsec=2.0), seed=2
    )


@pytest.fixture(scope="module")
def record(recording):
    return aj.calibrate_capture(recording, cross_validate=False, shared_errors=False)


@pytest.mark.slow
def test_data_are_chosen_by_name(record, recording):
    chosen = aj.evaluate_capture(record, recording, only="A", measuring_range=None).recording
    assert (chosen.capture.names, chosen.capture.lengths) == (("A",), ())
    assert aj.evaluate_capture(record, recording, without=["A"]).recording.capture.names == ("B",)


@pytest.mark.slow
def test_the_measuring_range_is_that_of_the_recording_by_default(record, recording):
    stated = recording._replace(measuring_range=2000.0)
    for given, expected in ((None, 2000.0), (1800.0, 1800.0)):
        evaluation = aj.evaluate_capture(record, stated, measuring_range=given, standards=["jjf"])
        assert evaluation.recording.measuring_range == expected
        points = aj.acceptance.Measured({"A": np.eye(3)}, measuring_range=2000.0)
        assert aj.evaluate_points(points, measuring_range=given).measured.measuring_range == expected


@pytest.mark.slow
def test_warnings_of_the_calibration_are_those_given_or_tested_again(record, recording):
    assert aj.evaluate_capture(record, recording, calibration_warnings=["Read this."]).calibration_warnings == (
        "Read this.",
    )
    tested = aj.evaluate_capture(record, recording).calibration_warnings
    assert tested == tuple(finding.sentence for finding in aj.diagnostics.findings_of(record))
    assert tested


def test_points_are_tested_to_all_standards_by_default():
    points = aj.acceptance.Measured({"A": np.eye(3)})
    assert aj.evaluate_points(points).standards == ("jjf", "asme", "iso")
    assert aj.evaluate_points(points, standards=["iso"]).standards == ("iso",)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"rule": "simple"}, "--rule"),
        ({"u_test": 0.001}, "--test-u-mm"),
        ({"influences": Influences(u_relative=1e-6)}, "--test-u-mm"),
        ({"influences": Influences(arm=Expansion(1e-5, temperature=22.0))}, "--expansion"),
        ({"measuring_range": 1000.0}, "--range-mm"),
    ],
)
def test_options_of_acceptance_tests_are_refused_where_none_is_run(record, recording, options, name):
    assert_refused(lambda: aj.evaluate_capture(record, recording, **options), name, "applies to acceptance tests only")
    aj.evaluate_capture(record, recording, standards=["jjf"], **options)


@pytest.mark.parametrize(
    "options", [{"only": "A"}, {"without": "A"}, {"maxima": {"rms_mm": 1.0}}, {"calibration_warnings": ()}]
)
def test_options_of_a_calibration_are_refused_for_points(options):
    points = aj.acceptance.Measured({"A": np.eye(3)})
    assert_refused(lambda: aj.evaluate_points(points, **options), "do not apply to a manifest of points")
