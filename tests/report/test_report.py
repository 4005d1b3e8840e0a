"""Reports: their contents, that no given text becomes markup, and that a browser shows, sorts and prints them."""

import copy
import dataclasses
import json
import math
import re
import shutil
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.data.recording import ReadImage
from aacmm_jax.diagnostics.joint_travel import tried_poses
from aacmm_jax.plot import charts, svg
from aacmm_jax.plot.lengths import tried_shades
from aacmm_jax.report import elements, plans, write_report
from aacmm_jax.report.html_page import _identity, _origin
from aacmm_jax.summaries.tables import Table, decimals_for, format_number, number
from tests.conftest import SLOW
from tests.refusals import assert_refused
from tests.written_study import write_study

HOSTILE = '<script>document.title="taken"</script><img src=x onerror=alert(1)> & "B" <b>bold</b>'
Q = np.random.default_rng(0).normal(size=(8, 6))
KINDS = ("calibration", "evaluation", "study", "observations", "camera")
STUDY = {
    "arm": "cheng2018-simulation",
    "trials": 4,
    "capture": {"positions_mm": [[400, 200, 300]], "poses": 20},
    "noise": {"encoder_arcsec": [2, 4]},
    "identification": {"method": "stage1"},
}


@pytest.fixture(scope="module", params=SLOW)
def written(tmp_path_factory, observed_record, camera_records):
    """The files and reports of a simulated arm with hostile names: calibration, evaluation, study; and of a calibration
    from observations, two of which have hostile names."""
    folder = tmp_path_factory.mktemp("reports")
    nominal = aj.files.load_specification("cheng2018-simulation")._replace(name=f"Arm {HOSTILE}")
    space = aj.Parameters.free_of(nominal.arm)
    true = aj.perturbed_arm(space, length=1.0, angle=0.002, seed=1)
    names = [HOSTILE, "B", "C"]
    points = dict(zip(names, [(400, 200, 300), (700, 500, 500), (-300, 600, 400)], strict=True))
    lengths = [(HOSTILE, "B", 0.002), (HOSTILE, "C", 0.002)]
    capture = aj.simulate(
        true, points, poses={HOSTILE: 40, "B": 12, "C": 12}, lengths=lengths, encoder_arcsec=2.0, seating=0.005, seed=1
    )
    recording = aj.Recording(capture, nominal, nominal._replace(arm=true), 1, sources=(f"{HOSTILE} (SHA-256 0)",))
    seen = recording._replace(capture=capture.select(without="C"))
    bounds = aj.Bounds.around(nominal.arm, space, length=10.0, angle=0.0175, override={"d_5": 0.2})
    record = aj.calibration.record_of(aj.calibrate(nominal.arm, seen.capture, bounds), seen)
    aj.files.save_calibration(folder / "calibration.h5", record)
    evaluation = aj.evaluate_capture(
        record, recording, limits={"Deltam": aj.acceptance.Limit(5.0), "E_Uni": aj.acceptance.Limit(1e-4)}, u_test=0.001
    )
    doubts = {"warnings": (*evaluation.warnings, f"Beware of {HOSTILE}"), "calibration_warnings": (f"Not {HOSTILE}",)}
    evaluation = evaluation._replace(**doubts)
    aj.files.save_evaluation(folder / "evaluation.h5", evaluation)
    write_study(folder / "study.h5", aj.study.make_study(**{**STUDY, "arm": nominal.arm}))
    aj.files.save_calibration(folder / "observations.h5", with_hostile_names(observed_record))
    aj.files.save_calibration(folder / "camera.h5", with_pictures(camera_records["fixed"]))
    pages = {kind: folder / f"{kind}.html" for kind in KINDS}
    for kind, page in pages.items():
        write_report(folder / f"{kind}.h5", page)
    return SimpleNamespace(folder=folder, pages=pages, record=record, evaluation=evaluation)


JPEG = (  # a grey pixel
    "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAMCAgICAgMCAgI"
    "DAwMDBAYEBAQEBAgGBgUGCQgKCgkICQkKDA8MCgsOCwkJDRENDg8QEBEQCgwSExIQEw8Q"
    "EBD/wAALCAABAAEBAREA/8QAFAABAAAAAAAAAAAAAAAAAAAACf/EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAIAQEAAD8AVN//2Q=="
)


def with_pictures(record):
    """The same calibration of a camera, with pictures of its images, whose names are hostile."""
    [seen] = record.recording.capture.observations
    names = tuple(f"{number} {HOSTILE}" for number in range(len(seen.q)))
    images = tuple(ReadImage(seen.name, name, 6, preview=JPEG) for name in names)
    capture = aj.Capture({}, (), [seen.changed(images=names)])
    return record._replace(recording=record.recording._replace(capture=capture, images=images))


def with_hostile_names(record):
    """The same calibration, with a socket and an artefact of another name."""
    capture, found, hostile_bar = record.recording.capture, record.observed, f"bar {HOSTILE}"
    bar = copy.copy(capture.observations[-1])
    for field in ("name", "placement", "artefact"):
        object.__setattr__(bar, field, hostile_bar)
    sockets = {HOSTILE if name == "A" else name: q for name, q in capture.sockets.items()}
    capture = aj.Capture(sockets, [], [*capture.observations[:-1], bar])
    renamed = {"position of A": f"position of {HOSTILE}", "placement bar": f"placement {hostile_bar}"}
    renamed["coordinates of bar"] = f"coordinates of {hostile_bar}"
    parts = {
        field: {renamed.get(part, part): values for part, values in getattr(found, field).items()}
        for field in ("geometry", "geometry_covariance")
    }
    names = tuple({"A": HOSTILE, "bar": hostile_bar}.get(name, name) for name in found.names)
    found = dataclasses.replace(found, names=names, **parts)
    return record._replace(recording=record.recording._replace(capture=capture), observed=found)


class Page(HTMLParser):
    """Elements, visible text, and the data of the charts."""

    def __init__(self, text: str):
        super().__init__()
        self.elements, self.text, self.held, self._in = [], "", {}, []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._in.append(dict(attrs).get("id", tag))

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._in.pop()

    def handle_data(self, data):
        if self._in:
            self.held[self._in[-1]] = self.held.get(self._in[-1], "") + data
        else:
            self.text += data


