"""Figures of cameras: each shows the numbers of its record."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.reprojection import reprojection
from aacmm_jax.data.cameras.camera import camera_models
from aacmm_jax.plot import cameras
from tests.refusals import assert_refused

ARROW = 7  # points of the path of one


@pytest.fixture
def image(camera_record):
    [image] = cameras.images_of(camera_record)
    return image


def arrows(marks):
    """Starts and steps of arrows, as they are drawn."""
    path = np.column_stack([marks.x, marks.y]).reshape(-1, ARROW, 2)
    return path[:, 0], path[:, 1] - path[:, 0]


def magnification(plot):
    return float(plot.title.split()[1])


@pytest.mark.slow
def test_coverage_counts_every_corner(image):
    chart = cameras.coverage_chart(image)
    marks = chart.plots[0].marks[-1]
    counts = [int(words.split()[0]) for words in marks.words]
    assert sum(counts) == len(image.corners) == 72
    for x, y, count, shade in zip(marks.x, marks.y, counts, marks.shade, strict=True):
        inside = np.all(np.abs(image.corners - [x, y]) <= np.array(marks.box) / 2, axis=1)
        assert inside.sum() == count
        assert marks.limits[shade] <= count < marks.limits[shade + 1]


@pytest.mark.slow
def test_residual_arrows_end_where_corners_were_seen(camera_record, image):
    chart = cameras.residual_chart(image)
    [plot] = chart.plots
    starts, steps = arrows(plot.marks[1])
    assert len(starts) == len(image.corners)  # none is far
    assert starts + steps / magnification(plot) == pytest.approx(image.corners)
    [observation] = camera_record.recording.capture.observations
    seen = reprojection(camera_record.calibrated.arm, observation, camera_record.observed.geometry)
    assert np.sqrt(np.mean(np.sum(steps**2, axis=1))) / magnification(plot) == pytest.approx(seen.rms)
    assert f"Root mean square {seen.rms:.3g} px" in chart.description
    assert [row[0].text for row in chart.table.cells] == [f"images, pose {i + 1}" for i in range(12)]


@pytest.mark.slow
def test_far_residuals_have_a_tone_of_their_own(image):
    residuals = image.residuals.copy()
    residuals[5] = 40.0
    marks = cameras.residual_chart(image._replace(residuals=residuals)).plots[0].marks
    starts, _ = arrows(marks[2])
    assert marks[2].tone == "accent"
    assert starts == pytest.approx(image.corners[5:6] - 40.0)


@pytest.mark.slow
def test_pictures_go_from_the_largest_residuals_to_the_smallest(image):
    assert cameras.picture_charts(image) == []
    shown = image._replace(pictures=["", *(f"{i}" for i in range(1, 12))], refused=[("x", "13: it is too dark")])
    [used, refused] = cameras.picture_charts(shown)
    rms = [float(plot.title.split(": ")[1].removesuffix(" px RMS")) for plot in used.plots]
    assert rms == sorted(rms, reverse=True)
    assert len(used.plots) == 6
    for plot in used.plots:  # the arrows are those of the image whose picture is shown
        starts, steps = arrows(plot.marks[1])
        own = image.owner == int(plot.picture)
        factor = float(used.description.split()[-4])
        assert starts + steps / factor == pytest.approx(image.corners[own])
    [plot] = refused.plots
    assert (plot.picture, plot.title) == ("x", "13: it is too dark")


@pytest.mark.slow
def test_distortion_is_what_takes_ideal_pixels_to_distorted_ones(image):
    [plot] = cameras.distortion_chart(image).plots
    nodes, steps = arrows(plot.marks[1])
    shift = steps / magnification(plot)
    model, numbers = camera_models()[image.model.name], image.intrinsics[:, None]
    plane = (nodes - shift - image.intrinsics[2:4]) / image.intrinsics[:2]
    if model.name == "fisheye":  # the angle from the axis is the distance in an ideal image
        angle = np.linalg.norm(plane, axis=1)
        points = np.column_stack([plane * (np.sin(angle) / angle)[:, None], np.cos(angle)])
    else:
        points = np.column_stack([plane, np.ones(len(plane))])
    distorted = model.project(points.T, numbers).values.T
    assert distorted == pytest.approx(nodes, abs=0.02)
    assert cameras.distortion_chart(image._replace(intrinsics=image.intrinsics[:4])) is None


@pytest.mark.slow
def test_shapes_are_where_camera_and_target_are(camera_record, image):
    """The apex of the pyramid is the camera's centre, its corners appear at those of the image, and those of the
    outline among the corners that were seen."""
    arm, geometry = camera_record.calibrated.arm, camera_record.observed.geometry
    [observation] = camera_record.recording.capture.observations
    moving, still = cameras.shapes_of(arm, observation, geometry)
    seen = reprojection(arm, observation, geometry)
    views, outlines = (moving, still) if observation.on_arm else (np.broadcast_to(still, (12, *still.shape)), moving)
    outlines = np.broadcast_to(outlines, (12, *outlines.shape[-2:]))
    for pose in range(12):
        view, outline = ((part[pose] - seen.camera[pose, :3, 3]) @ seen.camera[pose, :3, :3] for part in
                         (views, outlines))  # fmt: skip
        assert view[0] == pytest.approx(np.zeros(3), abs=1e-9)
        ends = image.model.project(view[[1, 2, 5, 8]].T, image.intrinsics[:, None]).values.T
        assert ends == pytest.approx(np.array([(-0.5, -0.5), (639.5, -0.5), (639.5, 479.5), (-0.5, 479.5)]), abs=1e-3)
        corners = image.model.project(outline[:4].T, image.intrinsics[:, None]).values.T
        assert corners == pytest.approx(seen.measured[pose][[0, 2, 5, 3]], abs=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["camera_coverage", "camera_residuals", "camera_distortion", "camera_poses"])
def test_figures(camera_record, record_without_cameras, name):
    figure = getattr(aj.plot, name)
    axes = figure(camera_record)
    assert axes.has_data()
    if name != "camera_poses":
        margin = 40 if name == "camera_distortion" else 0  # for its arrows: a cell
        assert axes.get_xlim() == (-0.5 - margin, 639.5 + margin)
        assert axes.get_ylim() == (479.5 + margin, -0.5 - margin)
        assert_refused(lambda: figure(camera_record, "phone"), "no camera 'phone'", "webcam")
    assert_refused(lambda: figure(record_without_cameras), "has no camera", "pixels")


@pytest.fixture
def record_without_cameras(camera_record):
    recording = camera_record.recording
    return camera_record._replace(recording=recording._replace(capture=aj.Capture({"A": np.zeros((1, 6))})))
