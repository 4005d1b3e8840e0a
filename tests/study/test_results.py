"""Results of a study: standard errors that are true, tables, plots, labelled data."""

import json
from functools import partial

import matplotlib
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.study.results import distribution, statistic
from aacmm_jax.study.tables import level_title
from tests.conftest import SLOW
from tests.refusals import assert_refused
from tests.written_study import write_study

from .small_study import CHUNK, NOISE, REFERENCE, begun, made

matplotlib.use("Agg")
TRIALS = 24


@pytest.fixture(scope="module")
def small():
    return made(
        name="a study",
        trials=TRIALS,
        seed=5,
        noise=NOISE,
        reference=REFERENCE | {"u_mm": 0.002},
        bounds={"length_mm": [0.5, 5], "length_shift_mm": [0, 1]},
    )


@pytest.fixture(scope="module")
def path(small, tmp_path_factory):
    """Of results that were drawn."""
    path = tmp_path_factory.mktemp("results") / "study.h5"
    write_study(path, small)
    return path


@pytest.fixture(scope="module", params=SLOW)
def computed(small, tmp_path_factory):
    path = tmp_path_factory.mktemp("computed") / "study.h5"
    aj.study.run_study(small, path, chunk=CHUNK)
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "names", "says"),
    [
        (1e300, ("scale", "estimate"), "impossibly large"),
        (np.inf, ("scale", "estimate"), "a trial that converged has an infinite result"),
        (-np.inf, ("scale", "true"), "a trial that converged has an infinite result"),
        (np.nan, ("estimate",), "a trial that converged has a parameter whose value is not a number"),
    ],
)
def test_results_that_no_trial_has_are_refused(path, monkeypatch, value, names, says):
    """As from a file that was edited, with its digests made anew."""
    results, rows_of = aj.study.Results.of(path), aj.study.Results.rows

    def edited(*arguments, failed=False):
        for part, rows in rows_of(*arguments):
            rows = {key: np.full_like(x, value) if key in names else x for key, x in rows.items()}
            yield part, rows | ({"converged": np.zeros_like(rows["converged"])} if failed else {})

    monkeypatch.setattr(aj.study.Results, "rows", edited)
    for name in names:
        assert_refused(partial(results.column, name, 0), says)
    assert_refused(lambda: list(results.errors(0)), says)
    if not np.isfinite(value):  # which a trial that failed may have
        monkeypatch.setattr(aj.study.Results, "rows", lambda *arguments: edited(*arguments, failed=True))
        assert not np.isfinite(results.column(names[0], 0)).any()


def test_a_cell_that_a_study_has_not_is_refused(path):
    assert_refused(lambda: aj.plot.study_correlation(aj.study.Results.of(path), 0), "cells 1 to 4")


def test_percentiles_are_numpys():
    values = np.random.default_rng(0).normal(size=101)
    found = distribution(values, np.arange(101) % 32)
    np.testing.assert_allclose(
        [found[f"p{q}"]["value"] for q in (5, 50, 95)], np.percentile(values, (5, 50, 95)), rtol=1e-14
    )


@pytest.fixture(scope="module")
def summary(computed):
    return aj.study.study_summary(aj.study.Results.of(computed))


STATISTICS = {
    "mean": (np.mean, lambda n: 1 / n**0.5),
    "spread": (lambda x: np.std(x, ddof=1 if len(x) > 1 else 0), lambda n: 1 / (2 * n) ** 0.5),
    "median": (np.median, lambda n: (np.pi / 2 / n) ** 0.5),
    "95 %": (lambda x: np.percentile(x, 95), lambda n: (0.95 * 0.05 / n) ** 0.5 / 0.10314),
}


