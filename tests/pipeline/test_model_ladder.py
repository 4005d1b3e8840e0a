"""Models of joints compared: predictions of regions against calibrations without them, and which model is found."""

from inspect import unwrap  # calls a function without its run-time types
from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.prediction import unseen_errors
from aacmm_jax.calibration.record import record_of
from aacmm_jax.data import observations as kinds
from aacmm_jax.data.recording import Recording
from aacmm_jax.diagnostics.equations import equations_of
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline import automatic
from aacmm_jax.pipeline.cross_validation import UnseenRegion, _dense, regions_of, unseen_regions
from aacmm_jax.pipeline.model_ladder import (
    DEFAULT_MODELS,
    ComparedModel,
    ComparedModels,
    compare_models,
    default_models,
    log_evidence,
)
from aacmm_jax.pipeline.single import with_joint_model
from aacmm_jax.summaries.compared_models import compared_models_summary, model_tables

NOISE = aj.Noise(encoder_arcsec=10, seating=0.02)
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
BOX = [[200, -300, 100], [600, 300, 500]]
MODELS = ("dh", "gravity", "harmonics=1")


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters.independent(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


def seen_by_a_tracker(paper_arm, space, model="dh", poses=50, seed=1, **coefficients):
    true = with_corrections(aj.perturbed_arm(space, length=0.3, angle=5e-4, seed=seed), model).replace(**coefficients)
    points = [kinds.SimulatedPoints("T", BOX, poses, FRAME, u=0.01)]
    return aj.simulate(true, {}, observations=points, noise=NOISE, seed=seed)


def sockets(paper_arm, space):
    true = aj.perturbed_arm(space, length=0.3, angle=5e-4, seed=1)
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300), "D": (450, 0, 400)}
    return aj.simulate(true, points, poses=14, lengths=[("A", "B", 0.002)], noise=NOISE, seed=2)


@pytest.mark.slow
def test_a_region_is_predicted_as_by_a_calibration_without_it(paper_arm, space, bounds):
    """Of sockets, whose positions only the region shows, and a reference length between two of them."""
    capture, prior = sockets(paper_arm, space), aj.Prior({"lengths": 0.3, "angles": 5e-4})
    solving = {"noise": NOISE, "prior": prior, "undetermined": "ignore"}
    record = record_of(
        aj.calibrate(paper_arm, capture, bounds, **solving), Recording(capture, ArmSpecification(paper_arm))
    )
    for names in (("A", "B"), ("C",)):
        left = np.isin(np.array(capture.names)[capture.owner], names)
        (found,) = unseen_regions(record, {"": left})
        rest = aj.Capture(
            {name: q for name, q in capture.sockets.items() if name not in names},
            [] if "A" in names else capture.lengths,
        )
        alone = aj.identify(paper_arm, rest, bounds, noise=NOISE, prior=prior, hold=None)
        part = aj.Capture({name: capture.sockets[name] for name in names})
        expected = unseen_errors(aj.uncertainty_of(alone), part).of(names)
        assert found.poses == len(names) * 14
        assert np.sqrt(found.mean_square) == pytest.approx(expected.rms, rel=5e-3)
        assert np.sqrt(found.ratio) == pytest.approx(expected.rms / expected.predicted, rel=0.1)


@pytest.mark.slow
def test_half_of_a_travel_is_predicted_as_by_a_calibration_without_it(paper_arm, space, bounds):
    """The frame of the tracker is known from the other half."""
    capture, prior = seen_by_a_tracker(paper_arm, space), aj.Prior({"lengths": 0.3, "angles": 5e-4})
    solving = {"noise": NOISE, "prior": prior, "undetermined": "ignore"}
    result = aj.calibrate(paper_arm, capture, bounds, **solving)
    label, region = list(regions_of(capture).items())[3]
    assert label == "joint 2, upper half"
    (found,) = unseen_regions(record_of(result, Recording(capture, ArmSpecification(paper_arm))), {label: region})
    (points,) = capture.observations
    parts = [aj.Capture({}, [], [points.select(np.flatnonzero(which))]) for which in (~region, region)]
    alone = aj.calibrate(paper_arm, parts[0], bounds, **solving)
    errors = aj.evaluate(alone.arm, parts[1], geometry=alone.stage1.observed.geometry).observed
    assert found.poses == 25
    assert np.sqrt(found.mean_square) == pytest.approx(float(errors.rms[0]), rel=1e-3)


