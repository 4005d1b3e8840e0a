"""Real robot captures, by the command line alone, from manifests that a person would write.

Each arm is identified from some placements of a two-hole tool and tried on placements that were never used.
"""

import json

import pytest

MANIFEST = """\
arm = "{arm}"

[angles]
unit = "rad"

[[socket]]
name = "{{place}}/{{hole}}"
file = "{folder}/{{place}}/hole_{{hole}}.csv"

[[length]]
from = "{{place}}/0"
to = "{{place}}/1"
value = 50.0
u = 0.01
"""
# Arm, capture, placements kept for the test, options, and what is asked: RMS distance from the socket's centroid and error
# of the 50 mm length (nominal arm and calibrated), mm. The nominal figures and the reference result are the data's own.
CASES = {
    "panda_2_clean": ("panda", ["mid_left", "mid_right"], ["--hold", "d_3"], (9.89, 0.13), (0.247, 0.040)),
    "panda_6": ("panda", ["right"], ["--hold", "d_3", "--length-bound-mm", 10], (11.98, 9.12), (0.285, 0.060)),
    "kuka_14": ("iiwa14", ["raised_left"], ["--hold", "d_3"], (27.1, 8.96), (0.47, 0.17)),
}


@pytest.fixture
def manifest(shared, tmp_path):
    def write(name: str) -> None:
        folder = shared / "data" / "mukca" / name
        (tmp_path / f"{name}.toml").write_text(MANIFEST.format(arm=CASES[name][0], folder=folder.as_posix()))

    return write


# The one that is cross-validated takes half a minute.
@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name == "panda_6" else ()) for name in CASES])
def test_unseen_placements(aacmm, manifest, name):
    _, places, options, nominal, asked = CASES[name]
    manifest(name)
    aacmm("import", f"{name}.toml", "-o", "capture.h5")
    without = [item for place in places for item in ("--without", f"{place}/*")]
    crossed = () if name == "panda_6" else ("--no-cross-validate",)  # one of them as a user would run it
    done = aacmm("calibrate", "capture.h5", "-o", "calibration.h5", *without, *options, *crossed, "--json")
    validation = json.loads(done.stdout)["cross_validation"]
    assert (validation is None) == bool(crossed)
    result = json.loads(aacmm("evaluate", "calibration.h5", "capture.h5", "--json").stdout)
    held_out = result["held_out"]
    assert {row["socket"].split("/")[0] for row in held_out["sockets"]} == set(places)
    before, after = held_out["nominal"], held_out["calibrated"]
    assert before["rms_mm"] == pytest.approx(nominal[0], rel=2e-3)
    assert before["length_error_mean_absolute_mm"] == pytest.approx(nominal[1], abs=0.006)
    assert after["rms_mm"] <= asked[0]
    assert after["length_error_mean_absolute_mm"] <= asked[1]


@pytest.mark.slow
def test_free_lengths_shrink_the_arm_and_the_result_says_so(aacmm, manifest):
    """Without a held length stage 1 shrinks this arm to 0.947 (the data's reference), with d_5 on its bound."""
    name = "panda_2_clean"
    manifest(name)
    aacmm("import", f"{name}.toml", "-o", "capture.h5")
    without = ["--without", "mid_left/*", "--without", "mid_right/*"]
    done = aacmm("calibrate", "capture.h5", "-o", "calibration.h5", *without, "--hold", "none", "--no-cross-validate", "--json")
    result = json.loads(done.stdout)
    assert result["scale_k"] == pytest.approx(0.947, abs=5e-4)
    assert result["active_stage1"] == {"d_5": "lower"}
    assert any("shrank the arm to k = 0.9469" in warning and "d_5 (lower)" in warning for warning in result["warnings"])
    shown = aacmm("show", "calibration.h5").stdout
    assert "Warning: Stage 1 ran with every length free" in shown
    evaluated = json.loads(aacmm("evaluate", "calibration.h5", "capture.h5", "--json").stdout)
    assert evaluated["held_out"]["calibrated"]["rms_mm"] <= 0.247
    assert evaluated["held_out"]["calibrated"]["length_error_mean_absolute_mm"] <= 0.040
