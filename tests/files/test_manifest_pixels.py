"""[[pixels]] in manifests: tables of corners and nested lists, which image belongs to which pose, and bad input."""

import base64
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.camera import detection
from aacmm_jax.data.cameras.camera import camera_models
from aacmm_jax.pipeline.hold_out import held_out_poses, without_held_out
from tests.refusals import assert_refused

TARGET = '[[target]]\nname = "board"\nkind = "charuco"\nsquares = [6, 5]\nsize = 30.0\nmarker = 22.0\n'
CAMERA = '[[camera]]\nname = "webcam"\nimage_size = [640, 480]\n'
PIXELS = '[[pixels]]\ncamera = "webcam"\ntarget = "board"\nfile = "joints.csv"\ncorners = "corners.csv"\n'
KNOWN = TARGET + CAMERA + 'intrinsics = { fx = 600, fy = 610, cx = 319.5, cy = 239.5 }\nu = "exact"\n' + PIXELS
HUGE = b"\xff\xd8\xff\xc0\x00\x0b\x08\xff\xff\xff\xff\x01\x01\x11\x00"  # 65535 x 65535 px
JPEG_OF_HUGE_SIZE = base64.b64encode(HUGE).decode()
JOINTS = [f"q_{i}_deg" for i in range(1, 7)]


@pytest.fixture(scope="module")
def seen():
    board = aj.camera.target_of("charuco", squares=[6, 5], size=30.0, marker=22.0)
    eye = aj.data.observations.SimulatedPixels(
        "eye", 8, "webcam", "board", board.points, (600.0, 610.0, 319.5, 239.5), (640, 480),
        frame=(np.pi, 0, 0, -700, -200, 0), mount=(60, 0, 20, 0, 0, 0), distance=(250, 400), u=0.2,
    )  # fmt: skip
    return aj.simulate(aj.load_arm("ur10e"), {}, observations=[eye], seed=1).observations[0]


def files(tmp_path, seen, *, images=True, first="", order=None, corners="corners.csv"):
    """Write a table of readings and one of corners."""
    order = range(len(seen.q)) if order is None else order
    rows = [",".join([f"img_{i}.png", *map(str, np.degrees(seen.q[i]))]) for i in order]
    rows = rows if images else [row.split(",", 1)[1] for row in rows]
    (tmp_path / "joints.csv").write_text(",".join(["image"] * images + JOINTS) + "\n" + "\n".join(rows) + "\n")
    name = "img_{}.png".format if images else (lambda i: f"{i + 1}")
    lines = [
        f"{name(i)},{seen.ids[i][k]},{u:.6f},{v:.6f}"
        for i in range(len(seen.q))
        for k, (u, v) in enumerate(np.asarray(seen.corners[i]))
    ]
    (tmp_path / corners).write_text("image,id,u,v\n" + first + "\n".join(lines) + "\n")


def read(tmp_path, text=TARGET + CAMERA + PIXELS, changes=()):
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (tmp_path / "capture.toml").write_text('arm = "ur10e"\n' + text)
    return aj.files.read_manifest(tmp_path / "capture.toml")


@pytest.mark.slow
@pytest.mark.parametrize("images", [True, False])
def test_a_table_of_corners_is_read_and_comes_back_from_a_file(tmp_path, seen, images):
    order = [3, 0, 1, 2, *range(4, 8)] if images else None
    files(tmp_path, seen, images=images, order=order)
    recording = read(tmp_path)
    (pixels,) = recording.capture.observations
    expected = np.asarray(seen.corners)[list(order or range(8))]
    np.testing.assert_allclose(pixels.corners, expected, atol=1e-6)
    np.testing.assert_allclose(pixels.points, seen.points)
    assert (pixels.camera, pixels.board, pixels.on_arm, pixels.target) == ("webcam", "board", True, "webcam")
    assert np.all((pixels.u > 0.15) & (pixels.u < 0.25))  # not stated, so by the scatter
    assert [image.corners for image in recording.images] == [20] * 8
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    loaded = aj.files.load_capture(tmp_path / "capture.h5")
    assert loaded.images == recording.images
    for name in ("q", "corners", "points", "u", "intrinsics", "u_intrinsics", "views"):
        np.testing.assert_array_equal(getattr(loaded.capture.observations[0], name), getattr(pixels, name))
    assert loaded.capture.observations[0].ids == pixels.ids