@pytest.mark.slow
def test_nothing_wrong_needs_no_correction(paper_arm, space, bounds):
    found = compare_models(paper_arm, seen_by_a_tracker(paper_arm, space), bounds, models=MODELS)
    assert found.recommended.model == "dh"
    assert [len(model.regions) for model in found.models] == [12, 12, 12]
    assert 0.6 < found.recommended.ratio < 1.5


@pytest.mark.slow
def test_an_eccentric_encoder_is_recognised(paper_arm, space, bounds):
    """Also in an arm that comes with other corrections, which do not count."""
    capture = seen_by_a_tracker(paper_arm, space, "harmonics=1", cos1_2=4e-4, sin1_2=-3e-4)
    found = compare_models(with_corrections(paper_arm, "gear"), capture, bounds, models=MODELS)
    chosen = found.recommended
    assert chosen.model == "harmonics=1"
    assert found.models[0].rms_outside > 1.2 * chosen.rms_outside
    assert "gear_2" not in chosen.result.space.names
    # Mean and cosine of the second joint are hardly apart, as its travel is short; its sine is found.
    names = chosen.result.space.names
    u = np.sqrt(np.diag(chosen.result.covariance))
    for name, true in (("cos1_2", 4e-4), ("sin1_2", -3e-4)):
        i = names.index(name)
        assert abs(float(chosen.result.parameters[i]) - true) < 3 * u[i]


@pytest.mark.slow
def test_a_model_by_name_is_a_corrected_arm_with_its_prior(paper_arm, space, bounds):
    """In one line what takes four; in place of other corrections, and with the prior that is given instead."""
    capture = seen_by_a_tracker(paper_arm, space, "harmonics=1", cos1_2=4e-4)
    arm = with_corrections(paper_arm, "harmonics=1")
    names = (*space.names, *(name for name in aj.kinematics.parameter_names(arm) if name[:3] in ("cos", "sin")))
    own = aj.Parameters(arm, names)
    box = [np.concatenate([side, np.full(12, end)]) for side, end in ((bounds.lower, -np.inf), (bounds.upper, np.inf))]
    options = {"undetermined": "ignore"}
    expected = aj.calibrate(arm, capture, aj.Bounds(own, *box), prior=aj.kinematics.default_prior(arm), **options)
    found = aj.calibrate(with_corrections(paper_arm, "gear"), capture, bounds, model="dh,harmonics=1", **options)
    np.testing.assert_array_equal(found.parameters, expected.parameters)
    assert (found.space.names, found.prior.groups) == (names, ("lengths", "angles", "harmonics=1"))
    tight = aj.calibrate(paper_arm, capture, bounds, model="harmonics=1", prior=aj.Prior({"all": 1e-4}), **options)
    assert tight.prior.groups == ("all",)
    plain = aj.calibrate(paper_arm, capture, model="dh", **options)
    assert plain.prior is None
    assert plain.space.names == aj.Parameters.independent(paper_arm).names
    for model, message in (("grvity", "did you mean 'gravity'"), (5, "the model is 5; give a text")):
        with pytest.raises(aj.InputError, match=message):
            unwrap(with_joint_model)(paper_arm, capture, bounds, model, None)


def test_placements_are_the_regions_where_there_are_several(paper_arm, space):
    capture = sockets(paper_arm, space)
    assert [*regions_of(capture)] == ["A, B", "C", "D"]
    assert [*regions_of(capture, ["A", "[BC]"])] == ["A", "[BC]"]
    assert regions_of(capture, ["A", "[BC]"])["[BC]"].sum() == 28
    with pytest.raises(aj.InputError, match="no data are left to calibrate from"):
        regions_of(capture, ["*"])
    with pytest.raises(aj.InputError, match="fewer than two"):
        regions_of(capture, ["A"])


