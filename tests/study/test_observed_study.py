"""Studies of captures with observations: recorded, or simulated with a kit; trials are what calibrations show."""

import h5py
import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data import observations as kinds
from aacmm_jax.model.observed import Observed
from aacmm_jax.model.rows import rows_at
from aacmm_jax.study.blocks import Block
from aacmm_jax.study.results import study_summary
from aacmm_jax.study.trials import _recorded, draw_trials, run_block

from ..calibration.test_observed import BOX, FRAME, NOISE, SIMULATED

FREE = ("a_2", "a_3", "d_4", "theta_2", "theta_3")
LEVELS = {"encoder_arcsec": [2.0], "seating_mm": 0.005}
DEVIATION = {"length_mm": 1.0, "angle_deg": 0.1}
KIT = """
[[touched_sphere]]
name = "ball"
centre = [500, 200, 200]
diameter = 50.0
u = 0.001
poses = 15
"""


@pytest.fixture(scope="module")
def held(paper_arm):
    names = ("alpha", "a", "d", "theta")
    every = [f"{kind}_{i}" for kind in names for i in range(1, 7)] + ["probe_x", "probe_y", "probe_z"]
    return [name for name in every if name not in FREE]


@pytest.fixture(scope="module")
def capture(paper_arm):
    sphere = kinds.SimulatedSphere("ball", (500, 200, 200), 50.0, 15, u=0.001)
    return aj.simulate(paper_arm, {}, observations=[sphere], noise=NOISE, seed=1)


def made(paper_arm, held, capture, trials=48, **tables):
    tables = {"deviation": DEVIATION, "noise": LEVELS, "identification": {"held": held}} | tables
    return aj.study.make_study(arm=paper_arm, trials=trials, capture=capture, seed=3, **tables)


@pytest.mark.slow
def test_trials_scatter_as_a_calibration_says(paper_arm, held, capture):
    """True arms differ by the deviation, results by u; a trial does not depend on the block that it is in."""
    study = made(paper_arm, held, capture)
    assert study.settings[0].method == "joint"
    found = run_block(study, Block(0, 1, 0, 48))
    assert np.all(found["converged"])
    assert np.all(found["truth_inside"])
    assert np.all(np.isnan(found["k"]))
    true, nominal = found["true"][0], np.asarray(study.space.vector())
    assert 0.1 < np.abs(true - nominal)[:, :3].max() <= 1.0
    result = aj.calibrate(paper_arm, capture, aj.Bounds.around(paper_arm, study.space), noise=NOISE)
    ratio = (found["estimate"][0] - true) / np.sqrt(np.diag(result.covariance))
    np.testing.assert_allclose(np.sqrt(np.mean(ratio**2, axis=0)), 1.0, atol=0.45)
    part = run_block(study, Block(0, 1, 20, 29))
    for name, values in part.items():
        np.testing.assert_allclose(values, found[name][:, 20:29], rtol=1e-9, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize(
    "which", [slice(3, 4), pytest.param(slice(None), marks=pytest.mark.exhaustive)], ids=["sphere", "all"]
)
def test_without_errors_every_arm_agrees_with_its_data(paper_arm, held, which):
    """Exact trials of every kind have no residual by the true arm, so the true arm is what is found."""
    simulated = [
        kinds.SimulatedSocket("hole", (400, 100, 300), 4),
        kinds.SimulatedPoints("tracker", BOX, 5, FRAME),
        kinds.SimulatedTransforms("T6", BOX, 5, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u_angle=1e-12),
        kinds.SimulatedSphere("ball", (300, 0, 300), 50.0, 5),
        kinds.SimulatedPlanes("wall", (300, -200, 100), [(0, 300, 0), (0, 0, 400)], 5),
        kinds.SimulatedArtefact("bar", SIMULATED["bars"][0].points, 3, (0, 0, 0, 300, 0, 200)),
        kinds.SimulatedDistances("d", BOX, 6, (900, 300, 100)),
    ]
    capture = aj.simulate(
        paper_arm, {"A": (400, 200, 300)}, poses=4, observations=simulated[which], noise=aj.Noise(), seed=2
    )
    study = made(paper_arm, held, capture, noise={})
    drawn, batch = draw_trials(study, 0, [0, 7])
    space, batch = to_numpy((study.space, batch))  # NumPy compiles nothing
    for number in range(2):
        one = jax.tree.map(lambda leaf, number=number: leaf[number], batch)
        z = np.concatenate([drawn.true[number], _recorded(study).geometry])
        for rows in rows_at(space, Observed.of(one, study.nominal.arm), z).rows:
            assert np.abs(rows.values).max() < 1e-9
        # What one configuration can follow, it does: only transforms ask for six things at once.
        assert all(np.abs(one.shift).max() < 1e-3 for one in one.observations if one.kind != "transforms")
    assert np.abs(drawn.true[0] - drawn.true[1]).max() > 1e-3


@pytest.mark.slow
def test_a_study_with_a_kit(paper_arm, held, tmp_path):
    """From TOML to a file and its summary; cells differ in noise."""
    (tmp_path / "kit.toml").write_text(KIT)
    (tmp_path / "study.toml").write_text(
        'name = "ball"\narm = "cheng2018-simulation"\ntrials = 16\nseed = 3\n[capture]\nkit = "kit.toml"\n'
        "[deviation]\nlength_mm = 1.0\nangle_deg = 0.1\n[noise]\nencoder_arcsec = [1, 8]\n"
        f"[identification]\nheld = {held}\n".replace("'", '"')
    )
    study = aj.study.read_study(tmp_path / "study.toml")
    assert study.capture is not None
    assert study.capture.observations[0].name == "ball"
    outcome = aj.study.run_study(study, tmp_path / "s.h5", workers=1)
    assert outcome.finished
    results = aj.study.Results.of(tmp_path / "s.h5")
    assert results.study == study
    summary = study_summary(results)
    assert summary["kind"] == "study"
    assert aj.study.run_study(study, tmp_path / "s.h5", workers=1).ran == 0
    with h5py.File(tmp_path / "s.h5") as file:
        estimate, true, done = (np.asarray(file[f"trials/{name}"]) for name in ("estimate", "true", "converged"))
    assert np.all(done == 1)
    errors = estimate - true
    few, many = errors.std(axis=1)
    assert np.all(many > 1.5 * few)
    other = aj.study.make_study(
        arm="cheng2018-simulation", trials=16, capture={"kit": str(tmp_path / "kit.toml")}, seed=4,
        deviation=DEVIATION, identification={"held": held},
    )  # fmt: skip
    assert other != study


@pytest.mark.parametrize(
    ("tables", "text"),
    [
        (
            {"identification": {"method": "two-stage"}},
            "are solved in one step, because they fix the scale; use 'joint'",
        ),
        (
            {"reference": {"length_mm": 300, "region": {"distance_mm": [300, 900]}}},
            "already contains its reference lengths",
        ),
        ({"identification": {}}, "15 equations|more poses"),
    ],
)
def test_refused(paper_arm, held, capture, tables, text):
    with pytest.raises(aj.InputError, match=text):
        made(paper_arm, held, capture, **tables)


def test_a_kit_brings_its_poses(paper_arm, tmp_path):
    (tmp_path / "kit.toml").write_text(KIT)
    with pytest.raises(aj.InputError, match="poses applies to generated poses, but kit already states the poses"):
        aj.study.make_study(arm=paper_arm, trials=4, capture={"kit": str(tmp_path / "kit.toml"), "poses": 3})