def test_a_target_that_cannot_be_written_is_refused(written):
    source = written.folder / "calibration.h5"
    assert_refused(lambda: write_report(source, written.folder / f"{'x' * 300}.html"), "name too long")
    assert_refused(lambda: write_report(source, source), "one of the files that this command reads")


@pytest.fixture(scope="module", params=KINDS)
def page(request, written):
    found = Page(written.pages[request.param].read_text(encoding="utf-8"))
    found.kind = request.param
    return found


@pytest.mark.first_rows(3)
def test_text_of_people_never_becomes_markup(page):
    tags = [tag for tag, _ in page.elements]
    assert "img" not in tags
    assert tags.count("script") == 3  # two of data, and the page's own
    assert not [attributes for _, attributes in page.elements if any(name.startswith("on") for name in attributes)]
    if page.kind == "evaluation":
        assert f"Beware of {HOSTILE}" in page.text
        assert f"About the calibration: Not {HOSTILE}" in page.text
    if page.kind == "camera":
        assert 'Distortion of the "<b>webcam</b>"' in page.text
    elif page.kind != "study":  # a study knows its arm by the name that its maker gave in Python: none
        assert HOSTILE in page.text
    for name in ("points", "scenes"):
        assert "<" not in page.held[name]
        json.loads(page.held[name])


def test_a_page_needs_nothing_else_and_is_small(page, written):
    links = [value for _, attributes in page.elements for name, value in attributes.items() if name in ("src", "href")]
    pictures = [link for link in links if link == f"data:image/jpeg;base64,{JPEG}"]
    assert len(pictures) == (6 if page.kind == "camera" else 0)
    assert all(link.startswith("#") or link == "data:," for link in links if link not in pictures)
    assert written.pages[page.kind].stat().st_size < 600_000
    policy = next(attributes["content"] for tag, attributes in page.elements if attributes.get("http-equiv"))
    assert "default-src 'none'" in policy
    assert "script-src 'sha256-" in policy
    assert "unsafe-inline" not in policy.split("style-src")[0]


def test_charts_are_in_the_page_as_pictures_with_words(page):
    """Drawn before any script runs, each with a caption that describes it, and with what is said of its marks."""
    charts = [attributes["data-chart"] for _, attributes in page.elements if "data-chart" in attributes]
    assert len(charts) >= {"calibration": 8, "observations": 9}.get(page.kind, 4)
    pictures = [attributes for tag, attributes in page.elements if tag == "svg" and attributes.get("role") == "img"]
    described = {attributes["id"] for tag, attributes in page.elements if tag == "figcaption" and "id" in attributes}
    assert {attributes["aria-labelledby"] for attributes in pictures} == described
    paths = [attributes["d"] for tag, attributes in page.elements if tag == "path" and "d" in attributes]
    assert not [path for path in paths if "nan" in path or "inf" in path]
    said = json.loads(page.held["points"])
    assert set(said) == set(charts)
    for plots in said.values():
        assert all(len(words) > 3 for plot in plots for _, _, words in plot)
    assert sum(tag == "details" for tag, _ in page.elements) >= 2


def test_a_calibration_report_says_what_the_calibration_found(written):
    found = Page(written.pages["calibration"].read_text(encoding="utf-8"))
    record = written.record
    decimals = decimals_for(record.u_k)
    assert f"k = {record.k:.{decimals}f} times" in found.text
    assert f"u(k)\u00a0=\u00a0{record.u_k:.{decimals}f}." in found.text
    for name, value, u in zip(
        record.names, record.vectors()["calibrated"], np.sqrt(np.diag(record.covariance)), strict=True
    ):
        if name.startswith("a_") and u > 0:
            decimals = decimals_for(1.99 * u)
            assert f"{value:.{decimals}f}".replace("-", "−") in found.text, name
    assert "on the upper bound" in found.text or "on the lower bound" in found.text
    assert "Read this first" in found.text
    # Warnings come before results.
    assert found.text.index("Read this first") < found.text.index("What was calibrated")
    for needed in ("aacmm_jax", "jax 0.", "SHA-256", "Command", "Seed"):
        assert needed in found.text
    scene = json.loads(found.held["scenes"])["scene"]
    q = np.asarray(record.recording.capture.q)
    np.testing.assert_allclose(
        [pose["points"][-1] for pose in scene["poses"]], record.calibrated.arm.position(q), atol=0.06
    )
    assert all(pose["points"][0] == [0, 0, 0] for pose in scene["poses"])


def tables_of(report):
    found = {}
    for section in report.sections:
        for block in section.blocks:
            table = block.table if isinstance(block, charts.Chart) else block
            if isinstance(table, Table):
                found[table.title] = SimpleNamespace(columns=list(table.headings), rows=table.cells)
    return found


@pytest.mark.slow
def test_numbers_of_a_report_are_under_the_right_heading(written):
    from aacmm_jax.report.calibration import calibration_report

    record = written.record
    report = calibration_report(record)
    tables = tables_of(report)
    evaluations, expanded = record.evaluations(), aj.uncertainty_of(record).expanded(0.95)
    stages = {"nominal": "nominal", "stage 1": "stage1", "calibrated": "calibrated"}
    metrics = tables["Metrics by arm [mm]"]
    for heading, stage in stages.items():
        cell = metrics.rows[0][metrics.columns.index(heading)]
        assert cell.value == pytest.approx(float(evaluations[stage].repeatability.de))
    parameters = tables["Parameters"]
    for row in parameters.rows:
        i = record.names.index(row[0].text)
        scale = 1 / aj.units.DEG if row[1].text == "deg" else 1.0
        assert row[parameters.columns.index("calibrated")].value == pytest.approx(
            scale * record.vectors()["calibrated"][i]
        )
        if row[parameters.columns.index("U (95 %)")].value is not None:
            assert row[parameters.columns.index("U (95 %)")].value == pytest.approx(scale * expanded[i])
    volume = aj.volumetric_uncertainty(aj.uncertainty_of(record))
    rows = tables["Expanded uncertainty over all joint limits [mm]"].rows
    assert rows[1][3].value == pytest.approx(volume.expanded_length.max())
    positions = tables["All positions"]
    np.testing.assert_allclose([row[4].value for row in positions.rows], volume.expanded_length)
    charts_by_id = {
        block.id: block for section in report.sections for block in section.blocks if isinstance(block, charts.Chart)
    }
    marks = charts_by_id["volume"].plots[0].marks[0]
    shade, limits = marks.shade, marks.limits
    assert limits[-1] == pytest.approx(volume.expanded_length.max())
    assert sum(np.asarray(shade) == 0) == sum(volume.expanded_length < limits[1])
    change = charts_by_id["change-mm"].plots[0]
    i = record.names.index(change.x.ticks[0][1])
    vectors, marks = record.vectors(), change.marks[0]
    assert marks.y[0] == pytest.approx(vectors["calibrated"][i] - vectors["nominal"][i], rel=1e-5)
    assert marks.high[0] - marks.y[0] == pytest.approx(expanded[i], rel=1e-5)