@pytest.mark.slow
def test_a_column_divides_the_images_into_groups(tmp_path, seen):
    """Observations of one camera and one target, which can be held out by name."""
    files(tmp_path, seen)
    lines = (tmp_path / "joints.csv").read_text().splitlines()
    places = ["place", *("left" if i % 3 else "right" for i in range(len(seen.q)))]
    (tmp_path / "joints.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(lines, places, strict=True)))
    recording = read(tmp_path, changes=[('corners = "corners.csv"\n', 'corners = "corners.csv"\ngroup = "place"\n')])
    right, left = recording.capture.observations
    assert [part.name for part in (right, left)] == ["webcam/right", "webcam/left"]
    assert (right.camera, right.board) == (left.camera, left.board) == ("webcam", "board")
    np.testing.assert_allclose(right.corners, np.asarray(seen.corners)[::3], atol=1e-6)
    assert [image.observation for image in recording.images].count("webcam/left") == len(left.q)
    kept = without_held_out(recording.capture, held_out_poses(recording.capture, "webcam/right", None, 0))
    assert [part.name for part in kept.observations] == ["webcam/left"]


@pytest.mark.slow
@pytest.mark.parametrize("lists", ["all", "ids", "points", "plain", "records"])
def test_nested_lists(tmp_path, seen, lists):
    files(tmp_path, seen, images=False)
    corners = np.asarray(seen.corners)[:, :, None, :].tolist()
    points, ids = np.asarray(seen.points).tolist(), [list(row) for row in seen.ids]
    content = {
        "all": {"image_points": corners, "object_points": points, "ids": ids},
        "ids": {"corners": corners, "ids": ids},
        "points": {"imgpoints": corners, "objpoints": points},
        "plain": corners,
        "records": [{"image": f"{i}", "ids": ids[i], "image_points": corners[i]} for i in range(len(ids))],
    }[lists]
    (tmp_path / "corners.json").write_text(json.dumps(content))
    (pixels,) = read(tmp_path, KNOWN, [("corners.csv", "corners.json")]).capture.observations
    np.testing.assert_allclose(pixels.corners, seen.corners)
    np.testing.assert_allclose(pixels.points, seen.points)


@pytest.mark.slow
def test_absent_corners_and_images(tmp_path, seen):
    files(tmp_path, seen)
    lines = (tmp_path / "corners.csv").read_text().splitlines()
    few = [line for line in lines if not line.startswith("img_7.png") or line.split(",")[1] in ("1", "2", "3")]
    kept = [line for line in few if not line.startswith("img_4.png,5,")]
    (tmp_path / "corners.csv").write_text("\n".join([*kept, "other.png,1,10,10"]) + "\n")
    recording = read(tmp_path)
    (pixels,) = recording.capture.observations
    assert pixels.corners.shape == (7, 20, 2)
    assert pixels.seen.sum(axis=1).tolist() == [20] * 4 + [19] + [20] * 2
    refused = {image.image: image.refused for image in recording.images if image.refused}
    assert refused.keys() == {"img_7.png", "other.png"}
    assert "3 corners" in refused["img_7.png"]
    assert "no row" in refused["other.png"]
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    assert aj.files.load_capture(tmp_path / "capture.h5").capture.observations[0].ids == pixels.ids


@pytest.mark.slow
def test_what_is_known_of_the_camera(tmp_path, seen):
    files(tmp_path, seen)
    stated = "intrinsics = { fx = 600, fy = 610, cx = 319.5, cy = 239.5 }\nu = { fx = 2.0, fy = 2.0 }\n"
    (pixels,) = read(tmp_path, TARGET + CAMERA + stated + PIXELS).capture.observations
    assert pixels.intrinsics.tolist() == [600, 610, 319.5, 239.5]
    assert pixels.u_intrinsics.tolist() == [2, 2, 0, 0]
    info = "image_width: 640\nimage_height: 480\nk: [600, 0, 320, 0, 610, 240, 0, 0, 1]\nd: [0, 0, 0, 0, 0]\n"
    (tmp_path / "info.yaml").write_text(info)
    (pixels,) = read(tmp_path, TARGET + CAMERA + 'file = "info.yaml"\nu = "exact"\n' + PIXELS).capture.observations
    assert pixels.intrinsics.tolist() == [600, 610, 320, 240, 0, 0, 0, 0, 0]
    assert not pixels.u_intrinsics.any()


BAR = "bar = { nominal = 150.0, measured = 150.3, u = 0.05 }\n"


@pytest.mark.slow
def test_a_measured_bar_scales_the_points(tmp_path, seen):
    files(tmp_path, seen)
    (pixels,) = read(tmp_path, TARGET + BAR + CAMERA + PIXELS).capture.observations
    np.testing.assert_allclose(pixels.points, 1.002 * np.asarray(seen.points))
    assert pixels.u_scale == pytest.approx(0.05 / 150)


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ([("size = 30.0", "size = 0.03"), ("marker = 22.0", "marker = 0.022")], ["mm", "0.03"]),
        ([("squares = [6, 5]", "squares = [5, 5]")], ["img_0.png", "point id 16", "0 to 15"]),
        ([("[640, 480]", "[320, 240]")], ["outside of the image", "320 x 240"]),
        ([('target = "board"', 'target = "bord"')], ["'bord'", "did you mean 'board'"]),
        ([('camera = "webcam"', 'camera = "web"')], ["'web'", "did you mean 'webcam'"]),
        ([("[640, 480]\n", '[640, 480]\nmodel = "pinhol"\n')], ["pinhol", "pinhole"]),
        ([("[640, 480]\n", "[640, 480]\nintrinsics = { fx = 600 }\n")], ["fy, cx, cy"]),
        ([("[640, 480]\n", "[640, 480]\nintrinsics = { f = 600 }\n")], ["no 'f'"]),
        ([("[640, 480]\n", '[640, 480]\nu = "exact"\n')], ["not given"]),
        ([("[640, 480]\n", "[640, 480]\nintrinsics = { fx = 600, fy = 600, cx = 320, cy = 240, k1 = -40 }\n"
                           'u = "exact"\n')], ["folds"]),
        ([('corners = "corners.csv"\n', "")], ["images or corners"]),
        ([('kind = "charuco"', 'kind = "charuko"')], ["charuco"]),
    ],
)  # fmt: skip
def test_a_manifest_that_makes_no_sense_is_refused(tmp_path, seen, changes, parts):
    files(tmp_path, seen)
    assert_refused(lambda: read(tmp_path, changes=changes), *parts)


