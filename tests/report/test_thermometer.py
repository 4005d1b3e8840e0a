"""Reports and figures of an arm whose readings end with a temperature."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.report import write_report


@pytest.mark.slow
def test_report_and_figure_have_joints_alone(paper_arm, tmp_path):
    arm = paper_arm.replace(thermometer=True)
    nominal = aj.files.load_specification("cheng2018-simulation")._replace(arm=arm)
    sockets = {"A": (400, 200, 300), "B": (700, 500, 500)}
    noise = aj.Noise(encoder_arcsec=2, seating=0.005)
    capture = aj.simulate(
        arm, sockets, poses=20, lengths=[("A", "B", 0.002)], noise=noise, temperature=(15, 25), seed=1
    )
    result = aj.calibrate(arm, capture, nominal.bounds(), shared_errors=False)
    record = aj.calibration.record_of(result, aj.Recording(capture, nominal))
    assert len(aj.plot.residual_patterns(record).axes) == 6 + 3 + 1  # joints; x, y and z; a histogram
    aj.files.save_calibration(tmp_path / "calibration.h5", record)
    write_report(tmp_path / "calibration.h5", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "reading of joint 6 [deg]" in page
    assert "reading of joint 7" not in page
    assert "random poses within the joint limits" in page
    assert np.shape(capture.readings) == (40, 7)