@pytest.fixture(scope="module")
def observed_report(observed_record):
    from aacmm_jax.report.calibration import calibration_report

    return calibration_report(observed_record)


def test_a_report_of_observations_by_kind_observation_and_pose(observed_record, observed_report):
    report = observed_report
    assert report.subtitle.endswith("robust loss tukey; 92 poses in 2 sockets, 4 other observations")
    found, tables = observed_record.observed, tables_of(report)
    nominal = observed_record.evaluations()["nominal"].observed
    rows = tables["RMS residuals by observation"].rows
    assert [row[0].text for row in rows] == ["A", "B", "tracker", "ball", "block", "bar"]
    np.testing.assert_allclose([row[3].value for row in rows], nominal.rms)
    np.testing.assert_allclose([row[4].value for row in rows], found.rms_after)
    np.testing.assert_allclose([row[6].value for row in rows], found.reduced_chi)
    assert [row[5].text == "–" for row in rows] == [True, True, False, True, True, True]
    socket = tables["RMS residuals by kind"].rows[0]
    assert [cell.text for cell in socket[:3]] == ["socket", "2", "23"]
    assert socket[4].value == pytest.approx(math.sqrt(np.average(found.rms_after[:2] ** 2, weights=[15, 8])))
    charts_by_id = {
        block.id: block for section in report.sections for block in section.blocks if isinstance(block, charts.Chart)
    }
    normalised = {marks.name: marks for marks in charts_by_id["normalised"].plots[0].marks}
    in_ball = np.array(normalised["sphere"].y)
    assert len(in_ball) == 12
    assert math.sqrt(np.mean(in_ball**2)) == pytest.approx(found.reduced_chi[3], rel=1e-5)
    assert normalised["half of the full weight or less"].x[0] == 5  # the bad pose of A is marked
    weights = next(table for caption, table in tables.items() if caption.startswith("Poses to which the robust loss"))
    assert [cell.text for cell in weights.rows[0][:3]] == ["A", "5", "0.000"]
    assert weights.rows[0][3].value > 1
    certified = [[cell.text for cell in row[:3]] for row in tables["Certified values"].rows]
    assert ["bar", "certified coordinates of far", "(300.0000, 0.0000, 0.0000) mm"] in certified
    found_table = tables["Geometry found (a frame takes its points x to R x + origin)"]
    geometry = {(row[0].text, row[1].text): row[2].text for row in found_table.rows}
    assert geometry["plane block", "normal"].endswith(", 1.000000)")
    assert geometry["frame of tracker", "rotation vector"].endswith(" deg")
    values = found.geometry["offset of tracker"]
    assert geometry["offset of tracker", "position"] == f"({', '.join(f'{x:.4f}' for x in values)}) mm"
    scene = next(
        block for section in report.sections for block in section.blocks if isinstance(block, elements.ArmView)
    )
    assert [mark["name"] for mark in scene.data["marks"]] == ["A", "B", "centre of ball"]
    transforms = [pose for pose in scene.data["poses"] if pose["label"].startswith("tracker")]
    arm = observed_record.calibrated.arm.replace(probe=values)
    q = observed_record.recording.capture.observations[0].q
    np.testing.assert_allclose([pose["points"][-1] for pose in transforms], arm.position(q), atol=0.06)


@pytest.mark.slow
def test_a_report_of_a_camera(camera_records):
    """Its section has the mount and three charts; the view of the arm has what is on the arm in each pose, and what
    stands still."""
    from aacmm_jax.report.calibration import calibration_report

    for record in camera_records.values():
        report = calibration_report(record)
        section = next(section for section in report.sections if section.id == "cameras")
        shown = [block.id for block in section.blocks if isinstance(block, charts.Chart)]
        assert shown == ["coverage-1", "arrows-1", "distortion-1"]
        assert any(isinstance(block, Table) and block.title.startswith("Cameras") for block in section.blocks)
        scene = next(
            block for section in report.sections for block in section.blocks if isinstance(block, elements.ArmView)
        )
        [observation] = record.recording.capture.observations
        pyramid, outline = 12, 5  # points of their lines
        assert {len(pose["carried"]) for pose in scene.data["poses"]} == {pyramid if observation.on_arm else outline}
        sights = [thing["points"] for thing in scene.data["things"] if thing["kind"] == "sight"]
        assert [len(points) for points in sights] == [outline if observation.on_arm else pyramid]
        assert [mark["name"] for mark in scene.data["marks"]] == [observation.still]


@pytest.mark.slow
def test_a_report_says_what_was_decided_by_default(observed_record):
    from aacmm_jax.report.calibration import calibration_report

    decided = "Default bounds were widened where the fit reached them: a_2 (to ±50 mm)."
    page = calibration_report(observed_record._replace(decisions=(decided,)))
    assert f"Decided by default: {decided}" in page.sections[0].blocks


def test_a_report_says_what_was_left_out(observed_record):
    from aacmm_jax.calibration.record import Removed
    from aacmm_jax.diagnostics.contradictions import removal
    from aacmm_jax.report.elements import removed_tables

    removed = Removed("station", "T2", ("T2/day", "T2/night"), 45.6, (6, 60), 1e-9, 0.2, 0.1, "theta_3", 12.0)
    record = observed_record._replace(removed=(removed,))
    (row,) = removed_tables(record)[0].cells
    expected = ["T2", "station", "T2/day, T2/night", "45.6", "6 and 60", "< 0.0001", "0.2000", "0.1000"]
    assert [cell.text for cell in row] == [*expected, "theta_3, by 12.0 u"]
    assert "Left out: station T2, which contradicts the other data (F = 45.6 with 6 and" in removal(removed).says
    clear = removed._replace(ratio=5.74e9)
    assert removed_tables(record._replace(removed=(clear,)))[0].cells[0][3].text == "> 1000"
    assert "(F > 1000 with 6 and 60 degrees of freedom" in removal(clear).says


