"""Compared models in a file: what was saved is read, shown and reported."""

import json

import pytest

import aacmm_jax as aj
from aacmm_jax.files.evaluations import load_compared_models, save_compared_models
from aacmm_jax.report import write_report
from tests.refusals import assert_refused


def row(model, inside, outside, ratio):
    regions = [
        {"region": "left", "poses": 30, "rms": 0.9 * outside, "ratio": 1.1},
        {"region": "right <b>", "poses": 20, "rms": 1.1 * outside, "ratio": None},
    ]
    return {
        "model": model, "parameters": 23, "effective_parameters": 22.5, "rms_inside": inside, "rms_outside": outside,
        "u_outside": 0.03, "ratio": ratio, "log_evidence": 3.0, "difference": 0.01, "u_difference": 0.02,
        "converged": model == "dh", "cpu_seconds": 1.5, "regions": regions,
    }  # fmt: skip


SUMMARY = {
    "arm": "Panda", "regions": ["left", "right <b>"],
    "models": [row("dh", 0.3, 0.33, 1.1), row("gravity", 0.2, 0.31, 1.2)],
    "best": "gravity", "recommended": "dh", "findings": ["Recommended: dh, the simplest."], "warnings": [], "poses": 50,
}  # fmt: skip


@pytest.fixture
def file(tmp_path):
    save_compared_models(tmp_path / "models.h5", SUMMARY, ["capture.h5 (SHA-256 0)"], 3)
    return tmp_path / "models.h5"


def test_what_was_saved_is_read(file):
    assert load_compared_models(file) == SUMMARY
    assert_refused(lambda: aj.files.load_capture(file), "contains a model comparison")


@pytest.mark.first_rows(3)
@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"recommended": "functions"}, "recommended model is not one"),
        ({"models": [row("dh", 0.3, 0.33, 1.1)] * 2}, "named twice"),
        ({"models": [SUMMARY["models"][0], row("gravity", 0.2, 1e300, 1.2)]}, "impossibly large"),
        ({"models": [SUMMARY["models"][0], row("gravity", -0.2, 0.3, 1.2)]}, "negative"),
        ({"models": [SUMMARY["models"][0], row("gravity", None, 0.3, 1.2)]}, "lacks a number"),
        ({"regions": ["left"]}, "lacks a region"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, changed, says):
    """Edited by somebody who made the digests anew."""
    save_compared_models(tmp_path / "models.h5", SUMMARY | changed)
    assert_refused(lambda: load_compared_models(tmp_path / "models.h5"), says)
    assert_refused(lambda: write_report(tmp_path / "models.h5", tmp_path / "report.html"), says)


@pytest.mark.slow
def test_it_is_shown_and_reported(file, aacmm, tmp_path):
    assert json.loads(aacmm("show", "models.h5", "--json").stdout) == SUMMARY
    assert "Recommended: dh" in aacmm("show", "models.h5").stdout
    summary = write_report(file, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert summary["verdict"] == "Recommended: dh, the simplest."
    assert "right &lt;b&gt;" in page
    assert "<b>" not in page.split("</style>")[1].replace("<b>Errors by", "").replace("<b>Recommended", "")
    for words in ("0.3300", "did not converge", "capture.h5 (SHA-256 0)"):
        assert words in page
