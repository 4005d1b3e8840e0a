"""Real robot captures, calibrated and evaluated by the command line alone, from the manifests in ``examples/mukca``.

Each arm is identified from some placements of a tool with two sockets and evaluated on placements that it never used.
"""

import json
from typing import NamedTuple

import pytest

import aacmm_jax as aj


class Case(NamedTuple):
    """One capture: what is left out of the identification, and what is expected of the placements left out, mm.

    ``nominal`` and ``asked`` are pairs: RMS distance from the centroid of the socket, and mean absolute error of the
    50 mm length; ``nominal`` of the nominal arm, ``asked`` the most that the calibrated arm may have.
    """

    manifest: str
    held_out: tuple[str, ...]
    options: tuple[str | int, ...]
    nominal: tuple[float, float]
    asked: tuple[float, float]


HOLD = ("--hold", "d_3")
CASES = {
    "panda_2_clean": Case("capture.toml", ("mid_left", "mid_right"), HOLD, (9.89, 0.13), (0.247, 0.040)),
    "panda_6": Case("panda_6.toml", ("right",), (*HOLD, "--length-bound-mm", 10), (11.98, 9.12), (0.285, 0.060)),
    "kuka_14": Case("kuka_14.toml", ("raised_left",), HOLD, (27.1, 8.96), (0.47, 0.17)),
}


def left_out(case: Case) -> list[str]:
    return [word for placement in case.held_out for word in ("--without", f"{placement}/*")]


# The default cross-validation takes half a minute.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "cross_validate"),
    [
        ("panda_6", False),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (("panda_2_clean", False), ("kuka_14", False), ("panda_6", True))
        ),
    ],
)
def test_unseen_placements(aacmm, mukca, name, cross_validate):
    case = CASES[name]
    aacmm("import", mukca / case.manifest, "-o", "capture.h5")
    options = [*left_out(case), *case.options, *(() if cross_validate else ("--no-cross-validate",))]
    calibrated = json.loads(aacmm("calibrate", "capture.h5", "-o", "calibration.h5", *options, "--json").stdout)
    assert (calibrated["cross_validation"] is not None) == cross_validate
    held_out = json.loads(aacmm("evaluate", "calibration.h5", "capture.h5", "--json").stdout)["held_out"]
    assert {row["socket"].split("/")[0] for row in held_out["sockets"]} == set(case.held_out)
    before, after = held_out["nominal"], held_out["calibrated"]
    assert before["rms_mm"] == pytest.approx(case.nominal[0], rel=2e-3)
    assert before["length_error_mean_absolute_mm"] == pytest.approx(case.nominal[1], abs=0.006)
    assert after["rms_mm"] <= case.asked[0]
    assert after["length_error_mean_absolute_mm"] <= case.asked[1]


@pytest.mark.parametrize(
    ("manifest", "sockets", "lengths", "poses"),
    [
        ("capture.toml", 16, 8, 497),
        ("panda_6.toml", 6, 3, 199),
        ("panda_3.toml", 12, 6, 387),
        ("panda_3_bis.toml", 6, 3, 180),
        ("kuka_14.toml", 6, 3, 180),
    ],
)
def test_every_manifest_of_the_examples_is_read(mukca, manifest, sockets, lengths, poses):
    capture = aj.files.read_manifest(mukca / manifest).capture
    assert (len(capture.names), len(capture.lengths), sum(capture.sizes)) == (sockets, lengths, poses)


@pytest.mark.slow
def test_free_lengths_shrink_the_arm_and_the_result_says_so(aacmm, mukca):
    """Without a scale anchor stage 1 shrinks this arm to 0.947, with d_5 on its bound."""
    case = CASES["panda_2_clean"]
    aacmm("import", mukca / case.manifest, "-o", "capture.h5")
    options = [*left_out(case), "--hold", "none", "--no-cross-validate", "--json"]
    result = json.loads(aacmm("calibrate", "capture.h5", "-o", "calibration.h5", *options).stdout)
    assert result["scale_k"] == pytest.approx(0.947, abs=5e-4)
    assert result["active_stage1"] == {"d_5": "lower"}
    assert any("the arm shrank (k = 0.9469" in text and "d_5 (lower)" in text for text in result["warnings"])
    shown = aacmm("show", "calibration.h5").stdout
    assert "Warning: In stage 1, every length was free" in shown
    after = json.loads(aacmm("evaluate", "calibration.h5", "capture.h5", "--json").stdout)["held_out"]["calibrated"]
    assert after["rms_mm"] <= case.asked[0]
    assert after["length_error_mean_absolute_mm"] <= case.asked[1]