@pytest.mark.slow
def test_groups_held_out_are_listed_one_by_one_the_worst_first(written):
    from aacmm_jax.calibration.agreement import CrossValidation, LeftOut
    from aacmm_jax.report.calibration import calibration_report

    def left_out(name, rms, predicted):
        return LeftOut((name, f"{name}2"), 10, rms, predicted, np.array([0.03, -0.04]), np.array([0.1, 0.1]), True)

    groups = left_out("low", 0.2, 0.2), left_out("high", 1.17, 0.31), left_out("open", 0.2, np.inf)
    tables = tables_of(calibration_report(written.record._replace(validation=CrossValidation(groups))))
    rows = tables["Groups held out [mm]"].rows
    assert rows[0][0].text.startswith("high")
    assert [cell.value for cell in rows[0][2:6]] == pytest.approx([10, 1.17, 0.31, 0.025 * math.sqrt(2)])
    assert [row[1].text for row in rows] == ["disagrees", "", ""]
    (unknown,) = (row for row in rows if row[0].text.startswith("open"))
    assert unknown[4].text == "–"


@pytest.mark.slow
def test_a_report_says_where_the_scale_comes_from(observed_record, observed_report):
    from aacmm_jax.report.calibration import calibration_report

    def text_of(report):
        blocks = [block for section in report.sections for block in section.blocks if isinstance(block, str)]
        return report.subtitle + " ".join(blocks)

    said = text_of(observed_report)
    assert "it comes from tracker (transforms), ball (sphere), block (parallel planes), bar (artefact)." in said
    recording = observed_record.recording
    alone = recording._replace(capture=aj.Capture(recording.capture.sockets))
    found = aj.identify(recording.nominal.arm, alone.capture, recording.nominal.bounds())
    said = text_of(calibration_report(aj.calibration.record_of(found, alone)))
    assert "with the scale of the nominal arm" in said
    assert "The scale is that of the nominal arm: no measurement set the scale." in said
    assert "not traceable" in said


@pytest.mark.slow
def test_lengths_of_a_report_by_arm_and_with_expanded_uncertainty(written):
    """The recording has two lengths, so that none is zero by construction."""
    from aacmm_jax.report.calibration import calibration_report

    recording = written.evaluation.recording
    space = aj.Parameters(recording.nominal.arm, written.record.names)
    bounds = aj.Bounds.around(recording.nominal.arm, space, length=10.0, angle=0.0175)
    record = aj.calibration.record_of(aj.calibrate(recording.nominal.arm, recording.capture, bounds), recording)
    table = tables_of(calibration_report(record))["Reference lengths [mm]"]
    evaluations = record.evaluations()
    u, stated = evaluations["calibrated"].u, np.array([float(length.u) for length in recording.capture.lengths])
    expanded = aj.uncertainty_of(record).expanded_by_scatter(np.asarray(u), stated)
    for i, row in enumerate(table.rows):
        cells = dict(zip(table.columns, row, strict=True))
        for heading, stage in (("nominal", "nominal"), ("stage 1", "stage1"), ("calibrated", "calibrated")):
            assert cells[f"error, {heading}"].value == pytest.approx(float(evaluations[stage].error[i]))
        assert cells["U of error"].value == pytest.approx(expanded[i])


def test_a_report_of_very_many_poses_stays_small(written, tmp_path):
    """A table of thousands of rows is cut, not written out cell by cell for minutes."""
    from aacmm_jax.report.elements import residual_chart

    arm = written.record.calibrated.arm
    q = np.tile(np.asarray(written.record.recording.capture.q), (120, 1)) + 1e-5 * np.random.default_rng(0).normal(
        size=(120 * 52, 6)
    )
    capture = aj.Capture({"A": q[:6000], "B": q[6000:6001]})
    chart = residual_chart(capture, aj.evaluate(arm, capture))
    assert chart.table is not None
    assert len(chart.table.rows) == 400
    assert len(chart.plots[0].marks[0].x) <= 1001
    distances = np.asarray(aj.evaluate(arm, capture).distances)
    assert chart.table.cells[0][2].value == pytest.approx(distances.max())


def test_poses_alone_in_their_socket_show_no_scatter(written):
    from aacmm_jax.plot.residuals import distances_in
    from aacmm_jax.report.elements import residual_chart, socket_table, view_of_arm

    arm, q = written.record.calibrated.arm, written.record.recording.capture.q
    capture = aj.Capture({"A": q[:10], "B": q[10:11]})
    evaluation = aj.evaluate(arm, capture)
    view = view_of_arm(arm, capture, distances_in(capture, evaluation))
    distances = [pose["distance"] for pose in view.data["poses"]]
    assert distances[10] is None
    assert None not in distances[:10]
    assert [cell.text for cell in socket_table(capture, evaluation).cells[1]][2:5] == ["–"] * 3
    assert len(residual_chart(capture, evaluation).plots[0].marks[0].x) == 10
    single = aj.Capture({"B": q[:1]})
    assert "no scatter" in residual_chart(single, aj.evaluate(arm, single)).description


CONFORMITY = """
[conformity]
verdict = "{}"
specification = "a specification"
decision_rule = "a rule"
"""


