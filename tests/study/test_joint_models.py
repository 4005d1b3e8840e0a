"""Studies of arms whose joints do more than they read: what true arms do, what each cell identifies, and how well."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.files.arms import specification_toml
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.study import make_study
from aacmm_jax.study.blocks import Block
from aacmm_jax.study.results import cell_summary
from aacmm_jax.study.tables import factor_title
from aacmm_jax.study.trial_simulation import _read_where
from aacmm_jax.study.trials import draw_trials, run_block
from tests.study.small_study import CAPTURE, DEVIATION, NOISE, REFERENCE

CAPTURE = CAPTURE | {"poses": 40}
FAULT = {"model": "harmonics=1,gear", "harmonics_arcsec": {"normal": 20}, "gear_ppm": 100}


def study(deviation=FAULT, capture=CAPTURE, reference=REFERENCE, **tables):
    tables = {"arm": "cheng2018-simulation", "trials": 16, "seed": 3, "noise": NOISE} | tables
    tables |= {} if reference is None else {"reference": reference}
    return make_study(capture=capture, deviation=DEVIATION | deviation, **tables)


@pytest.mark.slow
def test_what_a_cell_identifies():
    """Models of true arms and of cells are factors; a model has the default prior, and is solved jointly with it."""
    made = study(identification={"model": ["dh", "harmonics=1"], "prior": ["none", "harmonics=5arcsec"]})
    assert [cell["identification.model"] for cell in made.cells] == ["dh", "dh", "harmonics=1", "harmonics=1"]
    assert len(made.space.names) == 21 + 12 + 6
    found = [made.identified(setting) for setting in made.settings]
    assert [len(space.names) for space, _ in found] == [21, 21, 33, 33]
    assert [setting.method for setting in made.settings] == ["two-stage", "joint", "two-stage", "joint"]
    assert [prior is None for _, prior in found] == [True, False, True, False]
    made = study(identification={"model": "dh,harmonics=1-3"})
    (default,) = made.settings
    assert default.method == "joint"
    groups = made.identified(default)[1].groups
    assert groups == ("lengths", "angles", "harmonics=1", "harmonics=2-3")
    assert factor_title("deviation.gravity_mrad_per_m") == "compliance under gravity [mrad/m]"


def test_what_true_arms_do():
    """Coefficients deviate by their own keys, where the true arms have them; they have no bounds."""
    made = study(FAULT | {"model": ["dh", "harmonics=1", "gear"]}, identification={"model": "harmonics=1,gear"})
    names, widths = made.space.names, made.cell_values.width
    expected = {"cos1_2": 20 * aj.units.ARCSEC, "gear_3": 1e-4, "d_3": 1.0}
    for name, width in expected.items():
        kind = {"cos1_2": 1, "gear_3": 2}.get(name)
        np.testing.assert_allclose(
            widths[:, names.index(name)], [width if kind in (None, cell) else 0.0 for cell in range(3)]
        )
    assert np.all(np.isinf(made.cell_values.upper[:, names.index("cos1_2")]))


def test_arm_files_with_corrections_and_priors(tmp_path, paper_arm):
    """They are the truth about which arms deviate, the start and the prior; a model of a cell is in their place."""
    nominal = aj.kinematics.ArmSpecification(with_corrections(paper_arm, "gear").replace(gear_2=1e-3), "a")
    (tmp_path / "a.toml").write_text(specification_toml(nominal) + "\n[priors]\nsd = { gear = 2e-3 }\n")
    own = study({"gear_ppm": 100}, arm=str(tmp_path / "a.toml"))
    (setting,) = own.settings
    space, prior = own.identified(setting)
    assert prior.groups == ("gear",)
    assert float(space.vector()[space.names.index("gear_2")]) == 1e-3
    assert float(own.space.vector()[own.space.names.index("gear_2")]) == 1e-3
    other = study({"gear_ppm": 100}, arm=str(tmp_path / "a.toml"), identification={"model": "dh", "prior": "none"})
    space, _ = other.identified(other.settings[0])
    assert "gear_2" not in space.names
    assert float(space.base.coefficients[1]) == 0.0
    assert own.digest != other.digest


MESSAGES = {
    "unknown model": ({}, {"model": "harmonic"}, "identification.model: unknown model 'harmonic'; did you mean"),
    "unknown truth": (FAULT | {"model": "grvity"}, {}, "deviation.model: unknown model 'grvity'"),
    "no such coefficient": (
        {"gear_ppm": 100},
        {"model": "harmonics=1"},
        "deviation.gear_ppm applies to coefficients that",
    ),
    "two stages": ({}, {"model": "gear", "method": "two-stage"}, "identification.method is 'two-stage', which ignores"),
    "prior": ({}, {"prior": "lenghts=1mm"}, "identification.prior: the prior names 'lenghts'"),
    "empty": ({}, {"model": " "}, "identification.model: a model is empty"),
}


@pytest.mark.first_rows(4)
@pytest.mark.parametrize("case", MESSAGES)
def test_refused(case):
    deviation, identification, message = MESSAGES[case]
    with pytest.raises(aj.InputError, match=message):
        study(deviation, identification=identification)


@pytest.mark.slow
def test_readings_are_those_of_the_corrected_joints(paper_arm):
    """By three arms at once: with its corrections each has its tip where the plain one has it at other readings."""
    arm = with_corrections(paper_arm, "harmonics=1-4,gear,gravity")
    random = np.random.default_rng(0)
    coefficients = random.normal(size=(3, len(arm.coefficients))) * 1e-4 / 3
    arms = [arm.replace(coefficients=row) for row in coefficients]
    q = random.uniform(-1, 1, (6, 3, 5))
    geometry = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(one.geometry._replace(corrections=None) for one in arms)
    )
    found = np.asarray(_read_where(geometry, arm.geometry.corrections, jnp.asarray(q)))
    assert np.abs(found - q).max() > 1e-5
    for i, one in enumerate(arms):
        tips = one.position(found[:, i].T)
        np.testing.assert_allclose(tips, paper_arm.position(q[:, i].T), atol=1e-9)


@pytest.mark.slow
def test_poses_of_a_recording_are_taken_by_the_corrected_arm(paper_arm):
    """A tracker sees the tips of the true arm, but for its noise, where the recording had them; without compiling."""
    box = [[200, -300, 100], [600, 300, 500]]
    points = [kinds.SimulatedPoints("T", box, 40, (0.1, 0.2, 0.3, 1e3, 2e3, -3e2), u=0.01)]
    capture = aj.simulate(paper_arm, {}, observations=points, noise=aj.Noise())
    made = study(FAULT, capture, None, arm=paper_arm, noise={}, identification={"model": "harmonics=1,gear"})
    assert made.settings[0].method == "joint"
    drawn, captures = draw_trials(made, 0, np.arange(2))
    (batch,) = captures.observations
    for i in range(2):
        true = made.space.arm(drawn.true[i])
        one = jax.tree.map(lambda leaf, i=i: leaf[i], batch)
        seen = aj.Capture({}, [], [one])
        assert float(aj.evaluate(true, seen).observed.rms[0]) < 0.03  # the tracker's noise
        assert float(aj.evaluate(paper_arm, seen).observed.rms[0]) > 0.1


@pytest.mark.slow
def test_the_right_model_finds_the_coefficients(tmp_path):
    """And Denavit-Hartenberg parameters alone do not; what a cell does not identify is 0 there, and not listed. The
    study stops and goes on like others, and its file says what was asked."""
    made = study(identification={"model": ["dh", "harmonics=1,gear"]})
    plain, right = (run_block(made, Block(cell, cell + 1, 0, 16)) for cell in (0, 1))
    assert plain["converged"].all()
    assert right["converged"].all()
    assert right["de"].mean() < 0.3 * plain["de"].mean()
    assert right["length_error"].mean() < 0.5 * plain["length_error"].mean()
    i = made.space.names.index("cos1_2")
    assert not plain["estimate"][0, :, i].any()
    assert np.abs((right["estimate"] - right["true"])[0, :, i]).max() < 0.3 * np.abs(right["true"][0, :, i]).max()
    path = tmp_path / "study.h5"
    outcome = aj.study.run_study(made, path, chunk=8)
    assert outcome.finished
    results = aj.study.Results.of(path)
    assert results.study == made
    np.testing.assert_array_equal(results.column("de", 1), right["de"][0])
    rows = [{row["parameter"]: row["unit"] for row in cell_summary(results, cell)["parameters"]} for cell in (0, 1)]
    assert "cos1_2" not in rows[0]
    assert (rows[1]["cos1_2"], rows[1]["gear_3"]) == ("rad", "1")


@pytest.mark.slow
def test_stage_one_with_a_prior_does_not_see_the_lengths():
    """Where a prior sets the scale it is the prior's, whatever the lengths say."""
    made = study({}, identification={"method": "stage1", "prior": "lengths=0.5mm", "hold": "none"})
    drawn, _ = draw_trials(made, 0, np.arange(16))
    found = run_block(made, Block(0, 1, 0, 16))
    assert found["converged"].all()
    assert np.isnan(found["scale_error"]).all()
    assert 1e-4 < np.std(found["scale"][0] - 1) < 1e-2
    np.testing.assert_array_equal(found["true"][0], drawn.true)
