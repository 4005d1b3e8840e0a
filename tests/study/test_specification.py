"""The specification of a study: what is read, and what is refused before any work."""

import inspect

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.study import configuration_pool

CAPTURE = {"positions_mm": [[400, 200, 300]]}


def made(**tables) -> "aj.study.Study":
    make_study = inspect.unwrap(aj.study.make_study)  # refusals as users see them, without the types checked in tests
    return make_study(**{"arm": "cheng2018-simulation", "trials": 4, "capture": CAPTURE} | tables)


def test_lists_make_the_grid():
    study = made(
        bounds={"length_mm": [1, 5], "length_shift_mm": [0, 2, 4]},
        deviation={"length_mm": [0.5, 1.0], "probe_mm": {"normal": 0.1}},
        identification={"hold": ["longest", "none"]},
    )
    assert study.factors == {
        "deviation.length_mm": [0.5, 1.0],
        "bounds.length_mm": [1.0, 5.0],
        "bounds.length_shift_mm": [0.0, 2.0, 4.0],
        "identification.hold": ["longest", "none"],
    }
    assert len(study.cells) == 24
    assert [setting.hold for setting in study.settings[:2]] == ["d_3", None]
    # The last factor varies fastest, the first slowest.
    probe = study.space.index("probe_z")
    d_3 = study.space.index("d_3")
    values = study.cell_values
    assert (values.width[0, d_3], values.width[-1, d_3]) == (0.5, 1.0)
    assert values.normal[:, probe].all()
    assert not values.normal[:, d_3].any()
    centre = (values.lower + values.upper)[:, d_3] / 2
    assert centre[4] - centre[0] == pytest.approx(4.0)
    assert (values.upper - values.lower)[0, d_3] == pytest.approx(2.0)


def test_numpys_numbers_are_numbers():
    study = made(
        noise={"encoder_arcsec": np.array([1, 2.0])}, deviation={"length_mm": np.float32(1), "angle_deg": np.int64(2)}
    )
    assert study.factors == {"noise.encoder_arcsec": [1.0, 2.0]}


def test_a_recorded_capture_takes_any_method(noisy_capture, paper_arm):
    study = made(arm=paper_arm, capture=noisy_capture, identification={"method": ["two-stage", "joint"]})
    assert [setting.method for setting in study.settings] == ["two-stage", "joint"]


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("name", aj.study.shipped_studies())
def test_shipped_studies_are_read(name):
    study = aj.study.read_study(name)
    assert study.factors
    assert f"{len(study.cells)} cells" in (aj.__path__ and _text(name))


def _text(name: str) -> str:
    from importlib import resources

    return (resources.files("aacmm_jax.study") / "shipped_studies" / f"{name}.toml").read_text()


@pytest.mark.slow
def test_what_a_toml_file_names_is_in_its_folder(tmp_path, noisy_capture, paper_arm):
    aj.files.save_arm(paper_arm, tmp_path / "my-arm.toml", name="mine")
    specification = aj.files.load_specification("cheng2018-simulation")
    aj.files.save_capture(tmp_path / "rec.h5", aj.Recording(noisy_capture, specification))
    (tmp_path / "a.toml").write_text('arm = "my-arm.toml"\ntrials = 3\n[capture]\nfile = "rec.h5"\n')
    study = aj.study.read_study(tmp_path / "a.toml")
    assert study.nominal.name == "mine"
    assert study.settings[0].sizes == noisy_capture.sizes
    assert study.settings[0].method == "two-stage"


