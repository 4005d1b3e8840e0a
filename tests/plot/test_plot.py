"""Figures: each returns the axes that it was plotted into, and shows the numbers of its record."""

import io

import numpy as np
import pytest
from matplotlib.figure import Figure

import aacmm_jax as aj
from aacmm_jax.plot.drift import _ratio_axis
from tests.refusals import assert_refused
from tests.written_study import write_study


@pytest.fixture(scope="module")
def record():
    nominal = aj.files.load_specification("cheng2018-simulation")
    space = aj.Parameters.free_of(nominal.arm)
    true = aj.perturbed_arm(space, length=1.0, angle=0.002, seed=2)
    capture = aj.simulate(
        true, {"A": (400, 200, 300), "B": (700, 500, 500)}, poses={"A": 40, "B": 12}, lengths=[("A", "B", 0.002)],
        encoder_arcsec=2, seed=2,
    )  # fmt: skip
    result = aj.calibrate(nominal.arm, capture, aj.Bounds.around(nominal.arm, space, length=10.0, angle=0.0175))
    return aj.calibration.record_of(result, aj.Recording(capture, nominal, nominal._replace(arm=true), 2))


@pytest.fixture(scope="module")
def made(record, tmp_path_factory):
    uncertainty = aj.uncertainty_of(record)
    study = aj.study.make_study(
        arm="cheng2018-simulation", trials=4, capture={"positions_mm": [[400, 200, 300]], "poses": 20},
        noise={"encoder_arcsec": [2, 4]}, identification={"method": "stage1"},
    )  # fmt: skip
    path = tmp_path_factory.mktemp("plot") / "study.h5"
    write_study(path, study)
    arm, capture = record.calibrated.arm, record.recording.capture
    sockets = {name: np.asarray(arm.position(q)) for name, q in capture.sockets.items()}

    return {
        "pose_distances": (record,),
        "length_parameter_errors": (record,),
        "parameter_changes": (record,),
        "reference_length_errors": (record,),
        "volumetric_uncertainty_map": (aj.volumetric_uncertainty(uncertainty, points=30),),
        "correlation_matrix": (uncertainty,),
        "singular_values": (aj.observability(arm, capture, aj.Parameters(arm, record.names)),),
        "acceptance_metrics": (
            aj.acceptance.run(aj.acceptance.Measured(sockets), {"Deltam": aj.acceptance.Limit(0.05)}),
        ),
        "study_metric": (aj.study.Results.of(path), "de_stage1"),
    }


FIGURES = [
    "pose_distances", "length_parameter_errors", "parameter_changes", "reference_length_errors",
    "volumetric_uncertainty_map", "correlation_matrix", "singular_values", "acceptance_metrics", "study_metric",
]  # fmt: skip


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("unit", "count"), [("mm", 15 + 8 + 25 + 12 + 16 + 16), ("standard deviations", 92), ("deg", 25)]
)
def test_residuals_of_observations(observed_record, unit, count):
    """Every pose once, by kind, those that lost weight with a ring, and a legend outside the axes."""
    axes = aj.plot.residuals_by_kind(observed_record, unit)
    labels = [line.get_label() for line in axes.lines]
    lines = dict(zip(labels, axes.lines, strict=True))
    kinds = ["socket", "transforms", "sphere", "parallel planes", "artefact"] if unit != "deg" else ["transforms"]
    assert [label for label in labels if not label.startswith(("_", "half"))] == kinds
    drawn = np.concatenate([lines[kind].get_xdata() for kind in kinds])
    assert sorted(drawn) == list(range(1, count + 1))
    if unit != "deg":
        found = observed_record.observed
        expected = found.rms_after if unit == "mm" else found.reduced_chi
        assert np.sqrt(np.mean(lines["sphere"].get_ydata() ** 2)) == pytest.approx(expected[3])
        assert 5 in lines["half of the full weight or less"].get_xdata()
        assert [text.get_text() for text in axes.get_xticklabels()] == list(found.names)
    axes.figure.savefig(io.BytesIO())
    assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1