@pytest.mark.slow
def test_a_statement_that_the_file_contradicts_is_refused(written, tmp_path):
    from aacmm_jax.acceptance.record import PointsRecord
    from aacmm_jax.files.evaluations import save_evaluation

    (tmp_path / "pass.toml").write_text(CONFORMITY.format("pass"))
    stated = aj.files.read_administrative_data(tmp_path / "pass.toml")
    for kind in ("calibration", "evaluation"):
        assert_refused(
            lambda kind=kind: write_report(written.folder / f"{kind}.h5", tmp_path / "r.html", stated), "simulated"
        )
    measured = aj.acceptance.Measured({"A": np.array([[0, 0, 0], [0.1, 0, 0]])})
    save_evaluation(tmp_path / "fails.h5", PointsRecord(measured, {"Deltam": aj.acceptance.Limit(0.04)}, 0.001))
    assert_refused(lambda: write_report(tmp_path / "fails.h5", tmp_path / "r.html", stated), "a limit is not met")
    save_evaluation(tmp_path / "passes.h5", PointsRecord(measured, {"Deltam": aj.acceptance.Limit(0.06)}, 0.001))
    write_report(tmp_path / "passes.h5", tmp_path / "r.html", stated)
    rule = aj.acceptance.RULES["iso-2017"]
    assert f"pass: a specification; {rule}; a rule" in (tmp_path / "r.html").read_text(encoding="utf-8")
    assert_refused(lambda: aj.certificate.dcc_xml(written.record, stated, created="2026-01-31T00:00:00"), "simulated")


def test_corners_of_an_arm_by_hand():
    from aacmm_jax.kinematics.workspace import skeleton

    # One joint at 90 degrees: 100 up, 200 out along y, then the probe 50 along the last z, tilted by alpha = -90 deg.
    arm = aj.Arm(alpha=[-math.pi / 2], a=[200], d=[100], theta=[0], probe=[0, 0, 50])
    np.testing.assert_allclose(
        skeleton(arm, np.array([[math.pi / 2]]))[0], [[0, 0, 0], [0, 0, 100], [0, 200, 100], [-50, 200, 100]], atol=1e-9
    )


def test_an_evaluation_report_decides(written):
    text = Page(written.pages["evaluation"].read_text(encoding="utf-8")).text
    assert "✗ fails" in text  # E_Uni of 0.1 um
    assert "✓ conforms" in text  # Deltam of 5 mm
    assert text.index("Fails") < text.index("E_Uni is over its limit.") < text.index("Read this first")
    assert "The full procedure was not carried out" in text
    assert "based on ISO 10360-12:2016" in text


def test_observations_of_an_evaluation_stand_beside_their_prediction():
    from aacmm_jax.report.evaluation import observation_tables

    row = {"observation": "bar", "kind": "artefact", "poses": 20, "nominal_rms_mm": 1.25, "rms_mm": 0.02}
    unseen = row | {"rms_predicted_mm": 0.03, "reduced_chi": 0.67}
    used = {"observations": [row | {"reduced_chi": 0.9}]}
    first, second = observation_tables({"held_out": {"observations": [unseen]}, "identified_from": used})
    assert "Held-out data" in first.title
    assert [cell.text for cell in first.cells[0]] == ["bar", "artefact", "20", "1.2500", "0.0200", "0.0300", "0.67"]
    assert "used for identification" in second.title
    assert observation_tables({"held_out": None, "identified_from": {"observations": []}}) == []


@pytest.mark.slow
def test_charts_of_an_evaluation(written):
    from aacmm_jax.report.evaluation import evaluation_report

    report = evaluation_report(written.evaluation)
    blocks = [block for section in report.sections for block in section.blocks]
    plots = {block.id: block.plots[0] for block in blocks if isinstance(block, charts.Chart) and block.plots}
    assert isinstance(report.picture, charts.Chart)
    assert report.picture.id == "margins"
    assert report.picture.plots[0].y.low == 0  # of absolute values
    readings = plots["length-errors"]
    errors = readings.marks[0]
    assert sorted(errors.x) == list(range(len(errors.y)))  # side by side, not all at one abscissa
    assert [words for _, words in readings.x.ticks] == [f"{HOSTILE} – C"]


@pytest.mark.slow
def test_a_verdict_is_marked_as_what_it_is(written):
    from aacmm_jax.acceptance.record import PointsRecord
    from aacmm_jax.report.calibration import calibration_report
    from aacmm_jax.report.evaluation import points_report

    report = calibration_report(written.record)
    assert (report.verdict[:20], report.verdict_mark) == ("To be used with care", "unsure")  # d_5 is on its bound
    assert "on a bound: d_5" in report.verdict
    failed = calibration_report(written.record._replace(converged=False))
    assert (failed.verdict[:10], failed.verdict_mark) == ("Not usable", "bad")
    measured = points_report(PointsRecord(aj.acceptance.Measured({"A": np.eye(3)})))
    assert (measured.verdict, measured.verdict_mark) == ("Measured; no limit was given.", "neutral")


@pytest.mark.parametrize("limits", [{}, {"Deltam": aj.acceptance.Limit(0.05)}])
def test_the_decision_rule_is_explained_only_where_there_is_a_limit(limits):
    from aacmm_jax.acceptance.record import PointsRecord
    from aacmm_jax.report.evaluation import points_report

    points = aj.acceptance.Measured({"A": 0.01 * np.random.default_rng(0).normal(size=(10, 3))})
    (acceptance, *_) = points_report(PointsRecord(points, limits)).sections
    text = " ".join(block for block in acceptance.blocks if isinstance(block, str))
    assert ("ISO 14253-1" in text) == bool(limits)
    assert "ISO 14253-5" in text


@pytest.mark.parametrize(
    ("value", "decimals", "signed", "expected"),
    [
        (1.23456, 2, False, "1.23"),
        (-1.5, 1, True, "−1.5"),
        (1.5, 1, True, "+1.5"),
        (1e-7, 4, False, "1.0e−07"),
        (0.0, 3, False, "0.000"),
    ],
)
def test_numbers_are_shown(value, decimals, signed, expected):
    assert format_number(value, decimals, signed=signed) == expected


def test_missing_numbers_are_told_from_infinite_ones():
    cells = [number(value).text for value in (None, math.nan, math.inf)]
    assert cells == ["–", "–", "not determined"]


def test_a_logarithmic_axis_marks_what_is_there():
    marks = [mark for mark, _ in charts.logarithmic("", [0.012, 0.3]).ticks]
    assert marks == pytest.approx([0.01, 0.02, 0.05, 0.1, 0.2])
    assert charts.logarithmic("", []).ticks