@pytest.mark.parametrize(
    ("table", "old", "new", "parts"),
    [
        ("joints.csv", "img_1.png", "img_2.png", ["rows 2 and 3", "img_2.png"]),
        ("joints.csv", "img_1.png", "img_99.png", ["row 2", "img_99.png"]),
        ("corners.csv", "img_1.png,3", "img_1.png,4", ["img_1.png", "point id 4 twice"]),
        ("corners.csv", "img_1.png,3", "img_1.png,3.5", ["3.5"]),
        ("corners.csv", "image,id,u,v", "image,id,a,b", ["corner_columns"]),
    ],
)
def test_tables_that_make_no_sense_are_refused(tmp_path, seen, table, old, new, parts):
    files(tmp_path, seen)
    text = (tmp_path / table).read_text()
    assert old in text
    (tmp_path / table).write_text(text.replace(old, new, 1))
    assert_refused(lambda: read(tmp_path), *parts)


@pytest.mark.parametrize("squares", [[9, 8], [5, 6]], ids=["larger", "turned"])
def test_corners_that_cannot_be_those_of_the_target_are_refused(tmp_path, seen, squares):
    files(tmp_path, seen)
    changes = [("squares = [6, 5]", f"squares = {squares}")]
    assert_refused(lambda: read(tmp_path, KNOWN, changes), "img_0.png", "another target, its rows and columns")


@pytest.mark.slow
def test_columns_named_as_the_joints_of_a_urdf_are_the_readings(tmp_path, seen):
    """In any order, beside other columns of numbers; the arm of this URDF need not fit the images."""
    names = ["pan", "lift", "elbow", "roll", "pitch", "yaw"]
    links = "".join(f'<link name="l{i}"/>' for i in range(7))
    joints = "".join(
        f'<joint name="{name}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<origin xyz="0.1 0 0.3"/><axis xyz="0 {i % 2} {1 - i % 2}"/></joint>'
        for i, name in enumerate(names)
    )
    (tmp_path / "robot.urdf").write_text(f'<robot name="r">{links}{joints}</robot>')
    files(tmp_path, seen)
    table = (tmp_path / "joints.csv").read_text().splitlines()
    cells = [row.split(",") for row in table[1:]]
    header = ",".join(["image", "speed", *(f"{name} [deg]" for name in reversed(names))])
    rows = [",".join([image, "7", *reversed(q)]) for image, *q in cells]
    (tmp_path / "joints.csv").write_text("\n".join([header, *rows]) + "\n")
    (tmp_path / "capture.toml").write_text('arm = "robot.urdf"\n' + TARGET + CAMERA + PIXELS)
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    np.testing.assert_allclose(recording.capture.observations[0].q, seen.q, atol=1e-12)