@pytest.mark.parametrize(
    ("squares", "evidence", "expected"),
    [
        ([[4.0, 4.1, 4.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]], (0.0, 0.0, 0.0), "b"),
        # However probable, a model that regions exclude is not recommended. One that is hard for all does not count.
        ([[1.5, 1.6, 13.5], [1.0, 1.0, 13.0], [1.0, 1.0, 13.0]], (50.0, 0.0, 0.0), "b"),
        # Nor one that is richer than the best.
        ([[4.0, 4.1, 4.0], [1.0, 1.0, 1.0], [1.0, 1.1, 1.0]], (0.0, 0.0, 50.0), "b"),
        # 0.1 on average, with a standard error of 0.06 from three regions: Student's factor is 6.2.
        ([[1.0, 1.1, 13.2], [1.0, 1.0, 13.0], [2.0, 2.0, 14.0]], (0.0, 2.9, 50.0), "a"),
        ([[1.0, 1.1, 13.2], [1.0, 1.0, 13.0], [2.0, 2.0, 14.0]], (0.0, 3.1, 50.0), "b"),
    ],
)
def test_regions_exclude_and_evidence_decides_among_the_others(squares, evidence, expected):
    assert comparison(squares, evidence).recommended.model == expected


def comparison(squares, evidence):
    """Models a, b, ... by their mean square errors in each region."""
    result = SimpleNamespace(converged=True)
    models = []
    for name, values, probable in zip("abc", squares, evidence, strict=False):
        regions = tuple(UnseenRegion(str(i), 10, value, 1.0) for i, value in enumerate(values))
        models.append(ComparedModel(name, 1, 1.0, 0.1, regions, 0.0, result, probable))
    return ComparedModels(tuple(models))


def test_the_difference_of_two_models_is_paired():
    """By hand: mean squares 6 and 4 mm^2, so 2.4495 and 2 mm; their differences 1, 2 and 3 mm^2 have a standard error
    of 1 / sqrt(3), though either scatters twice as much or as much as they do."""
    compared = comparison([[4.0, 6.0, 8.0], [3.0, 4.0, 5.0]], (0.0, 0.0))
    expected = (0.44949, 0.57735 / 4.44949)
    assert compared.excess("a") == pytest.approx(expected, rel=1e-5)
    assert compared.excess("b", over="a") == pytest.approx((-expected[0], expected[1]), rel=1e-5)
    assert compared.excess("b") == (0.0, 0.0)
    assert compared.significant == pytest.approx(4.303, abs=1e-3)  # Student's t of 2 degrees of freedom
    with pytest.raises(aj.InputError, match="'c' is not one of the compared models; name one of a and b"):
        compared.excess("a", over="c")
    rows = compared_models_summary(compared, "arm")["models"]
    assert [(row["excess"], row["u_excess"]) for row in rows] == [compared.excess("a"), (0.0, 0.0)]
    shown = model_tables({"models": rows, "regions": []})[0]
    columns = [shown.headings.index(heading) for heading in ("excess [mm]", "u of excess")]
    assert [shown.cells[0][column].value for column in columns] == pytest.approx(list(expected), rel=1e-5)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(("outside", "taken"), [(0.99, True), (1.02, True), (1.05, False)])
def test_a_model_that_predicts_worse_is_not_taken_by_default(monkeypatch, paper_arm, space, outside, taken):
    """However probable it makes the measurements: three regions cannot tell it from the arm alone."""
    recording = Recording(sockets(paper_arm, space), ArmSpecification(paper_arm))
    record = aj.calibrate_capture(recording, model="dh", automatic=False, cross_validate=False, shared_errors=False)
    result = SimpleNamespace(converged=True, space=SimpleNamespace(base=record.calibrated.arm))

    def compared(*arguments, models, **options):
        squares = {
            "dh": np.ones(3),
            "gravity": outside**2 + np.array([-0.5, 0.0, 0.5]),
            "harmonics=1": np.full(3, 0.97),
        }
        rows = []
        for name, values in squares.items():
            regions = tuple(UnseenRegion("", 10, float(value), 1.0) for value in values)
            evidence = 50.0 * (name == "gravity")
            rows.append(ComparedModel(name, 1, 1.0, 0.1, regions, 0.0, result, evidence))
        return ComparedModels(tuple(row for row in rows if row.model in models or "harmonics=1-6" in models[0]))

    monkeypatch.setattr(automatic, "compare_models", compared)
    options = SimpleNamespace(noise=None, shared_errors=True, stage=lambda what, work: work())
    recorded = lambda found, part: record._replace(recording=part)  # noqa: E731
    chosen = automatic.with_best_model(record, lambda part: result, recorded, options)
    assert (chosen is not record) == taken
    assert any("Model of the joints: gravity" in says for says in chosen.decisions) == taken
    assert any("2 % smaller" in says for says in chosen.decisions) == (outside < 0.985)
    # The squares differ by 1 - outside^2, the roots by 1 - outside; half a unit of scatter over three regions is 0.29.
    says = f"difference {abs(1 - outside):.2g} mm, standard error {0.5 / 3**0.5 / (1 + outside):.2g} mm)"
    assert any(says in sentence for sentence in chosen.decisions) == taken