def test_coverage_has_classes_that_mean_something(paper_arm):
    """Near a pose; between poses; and by how many joints are outside their travel, the shorter way round."""
    calibrated = np.radians(np.linspace(150, 210, 7))[:, None] * np.ones(6)  # about the turn from 180 to -180 deg
    among = np.radians([[180] * 6, [-175, 155, 180, 180, 180, 205], [0, *[180] * 5], [140, 140, *[180] * 4]])
    assert tried_shades(tried_poses(paper_arm, calibrated, among)).tolist() == [0, 2, 3, 5]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 1.0, ["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
        (-30.0, 45.0, ["−20", "0", "20", "40"]),
        (0.0012, 0.0021, ["0.0012", "0.0014", "0.0016", "0.0018", "0.0020"]),
        (-2e7, 1e7, ["−2e+07", "−1.5e+07", "−1e+07", "−5e+06", "0", "5e+06", "1e+07"]),
    ],
)
def test_an_axis_has_round_numbers(low, high, expected):
    ticks = charts.round_ticks(low, high)
    assert [words for _, words in ticks] == expected
    assert all(low - 1e-9 <= at <= high + 1e-9 for at, _ in ticks)


def test_marks_stand_where_their_numbers_say():
    """Zero-length lines at thousandths of both axes, counted from above; no mark for what is not a number."""
    axes = charts.Axis("x", 0, 10, ((5.0, "5"),)), charts.Axis("y", 1, 100, ((10.0, "10"),), "log")
    marks = charts.Marks("m", [2.5, 5.0, 7.5], [10.0, math.nan, 100.0], words=["a", "b", "c"])
    plot = charts.Plot(*axes, (marks,))
    drawn = svg.drawn(plot, "caption")
    assert 'd="M250 500h0M750 0h0"' in drawn
    assert svg.points(plot) == [[250, 500, "a"], [750, 0, "c"]]
    assert '<text x="50.00%" y="100%"' in drawn


def test_long_names_of_an_axis_have_room():
    """Slanted to the left of their ticks, without their middle, however long they are."""
    names = [f"measuring_station_{i}/nest" for i in range(3)]
    plot = charts.Plot(charts.names("", names), charts.linear("y", [0, 1]), ())
    drawn = svg.drawn(plot, "caption")
    assert [words in drawn for words in ("measuring_…on_0/nest", *names)] == [True, False, False, False]
    below, left = map(float, re.search(r"padding:6px 12px ([\d.]+)px ([\d.]+)px", drawn).groups())
    assert below < 150  # pixels
    across = 0.5 * 6.6 * len("measuring_…on_0/nest")  # pixels, of the first name
    assert left + 280 * plot.x.at(0.0) > across  # on a telephone


def test_lengths_stand_placement_by_placement():
    """Named by length where there are few, else by placement; in their order, the readings of one together."""
    from aacmm_jax.plot.lengths import by_placement

    between = [("p2/a", "p2/b"), ("p1/a", "p1/b"), ("p2/a", "p2/b"), ("A", "B")]
    x, axis, borders = by_placement(between)
    assert (x.tolist(), borders.tolist()) == ([0, 2, 1, 3], [1.5, 2.5])
    assert axis.ticks == ((0.5, "p2"), (2.0, "p1"), (3.0, "A – B"))
    many = [(f"p{i % 3}/{i}", f"p{i % 3}/{i + 1}") for i in range(60)]
    assert [words for _, words in by_placement(many)[1].ticks] == ["p0", "p1", "p2"]
    assert "60 lengths in 60 placements" in by_placement([(f"{i}", f"{i}'") for i in range(60)])[1].title


def test_what_cannot_be_reported_is_refused(written, tmp_path):
    aj.files.save_capture(tmp_path / "capture.h5", written.record.recording)
    assert_refused(
        lambda: write_report(tmp_path / "capture.h5", tmp_path / "r.html"), "capture.h5", "contains a capture"
    )
    assert_refused(lambda: write_report(tmp_path / "none.h5", tmp_path / "r.html"), "does not exist")
    calibration = written.folder / "calibration.h5"
    assert_refused(lambda: write_report(calibration, calibration), "choose another output")
    assert_refused(lambda: write_report(calibration, tmp_path / "no" / "r.html"), "cannot be written")


ABOUT = """
[laboratory]
name = "Metrology <b>Lab</b>"
city = "Chengdu"
[item]
serial_number = "7125-001"
[[person]]
name = "A. Smith"
role = "calibration engineer"
"""


@pytest.mark.slow
def test_the_command_states_the_laboratory_and_prints_for_machines(written, aacmm, tmp_path):
    (tmp_path / "about.toml").write_text(ABOUT)
    done = aacmm("report", written.folder / "calibration.h5", "-o", "report.html", "--about", "about.toml", "--json")
    summary = json.loads(done.stdout)
    assert summary["bytes"] == (tmp_path / "report.html").stat().st_size
    text = Page((tmp_path / "report.html").read_text(encoding="utf-8")).text
    for needed in ("Metrology <b>Lab</b>", "Chengdu", "7125-001", "calibration engineer"):
        assert needed in text
    dcc = aacmm("export", written.folder / "calibration.h5", "--format", "dcc", "--about", "about.toml").stdout
    values = aj.certificate.parse_dcc(dcc)
    # Rounded to the second digit of U.
    expected = pytest.approx(float(written.record.calibrated.arm.a[1]), abs=0.01)
    assert any(value.value == expected for value in values.values())
    assert (
        "--format dcc" in aacmm("export", written.folder / "calibration.h5", "--about", "about.toml", expect=2).stderr
    )


# --- A real browser ---


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium is installed (Debian: apt-get install chromium)")
    quiet = [
        "--no-sandbox",
        "--disable-gpu",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ]
    with api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=quiet)
        yield running
        running.close()


@pytest.fixture
def shown(browser, written):
    """Open a report at a width, ready; what the console said and what was asked of the network is kept on the page."""
    contexts = []

    def open_(kind: str, width: int, scheme="light", *, bypass_csp=False):
        context = browser.new_context(
            viewport={"width": width, "height": 800}, offline=True, color_scheme=scheme, bypass_csp=bypass_csp
        )
        contexts.append(context)
        context.set_default_timeout(300_000)  # ms; a busy machine takes longer than Playwright's 30 s
        opened = context.new_page()
        opened.said, opened.asked = [], []
        opened.on("console", lambda message: opened.said.append(message.text))
        opened.on("pageerror", lambda error: opened.said.append(str(error)))
        opened.on("dialog", lambda dialog: opened.said.append(dialog.message))
        opened.on("request", lambda request: opened.asked.append(request.url))
        opened.goto(written.pages[kind].as_uri())
        opened.wait_for_selector("body[data-ready=yes]")
        return opened

    yield open_
    for context in contexts:
        context.close()