@pytest.mark.slow
def test_figures_of_a_calibration_from_observations(observed_record, tmp_path):
    """The file has the distances, the residuals in standard deviations and the orientations."""
    aj.plot.save_calibration_figure(observed_record, tmp_path / "figure.svg")
    text = (tmp_path / "figure.svg").read_text()
    for words in ("distance from the geometry [mm]", "residual [standard deviations]", "residual angle [deg]"):
        assert f"<!-- {words}" in text
    lines = aj.plot.pose_distances(observed_record).lines
    assert np.sqrt(np.mean(lines[1].get_ydata()[:15] ** 2)) == pytest.approx(observed_record.observed.rms_after[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_draws_into_the_axes_it_is_given_or_into_new_ones(made, name, tmp_path):
    axes = Figure().subplots()
    assert getattr(aj.plot, name)(*made[name], axes=axes) is axes
    alone = getattr(aj.plot, name)(*made[name])
    alone.figure.savefig(tmp_path / "figure.pdf")
    drawn = [*alone.lines, *alone.collections, *alone.images, *alone.containers]
    assert drawn
    assert alone.get_ylabel() or name == "correlation_matrix"


def test_figures_hold_the_numbers(record, made):
    lines = aj.plot.pose_distances(record).lines
    left = np.asarray(record.evaluations()["calibrated"].distances)
    np.testing.assert_allclose(np.sort(lines[1].get_ydata()), np.sort(left))
    changes = aj.plot.parameter_changes(record, "angle").containers[0].lines[0].get_ydata()
    vectors = record.vectors()
    angles = [i for i, name in enumerate(record.names) if name.startswith(("alpha", "theta"))]
    expected = (vectors["calibrated"] - vectors["nominal"])[angles] / aj.units.DEG
    np.testing.assert_allclose(changes, expected)
    values = aj.plot.singular_values(*made["singular_values"]).lines[0].get_ydata()
    np.testing.assert_allclose(values, made["singular_values"][0].singular)


@pytest.mark.slow
def test_patterns_in_the_residuals(record):
    """A panel for each joint, one for each axis, and the histogram; with the numbers of the calibration."""
    from aacmm_jax.diagnostics.pose_residuals import signed_residuals

    panels = aj.plot.residual_patterns(record).axes
    assert len(panels) == 6 + 3 + 1
    labels = [panel.get_xlabel() for panel in panels]
    assert labels[:6] == [f"reading of joint {i} [deg]" for i in range(1, 7)]
    assert labels[6:] == 3 * ["pose, in the order of the capture"] + ["residual [standard deviations]"]
    found = signed_residuals(record)
    drawn = panels[2].lines[1].get_xydata()
    np.testing.assert_allclose(drawn[:, 0], np.asarray(record.recording.capture.readings)[:, 2] / aj.units.DEG)
    inside = np.abs(found.along_joint[:, 2]) < panels[2].get_ylim()[1]
    np.testing.assert_allclose(drawn[inside, 1], found.along_joint[inside, 2])
    single = aj.Capture({name: q[:1] for name, q in record.recording.capture.sockets.items()})
    alone = record._replace(recording=record.recording._replace(capture=single))
    assert_refused(lambda: aj.plot.residual_patterns(alone), "there are no residuals to draw")


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    "name", ["pose_distances", "length_parameter_errors", "parameter_changes", "reference_length_errors"]
)
def test_a_legend_covers_no_data(made, name):
    axes = getattr(aj.plot, name)(*made[name])
    axes.figure.savefig(io.BytesIO())  # sets the layout
    assert axes.get_legend().get_window_extent().y0 >= axes.get_window_extent().y1


def test_an_arm_is_drawn_in_space(record):
    arm, q = record.calibrated.arm, record.recording.capture.q[:3]
    axes = aj.plot.arm_poses(arm, q)
    x, y, z = axes.lines[-1].get_data_3d()  # the tips, drawn last
    np.testing.assert_allclose(np.column_stack([x, y, z]), arm.position(q))
    assert_refused(lambda: aj.plot.arm_poses(arm, q, Figure().subplots()), "projection='3d'")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda record: aj.plot.parameter_changes(record, "lengths"), "length or angle"),
        (lambda record: aj.plot.residuals_by_kind(record, "um"), "mm, standard deviations, deg or px"),
        (lambda record: aj.plot.residuals_by_kind(record, "deg"), "no residuals in deg"),
        (
            lambda record: aj.plot.acceptance_metrics(aj.acceptance.run(aj.acceptance.Measured({"A": np.eye(3)}))),
            "no metric has a limit",
        ),
        (
            lambda record: aj.plot.length_parameter_errors(
                record._replace(recording=record.recording._replace(true=None))
            ),
            "simulated arm",
        ),
    ],
)
def test_what_cannot_be_drawn_is_refused(record, call, said):
    assert_refused(lambda: call(record), said)


def test_errors_before_and_after_the_scale_fix_stand_side_by_side(made):
    results = made["study_metric"][0]
    panel = aj.plot.study_errors(results, "noise.encoder_arcsec").axes[0]
    before, after = (container.lines[0] for container in panel.containers)
    assert np.all(before.get_xdata() < after.get_xdata())
    medians = [1e6 * (np.median(results.column("scale", cell)) - 1) for cell in (0, 1)]
    scale = aj.plot.study_scale(results, "noise.encoder_arcsec").axes[0]
    np.testing.assert_allclose(scale.containers[0].lines[0].get_ydata(), medians, rtol=1e-6)


@pytest.mark.parametrize("ratio", [[0.2, -0.4], [1.2, -12.0], [30.0, 0.1], [-300.0, 0.3], [5e4, -2.0]])
def test_ratios_are_labelled_within_their_axis(ratio):
    """Labels beyond the ends of an axis would lie over the title."""
    axis = _ratio_axis(np.array(ratio))
    assert axis.low <= min(ratio) < max(ratio) <= axis.high
    assert all(axis.low <= at <= axis.high for at, _ in axis.ticks)
    assert {-1.0, 0.0, 1.0} <= {at for at, _ in axis.ticks}