@pytest.mark.slow
def test_the_bounds_of_a_file_are_those_of_its_models(paper_arm):
    """Without them, a parameter that is far off ends on a bound."""
    true = paper_arm.replace(theta_3=float(paper_arm.theta[2]) + 0.02)
    places = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300), "D": (450, 0, 400)}
    capture = aj.simulate(true, places, poses=14, lengths=[("A", "B", 0.002)], noise=NOISE, seed=2)
    stated = compare_models(ArmSpecification(paper_arm, angle=0.05), capture, models=["dh"])
    around = compare_models(paper_arm, capture, models=["dh"])
    assert stated.models[0].result.active_names() == {}
    assert "theta_3" in around.models[0].result.active_names()


@pytest.mark.slow
def test_a_model_that_the_data_cannot_carry_is_skipped(paper_arm, space, bounds):
    capture, known = sockets(paper_arm, space), []
    compared = compare_models(paper_arm, capture, bounds, models=["dh", "harmonics=1-31"], progress=known.append)
    assert tuple(known) == compared.models
    assert ([model.model for model in compared.models], compared.skipped) == (["dh"], ("harmonics=1-31",))
    warnings = compared_models_summary(compared, "arm")["warnings"]
    assert "Not compared, because the data are too few for them: harmonics=1-31." in warnings
    with pytest.raises(aj.InputError, match="equations"):
        compare_models(paper_arm, capture, bounds, models=["harmonics=1-31"])


def test_the_evidence_is_that_of_a_gaussian(paper_arm, space, bounds):
    """Of two models that differ in one scale alone, by the covariance of the data: B S B^T + 1, all in one matrix."""
    capture, found = sockets(paper_arm, space), []
    for sd in (0.3, 3.0):
        solving = {"noise": NOISE, "prior": aj.Prior({"lengths": sd, "angles": 5e-4}), "undetermined": "ignore"}
        result = aj.calibrate(paper_arm, capture, bounds, **solving)
        record = record_of(result, Recording(capture, ArmSpecification(paper_arm)))
        equations = equations_of(record)
        dense = _dense(equations, len(record.names))
        first = len(dense.relations) - len(record.names)  # row of the prior
        by, of_geometry = np.concatenate([dense.white, dense.relations[:first]]), dense.geometry
        left = np.concatenate([dense.residual, dense.relation_residual[:first]])
        prior = dense.relations[first:, ~of_geometry]
        basis = np.linalg.qr(by[:, of_geometry], mode="complete")[0][:, int(of_geometry.sum()) :]
        by = basis.T @ by[:, ~of_geometry] @ np.linalg.inv(prior)
        covariance = by @ by.T + np.eye(len(by))
        # At the prior's mean, where the residual is what the solution left and what the parameters explain.
        mean = basis.T @ left - by @ dense.relation_residual[first:]
        expected = -0.5 * (mean @ np.linalg.solve(covariance, mean) + np.linalg.slogdet(covariance)[1])
        found.append((log_evidence(equations, record.prior, {}), expected))
    (one, first), (other, second) = found
    assert other - one == pytest.approx(second - first, abs=0.02)


@pytest.mark.slow
def test_refused(paper_arm, space, bounds):
    with pytest.raises(aj.InputError, match="models is empty"):
        compare_models(paper_arm, sockets(paper_arm, space), bounds, models=[])
    with pytest.raises(aj.InputError, match="unknown model 'grvity'"):
        compare_models(paper_arm, sockets(paper_arm, space), bounds, models=["dh,grvity"])


def test_default_models_of_a_capture_with_temperatures(paper_arm, space):
    capture = sockets(paper_arm, space)
    assert default_models(paper_arm, capture) == DEFAULT_MODELS
    warm = {name: np.pad(q, ((0, 0), (0, 1)), constant_values=21.0) for name, q in capture.sockets.items()}
    found = default_models(paper_arm.replace(thermometer=True), aj.Capture(warm))
    assert found[:4] == ("dh", "expansion", "gravity", "gravity,expansion")
    assert len(found) == 2 * len(DEFAULT_MODELS)