def line(image, i, u, v):
    return f"{image},{i},{u},{v}"


LARGER = KNOWN.replace("319.5", "959.5").replace("239.5", "539.5").replace("[640, 480]", "[1920, 1080]")
FEW, ON_A_LINE, BEHIND = "only 3 corners", "its 5 corners are on one line", "the board is seen from behind"


@pytest.mark.first_rows(3)
@pytest.mark.parametrize(
    ("change", "text", "parts"),
    [
        (lambda *row: line(*row) if row[1] < 3 else "", KNOWN, [FEW, "'img_0.png' and 7 more"]),
        (lambda *row: line(*row) if row[1] < 5 else "", KNOWN, [ON_A_LINE, "'img_0.png' and 7 more"]),
        (lambda image, i, u, v: line(image, i, 639 - u, v), KNOWN, [BEHIND, "'img_0.png' and 7 more"]),
        (line, LARGER.replace("600", "1800").replace("610", "1830"), ["RMS, and others (fx = ", "another image size"]),
    ],
    ids=["few corners", "on one line", "mirrored", "intrinsics of another image size"],
)
def test_corners_that_show_no_view_are_refused(tmp_path, seen, change, text, parts):
    files(tmp_path, seen)
    head, *rows = (tmp_path / "corners.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    changed = [change(image, int(i), float(u), float(v)) for image, i, u, v in cells]
    (tmp_path / "corners.csv").write_text("\n".join([head, *filter(None, changed)]) + "\n")
    assert_refused(lambda: read(tmp_path, text), *parts)


def test_images_of_another_size_than_the_intrinsics_are_refused(tmp_path):
    pytest.importorskip("cv2")
    part_of_example(tmp_path, 2)
    text = (tmp_path / "webcam.toml").read_text()
    (tmp_path / "webcam.toml").write_text(text.replace("[640, 480]", "[1280, 720]"))
    said = "it has 640 x 480 px, but the intrinsics of the camera are for 1280 x 720 px"
    assert_refused(lambda: aj.files.read_manifest(tmp_path / "webcam.toml"), said, "'webcam/01.jpg' and 1 more")


@pytest.mark.parametrize("model", ["pinhole", "fisheye"])
def test_points_behind_a_camera_are_not_seen(model):
    """In space, where no image shows them; at the edge, the distortion folds."""
    camera, lens = camera_models()[model], np.array([600.0, 610, 320, 240, -0.3, 0, 0, 0])
    points = np.array([[0.0, 0, 500], [10, 20, -500], [2000, 0, 400 if model == "pinhole" else -1]]).T
    assert camera.folded(points, lens).tolist() == [False, True, True]


def test_two_images_of_one_pose_are_refused(tmp_path, seen):
    files(tmp_path, seen, order=[0, *range(1, 8)])
    lines = (tmp_path / "joints.csv").read_text().splitlines()
    lines[2] = lines[2].split(",", 1)[0] + "," + lines[1].split(",", 1)[1]
    (tmp_path / "joints.csv").write_text("\n".join(lines) + "\n")
    assert_refused(lambda: read(tmp_path), "img_0.png", "img_1.png", "same joint readings")


@pytest.mark.slow
def test_as_many_poses_as_images(tmp_path, seen):
    files(tmp_path, seen, images=False)
    lines = (tmp_path / "corners.csv").read_text().splitlines()
    named = [lines[0], *(f"frame_{line}" for line in lines[1:])]
    (tmp_path / "corners.csv").write_text("\n".join(named) + "\n")
    np.testing.assert_allclose(read(tmp_path, KNOWN).capture.observations[0].corners, seen.corners, atol=1e-6)
    kept = [line for line in named if not line.startswith("frame_5,")]
    (tmp_path / "corners.csv").write_text("\n".join(kept) + "\n")
    assert_refused(lambda: read(tmp_path), "7 images and 8 poses")


EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "webcam"


def part_of_example(folder, count):
    """The first images of the rendered example, with their readings, which are returned, and its manifest."""
    (folder / "webcam").mkdir()
    for image in sorted((EXAMPLE / "webcam").iterdir())[:count]:
        shutil.copy(image, folder / "webcam")
    rows = (EXAMPLE / "webcam.csv").read_text().splitlines()[: count + 1]
    (folder / "webcam.csv").write_text("\n".join(rows) + "\n")
    shutil.copy(EXAMPLE / "webcam.toml", folder)
    return rows


@pytest.mark.slow
def test_corners_are_detected_once_where_readings_are_commanded_and_measured(tmp_path, monkeypatch):
    """The manifest is read again with the other readings."""
    pytest.importorskip("cv2")
    head, *rows = part_of_example(tmp_path, 2)
    names = head.split(",")[1:]
    both = [",".join(name.replace("_deg", f"_{role}_deg") for name in names) for role in ("cmd", "meas")]
    twice = [f"{row},{','.join(str(float(number) + 0.1) for number in row.split(',')[1:])}" for row in rows]
    (tmp_path / "webcam.csv").write_text("\n".join([f"image,{both[0]},{both[1]}", *twice]) + "\n")
    known = '[640, 480]\nu = "exact"\nintrinsics = { fx = 612, fy = 614, cx = 322, cy = 237, k1 = 0.08, k2 = -0.15 }'
    text = (tmp_path / "webcam.toml").read_text().replace("[640, 480]", known)
    text += 'columns = { q = ["q_*_meas_deg"] }\n'
    (tmp_path / "webcam.toml").write_text(text)
    detected, detect = [], detection.detect
    monkeypatch.setattr(detection, "detect", lambda *given, **named: detected.append(1) or detect(*given, **named))
    recording = aj.files.read_manifest(tmp_path / "webcam.toml")
    assert recording.other_readings.role == "commanded"
    assert len(recording.other_readings.capture.observations[0].q) == len(detected) == 2


@pytest.mark.slow
def test_a_damaged_image_and_one_of_too_many_pixels_are_not_used(tmp_path):
    """A sentence for each; the others are used."""
    cv2 = pytest.importorskip("cv2")
    part_of_example(tmp_path, 5)
    images = sorted((tmp_path / "webcam").iterdir())
    images[3].write_bytes(images[3].read_bytes()[:3000])
    bomb = cv2.imencode(".png", np.zeros((12_000, 12_000), dtype=np.uint8))[1].tobytes()
    images[4].write_bytes(bomb)
    recording = aj.files.read_manifest(tmp_path / "webcam.toml")
    assert [image.corners > 0 for image in recording.images] == [True] * 3 + [False] * 2
    for image in recording.images[3:]:
        assert image.refused == "is not an image that OpenCV reads, is damaged, or has more than 120 million px"


@pytest.mark.slow
def test_images_are_read_and_drawn(tmp_path):
    cv2 = pytest.importorskip("cv2")
    rows = part_of_example(tmp_path, 3)
    cv2.imwrite(str(tmp_path / "webcam" / "03.jpg"), np.full((480, 640), 128, dtype=np.uint8))  # nothing in it
    shown = []

    def progress(items, what):
        shown.append((len(items), what))
        return items

    overlays = tmp_path / "overlays"
    recording = aj.files.read_manifest(tmp_path / "webcam.toml", progress=progress, overlays=overlays)
    assert shown == [(3, "Detecting corners")]
    assert [image.corners > 0 for image in recording.images] == [True] * 2 + [False]
    assert recording.images[2].refused
    assert recording.capture.observations[0].images == tuple(f"webcam/{row[:6]}" for row in rows[1:3])
    assert len([cv2.imread(str(path)).shape for path in overlays.iterdir()]) == 3
    for image in recording.images:  # those refused too
        small = cv2.imdecode(np.frombuffer(base64.b64decode(image.preview), np.uint8), cv2.IMREAD_UNCHANGED)
        assert small.shape == (240, 320)
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    assert aj.files.load_capture(tmp_path / "capture.h5").images == recording.images


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("picture", ["no base64!", "aGVsbG8=", JPEG_OF_HUGE_SIZE], ids=["text", "no JPEG", "huge"])
def test_a_picture_in_a_file_that_a_browser_should_not_decode_is_refused(tmp_path, seen, picture):
    files(tmp_path, seen)
    recording = read(tmp_path, KNOWN)
    recording = recording._replace(images=(recording.images[0]._replace(preview=picture), *recording.images[1:]))
    aj.files.save_capture(tmp_path / "capture.h5", recording)
    assert_refused(lambda: aj.files.load_capture(tmp_path / "capture.h5"), "not a small JPEG")