@pytest.mark.parametrize(
    ("kind", "width"),
    [
        *(("calibration", 400), ("evaluation", 1600), ("study", 400), ("observations", 400), ("camera", 400)),
        *(
            pytest.param(kind, width, marks=pytest.mark.slow)
            for kind, width in (
                ("calibration", 1600),
                ("evaluation", 400),
                ("study", 1600),
                ("observations", 1600),
                ("camera", 1600),
            )
        ),
    ],
)
def test_a_browser_draws_everything_and_asks_for_nothing(shown, written, kind, width):
    opened = shown(kind, width)
    assert opened.said == []
    assert [url for url in opened.asked if not url.startswith(("data:", "blob:"))] == [written.pages[kind].as_uri()]
    # Every chart has drawn marks within the page, and the page is no wider than the screen.
    drawn = opened.evaluate(
        """() => [...document.querySelectorAll(".axes > svg")].map((svg) => {
            const marks = [...svg.querySelectorAll(".dots, .squares, .curve, .boxes, use")];
            return { marks: marks.length, width: svg.getBoundingClientRect().width,
                size: Math.max(...marks.map((mark) => mark.getBoundingClientRect().width)) }; })"""
    )
    assert drawn
    for chart in drawn:
        assert chart["marks"] > 0
        assert min(0.5 * width, 200) < chart["width"] < width
        assert 0 < chart["size"] < width
    assert opened.evaluate("document.documentElement.scrollWidth") <= width
    # The verdict, three numbers and the picture are on the first screen.
    for part in (".verdict", ".numbers div:nth-child(3)", ".first figure svg"):
        box = opened.locator(part).first.bounding_box()
        assert 0 < box["y"] < box["y"] + box["height"] < 800, part
    # No decision is cut off: each is within the part of its table that is seen.
    hidden = opened.evaluate(
        """() => [...document.querySelectorAll("td.mark-good, td.mark-bad")].filter((cell) => {
            if (cell.closest("details:not([open])")) return false;
            const right = (element) => element.getBoundingClientRect().right;
            return right(cell) > right(cell.closest(".wide")); }).length"""
    )
    assert hidden == 0
    if kind == "evaluation":
        assert opened.title().startswith("Evaluation of Arm <script>")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("kind", KINDS)
