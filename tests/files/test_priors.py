"""Priors in arm files, in HDF5 and on the command line."""

import json

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.units import DEG
from aacmm_jax.files.arm_tables import prior_of_text
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.kinematics import with_corrections

ARM = """
length_unit = "m"
angle_unit = "deg"
probe = [0, 0, 0.1]
joint = [{ alpha = -90, a = 0, d = 0.3 }, { alpha = 90, a = 0, d = 0.01 }, { alpha = -80, a = 0.01, d = 0.4 }]
"""
PRIORS = """
[priors]
sd = { lengths = 0.0005, angles = 0.05, d_3 = 0.0001 }
mean = { d_3 = 0.4001 }
learn = ["theta"]
"""


def assert_same(prior, expected):
    for one, other in zip(parts(prior), parts(expected), strict=True):
        assert one == (pytest.approx(other) if isinstance(other, dict) else other)


def parts(prior):
    """What a prior says."""
    numbers = {kind: {name: float(x) for name, x in getattr(prior, kind).items()} for kind in ("sd", "mean")}
    learned = {group for group, learned in zip(prior.groups, prior.learned, strict=True) if learned}
    return numbers["sd"], numbers["mean"], learned


@pytest.mark.slow
def test_an_arm_file_states_its_prior(tmp_path):
    path, again = tmp_path / "arm.toml", tmp_path / "again.toml"
    path.write_text(ARM + PRIORS)
    specification = aj.files.load_specification(path)
    expected = aj.Prior({"lengths": 0.5, "angles": 0.05 * DEG, "d_3": 0.1}, mean={"d_3": 400.1}, learn=["theta"])
    assert_same(specification.prior, expected)
    again.write_text(specification_toml(specification))
    assert_same(aj.files.load_specification(again).prior, expected)


@pytest.mark.parametrize(
    ("table", "message"),
    [("sd = { length = 0.1 }", "did you mean 'lengths'"), ("sd = { lengths = 0.0 }", "greater than 0"), ("", "one")],
)
def test_refused_in_an_arm_file(tmp_path, table, message):
    (tmp_path / "arm.toml").write_text(f"{ARM}[priors]\n{table}\n")
    with pytest.raises(aj.InputError, match=message):
        aj.load_arm(tmp_path / "arm.toml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("length=0.5mm,angle=0.05deg", aj.Prior({"lengths": 0.5, "angles": 0.05 * DEG})),
        ("d_3=750.2+-0.1mm, theta_*=20arcsec", aj.Prior({"d_3": 0.1, "theta_*": 20 * DEG / 3600}, mean={"d_3": 750.2})),
        ("a=100um,alpha=learn", aj.Prior({"a": 0.1}, learn=["alpha"])),
        ("learn", aj.Prior(learn=True)),
        ("harmonics=2-3=learn,gravity=learn", aj.Prior(learn=["harmonics=2-3", "gravity"])),
        ("gravity=2mrad/m,gear=2e-4", aj.Prior({"gravity": 2e-3, "gear": 2e-4})),
    ],
)
def test_text(paper_arm, text, expected):
    assert_same(prior_of_text(text, with_corrections(paper_arm, "gravity,gear,harmonics=1-3")), expected)


def test_no_prior(paper_arm):
    assert prior_of_text("none", paper_arm) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("length=0.5", "not of the form"),
        ("length=0.5deg", r"unit \(mm, um, m\)"),
        ("all=1mm", "need separate groups"),
        ("alpha=learn,alpha=1deg", "twice"),
        ("d_9=1mm", "did you mean"),
        ("alpha", "not of the form"),
        ("", "at least one"),
    ],
)
def test_refused_text(paper_arm, text, message):
    with pytest.raises(aj.InputError, match=message):
        prior_of_text(text, paper_arm)


@pytest.mark.slow
def test_command_line(tmp_path, aacmm, paper_arm):
    """The arm file's prior applies, unless the command line states one."""
    space = aj.Parameters.independent(paper_arm)
    true = aj.perturbed_arm(space, length=0.3, angle=5e-4)
    points = {"A": (400, 200, 300), "B": (500, 300, 100)}
    capture = aj.simulate(true, points, poses=12, lengths=[("A", "B", 0.002)], encoder_arcsec=5)
    nominal = aj.kinematics.ArmSpecification(paper_arm, "arm", held=space.held[:6], prior=aj.Prior({"lengths": 0.3}))
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(capture, nominal))

    def groups(*options):
        summary = json.loads(aacmm("calibrate", "c.h5", "-o", "r.h5", "--json", *options).stdout)
        return summary["method"], summary["prior"] and [row["group"] for row in summary["prior"]]

    assert groups() == ("joint", ["lengths"])
    assert groups("--prior", "learn") == ("joint", ["lengths", "angles"])
    shown = aacmm("show", "r.h5").stdout
    assert "Priors, and number of parameters" in shown
    assert "learned" in shown
    assert groups("--prior", "none") == ("two-stage", None)
    assert "--prior 'angle=1mm'" in aacmm("calibrate", "c.h5", "-o", "r.h5", "--prior", "angle=1mm", expect=2).stderr
    assert np.isfinite(aj.uncertainty_of(aj.files.load_calibration(tmp_path / "r.h5")).u).all()
