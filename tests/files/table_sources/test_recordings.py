"""Recordings of ROS 1 and 2: poses matched with what was measured, corners, robot_calibration's, clocks, damage."""

import cv2
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.files.table_sources import recordings
from aacmm_jax.files.text_table import TextTable
from tests.conftest import command_line
from tests.files.table_sources.damage import refused_when_damaged
from tests.files.table_sources.ros_recordings import CALIBRATION, KINDS, TAGS, Recorder, record
from tests.refusals import assert_refused

POSES = np.random.default_rng(3).uniform(-1.2, 1.2, (5, 6))
TRACKED = {
    "point": "[[points]]\n",
    "pose": "[[transforms]]\nu_angle = 0.001\n",
    "tf": '[[transforms]]\nu_angle = 0.001\ntable = "/tf:tool"\n',
}


def read(folder, path, table, more=""):
    (folder / "capture.toml").write_text(f'arm = "ur10e"\n{table}file = "{path.name}"\n{more}')
    return aj.files.read_manifest(folder / "capture.toml")


@pytest.mark.slow
@pytest.mark.parametrize("tracker", TRACKED)
@pytest.mark.parametrize("kind", KINDS)
def test_poses_are_matched_with_the_tracker(tmp_path, kind, tracker):
    path, _ = record(tmp_path, kind, "ur10e", POSES, tracker=tracker)
    recording = read(tmp_path, path, TRACKED[tracker], 'target = "ball"\n')
    (seen,) = recording.capture.observations
    np.testing.assert_allclose(seen.q, POSES, atol=2e-6)
    frames = np.asarray(aj.load_arm("ur10e").pose(POSES))
    np.testing.assert_allclose(seen.points, frames[:, :3, 3], atol=0.02)  # 10 um in each sample
    if tracker != "point":
        np.testing.assert_allclose(seen.rotations, frames[:, :3, :3], atol=2e-5)
    (note,) = recording.notes
    where = "/tf:tool" if tracker == "tf" else "/tracker"
    assert note == f"{path.name}: 5 poses in which the arm stood still, 5 of them with {where}"


@pytest.mark.slow
def test_u_is_the_standard_deviation_of_the_mean(tmp_path):
    path, _ = record(tmp_path, "mcap", "ur10e", POSES, noise=1e-4)
    (seen,) = read(
        tmp_path, path, "[[points]]\n", 'target = "ball"\ncolumns = { u = ["u_x", "u_y", "u_z"] }\n'
    ).capture.observations
    count = 18  # of 25 samples a second, in a standstill without half a window at either end
    u = np.sqrt(np.diagonal(np.asarray(seen.covariance), axis1=1, axis2=2))
    assert np.median(u) == pytest.approx(0.1 / np.sqrt(count), rel=0.3)


@pytest.mark.slow
def test_sockets_need_joint_states_only(tmp_path):
    path, _ = record(tmp_path, "sqlite3", "ur10e", POSES, tracker="none")
    recording = read(tmp_path, path, "[[socket]]\n")
    np.testing.assert_allclose(recording.capture.sockets["session"], POSES, atol=2e-6)
    assert recording.notes == ("session: 5 poses in which the arm stood still",)
    shown = command_line(tmp_path, "import", "capture.toml", "-o", "capture.h5").stdout
    assert "session: 5 poses in which the arm stood still." in shown.replace("\n", " ")


def test_a_single_file_of_a_recording_is_enough(tmp_path):
    path, _ = record(tmp_path, "mcap", "ur10e", POSES, tracker="none")
    assert TextTable(path / "session.mcap").length == len(POSES)


@pytest.mark.slow
def test_several_trackers_are_named(tmp_path):
    def second(bag, t, q):
        for time in t[::5]:
            bag.write("/second", time, bag.stamped("geometry_msgs/msg/PointStamped", time, point=bag.point([1, 2, 3])))

    path, _ = record(tmp_path, "mcap", "ur10e", POSES, extra=second)
    table = TextTable(path)
    assert {"/tracker x [m]", "/second z [m]"} <= set(table.header)
    assert "x [m]" in TextTable(path, tables=["/second"]).header
    more = 'target = "ball"\ncolumns = { points = ["/second x", "/second y", "/second z"] }\n'
    (seen,) = read(tmp_path, path, "[[points]]\n", more).capture.observations
    np.testing.assert_allclose(seen.points, [[1000, 2000, 3000]] * 5)