@pytest.mark.first_rows(11)
@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"nois": {}}, "the study: unknown key 'nois'; did you mean 'noise'"),
        ({"noise": {"encoder_arcse": 1}}, "unknown key 'noise.encoder_arcse'; did you mean 'encoder_arcsec'"),
        ({"noise": {"encoder_arcsec": -1}}, "'noise.encoder_arcsec' must be greater than or equal to 0, not -1"),
        ({"noise": {"encoder_arcsec": [1, -2]}}, "'noise.encoder_arcsec 2' must be greater than or equal to 0, not -2"),
        ({"noise": {"seating_mm": float("nan")}}, "'noise.seating_mm' must be a finite number, not nan"),
        ({"bounds": {"length_mm": []}}, "'bounds.length_mm' has no entries; give at least 1"),
        ({"bounds": {"length_mm": [2, 1, 2]}}, "bounds.length_mm: the value 2 is given twice"),
        ({"bounds": {"override": {"d_33": 1}}}, "bounds.override: unknown parameter 'd_33'"),
        (
            {"bounds": {"length_mm": list(range(1, 200)), "angle_deg": list(range(1, 200))}},
            "has 39,601 cells .*more than 10,000",
        ),
        ({"trials": 0}, "'trials' must be greater than or equal to 1, not 0"),
        ({"trials": 10**8, "bounds": {"length_mm": list(range(101))}}, "101 cells of 100,000,000 trials are more than"),
        ({"seed": -1}, "'seed' must be greater than or equal to 0"),
        ({"capture": {}}, "give exactly one of positions_mm, sockets .* file and kit"),
        ({"capture": {"sockets": 2}}, "sockets at random positions need a region"),
        ({"capture": {"sockets": 2, "region": {"x_mm": [0, 1]}}}, "a region needs distance_mm, or x_mm, y_mm and z_mm"),
        ({"capture": {"sockets": 2, "region": {"distance_mm": [2, 1]}}}, "2 to 1 is not a range"),
        (
            {"capture": CAPTURE | {"poses": 7}},
            "7 poses in 1 socket give 18 equations, but 20 unknowns need at least 8 poses",
        ),
        ({"capture": CAPTURE | {"poses": [70, 7]}}, "need at least 8 poses"),
        ({"capture": CAPTURE | {"poses": 3000}}, "3000 poses per socket are needed, but the pool has"),
        (
            {"capture": {"sockets": 1, "region": {"distance_mm": [300, 900]}, "poses": 100, "pool": 4096}},
            "must contain at least two placements with 100 poses; give at least 8192",
        ),
        ({"trials": 10**9}, "'trials' must be less than or equal to 100000000"),
        ({"capture": CAPTURE | {"pool": 10**9}}, "'capture.pool' must be less than or equal to 16777216"),
        ({"capture": CAPTURE | {"poses": 10**9}}, "'capture.poses' must be less than or equal to 100000"),
        ({"capture": 5}, "capture is a int; give a table"),
        (
            {"capture": CAPTURE | {"joint_limits_deg": [[-10, 10]]}},
            "joint_limits_deg has 1 rows, but the arm has 6 joints",
        ),
        ({"capture": {"file": "a.h5", "poses": 5}}, "a.h5 does not exist"),
        ({"reference": {"u_mm": 0.1}}, "give either length_mm .* or ends_mm"),
        ({"reference": {"length_mm": 300}}, "a reference length at a random position needs a region"),
        ({"reference": {"ends_mm": [[[0, 0, 0], [0, 0, 0]]]}}, "two ends at the same position"),
        ({"identification": {"method": "joint"}}, "need a reference length"),
        (
            {"identification": {"method": "both"}},
            "'identification.method' must be 'stage1', 'two-stage' or 'joint', not 'both'",
        ),
        ({"identification": {"hold": "d_33"}}, "identification.hold: unknown parameter 'd_33'"),
        ({"identification": {"hold": "alpha_1"}}, "which is an angle"),
        ({"identification": {"held": ["x"]}}, "unknown parameter 'x'"),
        ({"deviation": {"length_mm": {"normal": 1, "uniform": 1}}}, "give either uniform .* or normal"),
        (
            {"deviation": {"length_mm": "x"}},
            "'deviation.length_mm' must be a number, . uniform = ... . or . normal = ... ., not 'x'",
        ),
        ({"deviation": {"length_mm": -1}}, "'deviation.length_mm' must be greater than or equal to 0, not -1"),
        ({"arm": "cheng2018"}, "neither a file nor an arm that ships"),
    ],
    ids=str,
)
def test_refused_in_one_sentence(tables, message):
    with pytest.raises(aj.InputError, match=message) as refusal:
        made(**tables)
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_a_narrow_region_is_found(tmp_path):
    """A 300 mm length in a shell 20 mm thick: one candidate in thousands lies inside."""
    region = {"distance_mm": [690, 710]}
    for seed in range(2):
        study = made(
            seed=seed, trials=1, reference={"length_mm": 300, "region": region}, capture=CAPTURE | {"pool": 4096}
        )
        assert aj.study.run_study(study, tmp_path / f"{seed}.h5").finished


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "message"),
    [
        (
            {"capture": {"positions_mm": [[400, 200, 300], [3000, 0, 0]]}},
            r"socket S2 at \(3000, 0, 0\) mm cannot be reached",
        ),
        (
            {"capture": {"sockets": 1, "region": {"distance_mm": [300, 900]}, "poses": 100, "pool": 4096}},
            "must contain at least two placements with 100 poses; give at least 8192",
        ),
        ({"trials": 10**9}, "'trials' must be less than or equal to 100000000"),
        ({"capture": CAPTURE | {"pool": 10**9}}, "'capture.pool' must be less than or equal to 16777216"),
        ({"capture": CAPTURE | {"poses": 10**9}}, "'capture.poses' must be less than or equal to 100000"),
        ({"capture": 5}, "capture is a int; give a table"),
        (
            {"capture": CAPTURE | {"joint_limits_deg": [[-1, 1]] * 6}},
            r"socket S1 at \(400, 200, 300\) mm cannot be reached",
        ),
        pytest.param(
            {"capture": {"sockets": 1, "region": {"distance_mm": [3000, 3100]}}},
            "no position of a socket in its region",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"reference": {"length_mm": 500, "region": {"x_mm": [300, 310], "y_mm": [0, 10], "z_mm": [0, 400]}}},
            "no position of a reference length of 500 mm in its region",
            marks=pytest.mark.slow,
        ),
        (
            {"reference": {"length_mm": 2900, "region": {"distance_mm": [100, 1000]}}},
            "no position of a reference length of 2900 mm in its region",
        ),
    ],
    ids=str,
)
def test_out_of_reach_is_refused_before_work(tmp_path, monkeypatch, tables, message):
    monkeypatch.setattr(configuration_pool, "_ROUNDS", 10)  # none of a hundred would find a placement
    with pytest.raises(aj.InputError, match=message):
        aj.study.run_study(made(**tables), tmp_path / "s.h5")
    assert not list(tmp_path.glob("*.h5*"))