def test_everybody_can_read_it(shown, kind, scheme):
    """Axe finds nothing serious; it is a script of its own, so that the page's policy is off."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    found = axe.run(shown(kind, 1000, scheme, bypass_csp=True)).response["violations"]
    assert [(rule["id"], rule["nodes"][0]["html"]) for rule in found if rule["impact"] in ("serious", "critical")] == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["calibration", "evaluation"])
def test_the_arm_turns_under_mouse_keys_and_buttons(shown, kind):
    opened = shown(kind, 1600)
    scene = opened.locator("[data-scene]")
    scene.scroll_into_view_if_needed()
    read = lambda: (float(scene.get_attribute("data-turn")), float(scene.get_attribute("data-tilt")))  # noqa: E731
    picture = lambda: opened.evaluate("document.querySelector('[data-scene] svg').innerHTML")  # noqa: E731
    before, drawn = read(), picture()
    box = scene.bounding_box()
    opened.mouse.move(box["x"] + 200, box["y"] + 200)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 300, box["y"] + 250, steps=5)
    opened.mouse.up()
    after = read()
    assert after[0] - before[0] == pytest.approx(0.8, abs=0.01)  # 100 pixels
    assert after[1] - before[1] == pytest.approx(0.4, abs=0.01)
    assert picture() != drawn
    scene.focus()
    opened.keyboard.press("ArrowLeft")
    assert read()[0] == pytest.approx(after[0] - 0.15, abs=1e-3)
    opened.get_by_role("button", name="tilt down").click()
    assert read()[1] == pytest.approx(after[1] - 0.1, abs=1e-3)
    slider = opened.locator(".controls input")
    slider.fill("3")
    assert "pose 3" in opened.locator(".controls output").inner_text()


@pytest.mark.slow
def test_the_mark_under_the_pointer_is_said_and_tab_stops_are_few(shown):
    opened = shown("calibration", 1600)
    axes = opened.locator("[data-chart=residuals] .axes")
    axes.scroll_into_view_if_needed()
    first = json.loads(opened.locator("#points").inner_text())["residuals"][0][0]
    box = axes.locator("> svg").bounding_box()
    opened.mouse.move(box["x"] + first[0] / 1000 * box["width"] + 2, box["y"] + first[1] / 1000 * box["height"])
    assert axes.locator(".tip").inner_text() == first[2]
    opened.mouse.move(5, 5)
    assert axes.locator(".tip").count() == 0
    stops = 0
    while not opened.evaluate("document.activeElement.matches('[data-scene]')"):
        opened.keyboard.press("Tab")
        stops += 1
        assert stops <= 30
    button = opened.locator("table", has=opened.locator("caption", has_text=re.compile("^Bounds$"))).locator(
        "th button"
    )
    opened.locator("summary", has_text="Bounds").click()
    button.first.focus()
    opened.keyboard.press("ArrowRight")
    assert opened.evaluate("document.activeElement.textContent") == "unit"


@pytest.mark.slow
def test_tables_sort_by_click_and_by_keyboard(shown):
    opened = shown("calibration", 1600)
    table = opened.locator("table", has=opened.locator("caption", has_text=re.compile("^Parameters$")))
    column = lambda: [  # noqa: E731
        float(cell.inner_text().replace("−", "-")) for cell in table.locator("tbody tr td:nth-child(3)").all()
    ]
    heading = table.locator("th button", has_text="calibrated")
    heading.click()
    assert column() == sorted(column())
    assert table.locator("th[aria-sort=ascending]").count() == 1
    heading.focus()
    opened.keyboard.press("Enter")
    assert column() == sorted(column(), reverse=True)
    table.locator("th button", has_text=re.compile("^parameter$")).click()
    names = [cell.inner_text() for cell in table.locator("tbody tr td:nth-child(1)").all()]
    assert names == sorted(names)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["calibration", "evaluation", "study"])
def test_it_prints_to_pdf(shown, tmp_path, kind):
    opened = shown(kind, 1600)
    content = opened.pdf(path=tmp_path / "report.pdf", format="A4", print_background=True)
    pages = len(re.findall(rb"/Type\s*/Page\b", content))
    assert 2 <= pages <= 25
    # Heads of tables are repeated, but a button in them is printed once; digests of sources are not listed.
    opened.emulate_media(media="print")
    style = lambda of: opened.evaluate(f"getComputedStyle(document.querySelector({of!r})).display")  # noqa: E731
    assert style("thead") == "table-header-group"
    assert style("thead button") == "contents"
    assert opened.locator(".origin details[open]").count() == 0


@pytest.mark.parametrize("seed", [None, 0])
def test_the_origin_names_a_seed_where_there_is_one(tmp_path, seed):
    (tmp_path / "c.h5").write_bytes(b"")
    attributes = {"created": "2026-01-01", "command": "aacmm calibrate", "package_version": "1", "seed": seed}
    assert dict(_origin(tmp_path / "c.h5", attributes)).get("Seed") == (None if seed is None else ["0"])


# --- Plans and drift ---


@pytest.mark.slow
def test_a_plan_has_a_page_for_the_machine(tmp_path, paper_arm):
    plan = aj.planning.plan(
        paper_arm, sockets={HOSTILE: (400, 200, 300), "B": (700, 500, 500)}, lengths=[(HOSTILE, "B", 0.002)], poses=12,
        noise=aj.Noise(encoder_arcsec=2.0, seating=0.005), candidates=100, seed=1,
    )  # fmt: skip
    written = aj.report.write_plan(tmp_path / "plan.html", plan, "my arm", sources=["arm.toml (SHA-256 0)"])
    found = Page((tmp_path / "plan.html").read_text(encoding="utf-8"))
    assert written["title"] == "Plan of a calibration, my arm"
    assert written["verdict"] in " ".join(found.text.split()) or "A calibration with these 12 poses" in found.text
    assert found.text.count("☐") == 12
    assert HOSTILE in found.text
    scene = json.loads(found.held["scenes"])["scene"]
    np.testing.assert_allclose([pose["points"][-1] for pose in scene["poses"]], paper_arm.position(plan.q), atol=0.06)
    assert [thing["kind"] for thing in scene["things"]] == ["bar"]


def test_the_page_of_an_acceptance_test_has_no_files_that_are_called_as_their_ends():
    headings, row = "pose,test,name,file,x_mm,probe_direction_x", "1,length error,bar1/a,{},1.5,0.1"
    for file, expected in (("bar1/a.csv", []), ("a.csv", ["file"])):
        table = plans._table(f"{headings}\n{row.format(file)}")
        assert table.headings == ["done", "pose", "test", "name", *expected, "x [mm]"]


@pytest.mark.parametrize(
    ("measured", "given", "expected"),
    [
        ("", None, "calculated on 2026-01-31"),
        ("2025-06-30", None, "measured on 2025-06-30"),
        ("2025-06-30", {"item": {"serial_number": "7"}}, "measured on 2025-06-30; serial number 7"),
    ],
)
def test_the_first_page_says_of_what_and_when(measured, given, expected):
    given = given and aj.files.AdministrativeData.model_validate(given)
    assert _identity({"created": "2026-01-31T10:00:00+00:00", "measured": measured}, given) == expected


@pytest.mark.parametrize("bars", [8, 9])
def test_of_many_bars_the_view_shows_one_at_a_time(paper_arm, bars):
    """It knows the bar by the names of its ends, and of each pose the end that it is at."""
    sockets = {f"{bar}{end}": np.full((1, 6), 0.1 * bar + 0.01 * (end == "b")) for bar in range(bars) for end in "ab"}
    lengths = [aj.ReferenceLength(f"{bar}a", f"{bar}b", 10.0, 0.002) for bar in range(bars)]
    view = elements.view_of_arm(paper_arm, aj.Capture(sockets, lengths))
    ends, marks = ([part.get(key) for part in view.data[of]] for key, of in (("ends", "things"), ("mark", "poses")))
    many = bars > 8
    assert ends == [[f"{bar}a", f"{bar}b"] if many else None for bar in range(bars)]
    assert marks == (list(sockets) if many else [None] * 2 * bars)
    assert ("its bar; thin lines" in view.legend[0]) == many


@pytest.mark.parametrize(
    ("verdict", "expected"),
    [
        ("gear is recommended: it predicts.", ("gear is recommended", "It predicts.")),
        ("As predicted: held-out poses.", ("As predicted", "Held-out poses.")),
        ("To be used with care: d_5; more. U is 1.", ("To be used with care", "d_5; more. U is 1.")),
        ("It gives U (k = 2; at worst 3 mm): so. And more.", ("It gives U (k = 2; at worst 3 mm)", "So. And more.")),
        ("Measured; no limit was given.", ("Measured", "No limit was given.")),
        ("x" * 100 + ": y", ("x" * 100 + ": y", "")),
    ],
)
def test_the_headline_of_a_verdict(verdict, expected):
    assert elements.Report("", "", verdict, "good", [], [], None, [], []).headline == expected


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("observation", "kinds"),
    [
        (
            aj.data.observations.Artefact(
                "bar", {"a": (0, 0, 0), "b": (300, 0, 0)}, {"a": [[0.0] * 6], "b": [[1.0] * 6]}
            ),
            "bar",
        ),
        (aj.data.observations.Plane("face", np.random.default_rng(0).normal(size=(8, 6))), "plate"),
    ],
)
def test_what_is_touched_is_drawn(paper_arm, observation, kinds):
    view = elements.view_of_arm(paper_arm, aj.Capture({}, (), [observation]))
    assert kinds in {thing["kind"] for thing in view.data["things"]}
    assert any(words.startswith(f"grey {'bars' if kinds == 'bar' else 'areas'}") for words in view.legend)
