"""``compare-models``, and ``calibrate --model`` with its default prior."""

import json

import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.files import save_capture
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.parameters import ArmSpecification

from ..own_kinds import forgotten_kinds

BOX = [[200, -300, 100], [600, 300, 500]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, paper_arm):
    """60 poses seen by a tracker, of an arm with two eccentric encoders."""
    path = tmp_path_factory.mktemp("models")
    true = with_corrections(paper_arm, "harmonics=1").replace(cos1_2=5e-4, sin1_3=-4e-4)
    points = [kinds.SimulatedPoints("T", BOX, 60, (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0), u=0.01)]
    capture = aj.simulate(true, {}, observations=points, noise=aj.Noise(encoder_arcsec=10, seating=0.02), seed=1)
    space = aj.Parameters.independent(paper_arm)
    nominal = ArmSpecification(paper_arm, "arm", held=space.held)
    save_capture(path / "c.h5", aj.Recording(capture, nominal))
    return path


@pytest.mark.slow
def test_models_are_compared(aacmm, folder):
    command = ("compare-models", folder / "c.h5", "--models")
    found = json.loads(aacmm(*command, "dh; gravity; harmonics=1", "--json").stdout)
    assert found["recommended"] == "harmonics=1"
    assert found["poses"] == 60
    assert [row["model"] for row in found["models"]] == ["dh", "gravity", "harmonics=1"]
    assert len(found["regions"]) == 12
    assert found["models"][0]["rms_outside"] > found["models"][2]["rms_outside"]
    shown = aacmm(*command, "gear;dh", "--only-poses", 50).stdout
    assert "2 models on 50 poses, 12 regions held out in turn" in shown
    assert "gear is recommended" in shown
    assert "joint 3, upper half" in shown


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--models", "dh;;gravity"), "contains an empty model"),
        (("--models", "dh;dh"), "names 'dh' twice"),
        (("--models", "dh;grvity"), "did you mean 'gravity'"),
        (("--leave-out", "T"), "'T' leaves out all data"),
        (("--leave-out", "U"), "U"),
    ],
)
def test_refused(aacmm, folder, options, message):
    assert message in aacmm("compare-models", folder / "c.h5", *options, expect=2).stderr


@pytest.mark.slow
def test_a_model_has_a_default_prior(aacmm, folder, tmp_path):
    """All coefficients are free, and no trade-off of theirs is warned of."""
    command = ("calibrate", folder / "c.h5", "-o", tmp_path / "r.h5", "--model", "harmonics=1-3", "--json")
    found = json.loads(aacmm(*command).stdout)
    groups = {row["group"]: row for row in found["prior"]}
    assert list(groups) == ["lengths", "angles", "harmonics=1", "harmonics=2-3"]
    assert groups["harmonics=1"]["learned"]
    assert groups["harmonics=1"]["parameters"] == 12
    assert not [sentence for sentence in found["warnings"] if "cos" in sentence or "sin" in sentence]
    shown = aacmm("export", tmp_path / "r.h5", "--format", "table")
    assert "# cos1_2 = " in shown.stdout
    assert "The table contains the 36 coefficients of joint corrections as comments only. Without these" in shown.stderr
    aacmm("export", tmp_path / "r.h5", "--format", "toml", "-o", tmp_path / "r.toml")
    assert "arcsec" in aacmm("show", tmp_path / "r.toml").stdout
    rows = {
        row["coefficient"]: row
        for row in json.loads(aacmm("show", tmp_path / "r.toml", "--json").stdout)["corrections"]
    }
    assert (len(rows), rows["cos1_2"]["unit"]) == (36, "rad")
    assert rows["cos1_2"]["value"] == pytest.approx(5e-4, rel=0.2)


OWN = """
from aacmm_jax.kinematics import AbstractCorrection, register_correction


@register_correction
class Bow(AbstractCorrection):
    model, words, description = "bow", ("bow",), "bows of scales"
    unit, usual_size = "1/rad", 1e-4

    def values(self, terms, q, forward):
        return q.joints[[term.joint - 1 for term in terms]] ** 2
"""


def test_a_file_registers_own_corrections(aacmm, tmp_path, monkeypatch):
    """The model is known where the environment names the file, and only there."""
    (tmp_path / "bow.py").write_text(OWN)
    monkeypatch.setenv("AACMM_CORRECTIONS", "bow.py")
    with forgotten_kinds():
        assert "did you mean 'bow'?" in aacmm("arm", "cheng2018-simulation", "--model", "dh,bows", expect=2).stderr
    monkeypatch.delenv("AACMM_CORRECTIONS")
    refused = aacmm("arm", "cheng2018-simulation", "--model", "dh,bow", expect=2).stderr
    assert "AACMM_CORRECTIONS=FILE.py" in refused


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "bow.py, the file that AACMM_CORRECTIONS names, cannot be run: FileNotFoundError"),
        ("1 / 0", "cannot be run: ZeroDivisionError"),
        ("x =", "cannot be run: SyntaxError"),
        (
            OWN.replace(', usual_size = "1/rad", 1e-4', ' = "1/rad"'),
            "bow.py (AACMM_CORRECTIONS): the correction Bow lacks",
        ),
    ],
)
def test_a_file_that_does_not_register_is_refused(aacmm, tmp_path, monkeypatch, text, says):
    if text is not None:
        (tmp_path / "bow.py").write_text(text)
    monkeypatch.setenv("AACMM_CORRECTIONS", "bow.py")
    refused = aacmm("arm", "cheng2018-simulation", expect=2).stderr
    assert says in refused
    assert refused.count("\n") == 1