@pytest.mark.first_rows(5)
@pytest.mark.parametrize("name", STATISTICS)
@pytest.mark.parametrize("count", [200, 1000, 6400])
def test_standard_errors_are_those_of_theory(name, count):
    """Normal trials, whose statistics' standard errors are known; over repeated studies, in the root mean square."""
    function, theory = STATISTICS[name]
    generator = np.random.default_rng(count)
    repeats = 60 if count < 6400 else 20
    found = [statistic(function, generator.normal(size=count), np.arange(count) % 32)["se"] for _ in range(repeats)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(theory(count), rel=0.2)


def test_standard_errors_hold_what_a_group_shares():
    """Trials of one pool that err together: the scatter between groups shows it, that between trials would not."""
    generator = np.random.default_rng(0)
    groups = np.arange(6400) % 32
    found = [
        statistic(np.mean, generator.normal(size=6400) + 0.3 * generator.normal(size=32)[groups], groups)["se"]
        for _ in range(20)
    ]
    assert np.mean(found) == pytest.approx((1 / 6400 + 0.09 / 32) ** 0.5, rel=0.1)


@pytest.mark.first_rows(3)
@pytest.mark.parametrize("name", STATISTICS)
@pytest.mark.parametrize("count", [640, 6400])
def test_standard_errors_where_groups_differ_are_those_of_repetition(name, count):
    """Half of the variance is between groups: against the scatter of the statistic itself over 300 repeated studies."""
    function, generator, groups = STATISTICS[name][0], np.random.default_rng(count), np.arange(count) % 32
    studies = [generator.normal(size=count) + generator.normal(size=32)[groups] for _ in range(300)]
    found = [statistic(function, values, groups)["se"] for values in studies[:60]]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(
        np.std([function(values) for values in studies]), rel=0.25
    )


@pytest.mark.slow
def test_boxes_say_what_is_pooled(path):
    title = aj.plot.study_distributions(aj.study.Results.of(path), "bounds.length_mm").get_suptitle()
    assert title.endswith("trials pooled over all levels of: shift of the centre, lengths [mm]")


@pytest.mark.parametrize(
    ("name", "level", "text"),
    [
        ("bounds.length_mm", 10.0, "half-width of lengths 10 mm"),
        ("capture.poses", 20, "poses per socket 20"),
        ("noise.encoder_arcsec", 2.0, "encoder noise 2 arcsec"),
        ("deviation.angle_deg", 0.1, "deviation of angle 0.1 deg"),
        ("identification.method", "joint", "method joint"),
    ],
)
def test_factors_are_named_in_words(name, level, text):
    assert level_title(name, level) == text


@pytest.mark.slow
def test_summary_says_what_the_arrays_say(computed, summary):
    data = aj.study.open_study(computed)
    assert summary["factors"] == {"bounds.length_mm": [0.5, 5.0], "bounds.length_shift_mm": [0.0, 1.0]}
    assert summary["trials_run"] == 4 * TRIALS
    cell = summary["results"][3]
    assert cell["factors"] == {"bounds.length_mm": 5.0, "bounds.length_shift_mm": 1.0}
    picked = data.sel(bounds_length_mm=5.0, bounds_length_shift_mm=1.0).squeeze()
    for name in ("k", "de", "length_error", "angle_error_stage1"):
        figure = cell["figures"][name]
        assert figure["mean"]["value"] == pytest.approx(picked[name].values.mean(), rel=1e-12)
        assert figure["spread"]["value"] == pytest.approx(picked[name].values.std(ddof=1), rel=1e-9)
        assert figure["p95"]["value"] == pytest.approx(np.percentile(picked[name].values, 95), rel=1e-12)
    error = (picked.estimate - picked.true).values
    for i, row in enumerate(cell["parameters"]):
        assert row["parameter"] == str(picked.parameter.values[i])
        assert row["bias"]["value"] == pytest.approx(error[:, i].mean(), abs=1e-15)
        assert row["spread"]["value"] == pytest.approx(error[:, i].std(ddof=1), rel=1e-6)
    narrow = summary["results"][1]  # +-0.5 mm about a centre 1 mm off: the truth is never inside
    assert narrow["truth_inside"]["value"] == 0
    assert narrow["on_a_bound"]["value"] == 1
    assert cell["converged"] == {"value": 1, "se": None}  # no scatter seen is not certainty


@pytest.mark.slow
def test_the_method_is_right(summary):
    """Within wide bounds the scale fix leaves no bias, and every parameter's bias is within its standard error."""
    cell = summary["results"][2]
    scale = cell["figures"]["scale_error"]["mean"]
    assert abs(scale["value"]) < 4 * scale["se"]
    pulls = [row["bias"]["value"] / row["bias"]["se"] for row in cell["parameters"]]
    assert np.max(np.abs(pulls)) < 5
    assert (
        cell["figures"]["length_error"]["p50"]["value"] < 0.1 * cell["figures"]["length_error_stage1"]["p50"]["value"]
    )


@pytest.mark.slow
def test_labelled_data(path):
    data = aj.study.open_study(path)
    assert data.estimate.dims == ("cell", "trial", "parameter")
    grid = data[["k", "length_error"]].unstack("cell")
    assert grid.sizes == {"trial": TRIALS, "bounds_length_mm": 2, "bounds_length_shift_mm": 2}
    assert data.length_error.attrs["units"] == "mm"
    assert data.attrs["seed"] == 5
    assert data.attrs["finished"]


def test_levels_that_differ_little_are_told_apart():
    points = [[[400, 200, 300]], [[400.0001, 200, 300]]]
    study = aj.study.make_study(arm="cheng2018-simulation", trials=1, capture={"positions_mm": points})
    assert study.factors == {"capture.positions_mm": ["((400, 200, 300))", "((400.0001, 200, 300))"]}


@pytest.mark.slow
def test_a_study_that_has_just_begun_is_shown(aacmm, study, tmp_path):
    begun(tmp_path / "s.h5", study, 1000)
    assert "No trial has ended yet" in aacmm("show", "s.h5", "--figures", "f").stdout
    assert "No trial has ended yet" in aacmm("show", "s.h5", "--cell", 3).stdout


@pytest.mark.slow
def test_the_terminal_shows_all_of_it(path, aacmm):
    done = aacmm("show", path)
    assert f"a study of Cheng 2018, simulated arm: 4 cells of {TRIALS} trials, seed 5" in done.stdout
    for heading in ("converged", "on a bound", "Deltam", "angle", "95 %"):
        assert heading in done.stdout
    one = aacmm("show", path, "--cell", 2)
    assert "Errors of the parameters" in one.stdout
    assert "probe_z" in one.stdout
    machine = json.loads(aacmm("show", path, "--cell", 1, "--json").stdout)
    assert machine["results"][0]["figures"]["de"]["mean"]["se"] > 0
    assert "no cell 5; choose a cell from 1 to 4" in aacmm("show", path, "--cell", 5, expect=2).stderr


@pytest.mark.slow
def test_every_figure_is_drawn(path, aacmm, tmp_path):
    aacmm("show", path, "--figures", "figures")
    assert {item.name for item in (tmp_path / "figures").iterdir()} == {
        "convergence.png",
        "correlation.png",
        "distributions_bounds_length_mm.png",
        "distributions_bounds_length_shift_mm.png",
        "error_against_bounds_length_mm.png",
        "k_against_bounds_length_shift_mm.png",
    }


@pytest.mark.first_rows(9)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("-o", "s.h5"), "name a specification, or use --resume"),
        (("--resume", "-o", "s.h5"), "s.h5 does not exist, so there is nothing to resume; leave out --resume"),
        (
            ("bound-sensitivty", "-o", "s.h5"),
            "neither a file nor a study that ships with the package; did you mean 'bound-sensitivity'",
        ),
        (("spec.toml", "-o", "s.h5"), "spec.toml: unknown key 'nose'; did you mean 'noise'"),
        (("empty.toml", "-o", "s.h5"), "empty.toml: 'trials' is missing; add it"),
        (("noise", "-o", "s.h5", "--seed", 10**25), "noise: 'seed' must be"),
        (("x" * 300, "-o", "s.h5"), "neither a file nor a study that ships"),
        (("none.toml", "-o", "s.h5"), "none.toml does not exist; check the path"),
        (("noise", "-o", "no/folder/s.h5"), "cannot be written: no such file or directory"),
        (("noise", "-o", "."), "it is a folder"),
        (("noise", "-o", "x" * 300), "name too long"),
        (("--resume", "-o", "x" * 300), "nothing to resume"),
        (("noise", "-o", "s.h5", "--shards"), "--shards applies to the workers of a Dask cluster only"),
    ],
    ids=str,
)
def test_the_command_refuses_in_one_sentence(aacmm, tmp_path, arguments, message):
    (tmp_path / "spec.toml").write_text('arm = "panda"\ntrials = 1\n[capture]\npositions_mm = [[1, 2, 3]]\n[nose]\n')
    (tmp_path / "empty.toml").write_text('arm = "panda"\n[capture]\npositions_mm = [[1, 2, 3]]\n')
    done = aacmm("study", *arguments, expect=2)
    assert message in done.stderr
    assert done.stderr.startswith("Error: ")
    assert done.stderr.count("\n") == 1
    assert {item.name for item in tmp_path.iterdir()} == {"spec.toml", "empty.toml"}