def corner_files(kind, folder, board, camera, arm_name):
    """Corners of tags that a camera on the arm sees in each pose."""
    eye = aj.data.observations.SimulatedPixels(
        "eye", 6, "webcam", "board", board.points, camera, (640, 480),
        frame=(np.pi, 0, 0, -700, -200, 0), mount=(60, 0, 20, 0, 0, 0), distance=(250, 400), u=0.2,
    )  # fmt: skip
    seen = aj.simulate(aj.load_arm(arm_name), {}, observations=[eye], seed=1).observations[0]
    order = np.argsort(recordings._CORNERS)

    def tags(bag, t, q):
        poses = np.asarray(seen.q)
        for time, readings in zip(t[::3], q[::3], strict=True):
            i = int(np.abs(poses - readings).max(axis=1).argmin())
            corners = dict(zip(np.asarray(seen.ids[i]).tolist(), np.asarray(seen.corners[i]).tolist(), strict=True))
            detections = []
            for tag in sorted({key // 4 for key in corners}):
                of_tag = [corners.get(4 * tag + k) for k in range(4)]
                if None not in of_tag:
                    points = [
                        bag.make("apriltag_msgs/msg/Point", x=of_tag[k][0], y=of_tag[k][1])
                        for k in np.array(recordings._CORNERS)
                    ]
                    detections.append(bag.make("apriltag_msgs/msg/AprilTagDetection", id=tag, corners=points))
            array = bag.stamped("apriltag_msgs/msg/AprilTagDetectionArray", time, detections=detections)
            bag.write("/tags", time, array)

    assert order.tolist() == list(recordings._CORNERS)
    path, _ = record(folder, kind, arm_name, np.asarray(seen.q), tracker="none", extra=tags)
    return path, seen


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["rosbag1", "mcap"])
def test_corners_of_tags_are_pixels(tmp_path, kind):
    board = aj.camera.target_of("tags", tags=[3, 2], size=30.0, gap=9.0, dictionary="apriltag_36h11")
    path, seen = corner_files(kind, tmp_path, board, (600.0, 610.0, 319.5, 239.5), "ur10e")
    (tmp_path / "capture.toml").write_text(
        'arm = "ur10e"\n[[target]]\nname = "board"\nkind = "tags"\ntags = [3, 2]\nsize = 30.0\ngap = 9.0\n'
        'dictionary = "apriltag_36h11"\n[[camera]]\nname = "webcam"\nimage_size = [640, 480]\n'
        f'[[pixels]]\ncamera = "webcam"\ntarget = "board"\nfile = "{path.name}"\ncorners = "{path.name}"\n'
    )
    recording = aj.files.read_manifest(tmp_path / "capture.toml")
    (pixels,) = recording.capture.observations
    np.testing.assert_allclose(pixels.q, seen.q, atol=2e-6)
    for i in range(len(seen.q)):
        np.testing.assert_array_equal(pixels.ids[i], seen.ids[i])
        np.testing.assert_allclose(pixels.corners[i], np.asarray(seen.corners[i])[np.argsort(seen.ids[i])], atol=1e-9)
    assert len(recording.notes) == 2


def test_apriltags_corners_begin_at_another_one_than_those_of_opencv():
    """apriltag 3 finds this marker of OpenCV, from (200, 150) to (400, 350), with the corners in this order."""
    of_apriltag = np.array([[399.9, 149.9], [199.9, 149.9], [199.9, 349.9], [399.9, 349.9]])
    image = np.full((600, 600), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image[150:350, 200:400] = cv2.aruco.generateImageMarker(dictionary, 7, 200)
    corners, _, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(image)
    np.testing.assert_allclose(corners[0][0][list(recordings._CORNERS)], of_apriltag, atol=1.0)


def calibration_data(folder, kind, sensors):
    """robot_calibration's messages: one for each pose."""
    names = [f"joint_{i}" for i in range(1, 7)]
    rng = np.random.default_rng(0)
    points = {sensor: rng.uniform(-1, 1, (len(POSES), count, 3)) for sensor, count in sensors.items()}
    with Recorder(folder, kind, CALIBRATION) as bag:
        for i, q in enumerate(POSES):
            state = bag.stamped("sensor_msgs/msg/JointState", i + 1.0, name=names, position=q)
            observations = [
                bag.make(
                    "robot_calibration_msgs/msg/Observation",
                    sensor_name=sensor,
                    features=[
                        bag.stamped("geometry_msgs/msg/PointStamped", i + 1.0, point=bag.point(point))
                        for point in points[sensor][i]
                    ],
                )
                for sensor in sensors
            ]
            message = bag.make(
                "robot_calibration_msgs/msg/CalibrationData", joint_states=state, observations=observations
            )
            bag.write("/calibration_data", i + 1.0, message)
    return bag.path, points


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_robot_calibration_has_poses_and_points(tmp_path, kind):
    path, points = calibration_data(tmp_path, kind, {"camera": 12, "led": 1})
    recording = read(tmp_path, path, "[[points]]\n", 'table = "/calibration_data:led"\ntarget = "led"\n')
    (seen,) = recording.capture.observations
    np.testing.assert_allclose(seen.q, POSES)
    np.testing.assert_allclose(seen.points, 1e3 * points["led"][:, 0], rtol=1e-12)
    assert recording.notes[0].endswith("5 poses, 5 of them with /calibration_data:led")
    for dimension, scale in ((3, 1e3), (2, 1.0)):
        corners = TextTable(path, tables=["/calibration_data:camera"], corners=dimension)
        assert corners.length == 5 * 12
        numbers = corners.numbers(range(2 + dimension))
        np.testing.assert_array_equal(numbers[:, :2].T, np.add(np.indices((5, 12)).reshape(2, -1), [[1], [0]]))
        np.testing.assert_allclose(numbers[:, 2:], scale * points["camera"].reshape(-1, 3)[:, :dimension], rtol=1e-12)


def waving(bag, t, q):
    for i, time in enumerate(np.arange(0.0, 20.0, 0.02)):
        bag.joints("/joint_states", 1000 + time, ["a1", "a2"], np.sin([time, 2 * time + i % 2 * 1e-5]))


def nothing(bag, t, q):
    bag.write("/chatter", 1.0, bag.make("std_msgs/msg/String", data="hello"))


def build(folder, extra, **options):
    with Recorder(folder, "mcap", TAGS) as bag:
        extra(bag, None, None)
    return bag.path


def while_moving(bag, t, q):
    for time in (1001.3, 1001.4, 1001.5):
        bag.write("/tracker", time, bag.stamped("geometry_msgs/msg/PointStamped", time, point=bag.point([1, 2, 3])))


def two_arms(bag, t, q):
    for i in range(100):
        for topic in ("/left/joint_states", "/right/joint_states"):
            bag.joints(topic, 1000 + i / 50, ["j1"], [0.0])


REFUSED = {
    "clocks": (lambda d: record(d, "mcap", "ur10e", POSES, late=3600.0)[0], {}, ["clocks do not overlap", "/tracker"]),
    "moving only": (lambda d: record(d, "mcap", "ur10e", POSES[:2], tracker="none", extra=while_moving)[0], {},
                    ["no measurement of /tracker in any of the 2 poses", "the same clock"]),
    "topic": (lambda d: record(d, "mcap", "ur10e", POSES[:2])[0], {"tables": ["/x"]},
              ["no topic '/x'", "/joint_states (JointState)", "/tracker (PointStamped)"]),
    "moving": (lambda d: build(d, waving), {}, ["no pose in which the arm stood still", "stand for a second"]),
    "joints": (lambda d: build(d, nothing), {}, ["no topic of joint states", "/chatter (std_msgs/msg/String)"]),
    "two arms": (lambda d: build(d, two_arms), {}, ["several topics", "add table = '/left/joint_states'"]),
    "corners": (lambda d: record(d, "mcap", "ur10e", POSES[:2])[0], {"corners": 2}, ["no topic of corners"]),
    "sensors": (lambda d: calibration_data(d, "mcap", {"a": 3, "b": 3})[0], {"corners": 2}, ["add corner_table"]),
}  # fmt: skip


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("case", REFUSED)
def test_what_is_missing_is_one_sentence(tmp_path, case):
    make, options, parts = REFUSED[case]
    path = make(tmp_path)
    assert_refused(lambda: TextTable(path, **options), path, *parts)


def test_a_folder_of_something_else_is_refused(tmp_path):
    assert_refused(lambda: TextTable(tmp_path), tmp_path, "is a folder with 0 files", "ROS 2 recording")


def test_messages_without_a_time_have_that_of_the_recorder(tmp_path):
    def unstamped(bag, t, q):
        for time in t[::5]:
            message = bag.stamped("geometry_msgs/msg/PointStamped", 0.0, point=bag.point([1, 2, 3]))
            bag.write("/plain", time, message)

    path, _ = record(tmp_path, "rosbag1", "ur10e", POSES, tracker="none", extra=unstamped)
    assert TextTable(path).note.endswith("5 of them with /plain")


@pytest.mark.slow
def test_a_definition_in_a_recording_cannot_run_code(tmp_path):
    """rosbags makes Python code of definitions, with the names in them."""
    path, _ = corner_files("mcap", tmp_path, aj.camera.target_of("tags", tags=[3, 2], size=30.0, gap=9.0,
        dictionary="apriltag_36h11"), (600.0, 610.0, 319.5, 239.5), "ur10e")  # fmt: skip
    file = path / "session.mcap"
    content = file.read_bytes()
    assert b"float32 goodness" in content
    members = {"session.mcap": content.replace(b"float32 goodness", b"float32 good\x0aess)")}
    with pytest.raises(Exception, match=r".+"):
        recordings.read(members, [], 2)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_compressed_recordings(tmp_path, kind):
    zstd = pytest.importorskip("backports.zstd")  # of rosbags, before Python 3.14
    path, _ = record(tmp_path, kind, "ur10e", POSES[:3])
    for file in [path] if kind == "rosbag1" else list(path.glob("session.*")):
        packed = file.with_name(f"{file.name}.zstd")
        packed.write_bytes(zstd.compress(file.read_bytes()))
        assert TextTable(packed).length == 3
    bomb = tmp_path / "bomb.db3.zstd"
    bomb.write_bytes(zstd.compress(bytes(2**20)) * 300)
    assert_refused(lambda: TextTable(bomb), bomb, "unpacks to more than 256 MiB")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damage_is_one_sentence_or_another_table(tmp_path, kind):
    path, _ = record(tmp_path, kind, "ur10e", POSES[:3])
    assert len(refused_when_damaged(path if kind == "rosbag1" else next(path.glob("session.[dm]*")), bits=20)) > 5
