"""Recordings of ROS made with rosbags: an arm that goes from pose to pose and stands there, seen by a tracker."""

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

import aacmm_jax as aj

TREE = {"tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n"}
TAGS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": "string family\nint32 id\nint32 hamming\nfloat32 goodness\n"
    "float32 decision_margin\nPoint centre\nPoint[4] corners\nfloat64[9] homography\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\nAprilTagDetection[] detections\n",
}
CALIBRATION = {
    "robot_calibration_msgs/msg/CameraParameter": "string name\nfloat64 value\n",
    "robot_calibration_msgs/msg/ExtendedCameraInfo": "sensor_msgs/CameraInfo camera_info\n"
    "CameraParameter[] parameters\n",
    "robot_calibration_msgs/msg/Observation": "string sensor_name\ngeometry_msgs/PointStamped[] features\n"
    "ExtendedCameraInfo ext_camera_info\nsensor_msgs/PointCloud2 cloud\nsensor_msgs/Image image\n",
    "robot_calibration_msgs/msg/CalibrationData": "sensor_msgs/JointState joint_states\nObservation[] observations\n",
}
KINDS = ("rosbag1", "sqlite3", "mcap")


class Recorder:
    """Writes messages into a recording of one kind."""

    def __init__(self, folder, kind, definitions=()):
        self.ros1 = kind == "rosbag1"
        self.path = folder / ("session.bag" if self.ros1 else "session")
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        for name, text in (TREE | dict(definitions)).items():
            if name not in self.store.fielddefs:
                self.store.register(get_types_from_msg(text, name))
        if self.ros1:
            self._writer = Writer1(self.path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self._connections = {}

    def __enter__(self):
        self._writer.open()
        return self

    def __exit__(self, *_):
        self._writer.close()

    def make(self, kind, **fields):
        """A message; what is not given is empty."""
        values = {}
        for name, (node, detail) in self.store.fielddefs[kind][1]:
            node = int(node)
            if name in fields:
                values[name] = fields[name]
            elif node == 1:
                values[name] = "" if detail[0] == "string" else 0
            elif node == 2:
                values[name] = self.make(detail)
            else:
                base, count = detail
                number = base[0] == 1 and base[1][0] != "string"
                dtype = {"byte": "uint8", "char": "uint8"}.get(base[1][0], base[1][0]) if number else None
                values[name] = np.zeros(count if node == 3 else 0, dtype) if number else []
        return self.store.types[kind](**values)

    def stamped(self, kind, t, **fields):
        header = self.make("std_msgs/msg/Header", stamp=self.stamp(t), frame_id=fields.pop("frame_id", "base"))
        return self.make(kind, header=header, **fields)

    def stamp(self, t):
        return self.make("builtin_interfaces/msg/Time", sec=int(t), nanosec=round(t % 1 * 1e9))

    def write(self, topic, t, message):
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self._writer.write(self._connections[topic], int(t * 1e9), serialize(message, kind))

    def joints(self, topic, t, names, q):
        state = self.stamped("sensor_msgs/msg/JointState", t, name=list(names), position=np.asarray(q, float))
        self.write(topic, t, state)

    def point(self, xyz):
        return self.make("geometry_msgs/msg/Point", **dict(zip("xyz", map(float, xyz), strict=True)))


def visited(poses, *, seed=0, stand=1.0, move=1.0, rate=50.0, noise=1e-5, begin=1000.0):
    """Times and readings of an arm that stands in each of the poses and goes smoothly from one to the next; and from
    when to when it stands."""
    rng = np.random.default_rng(seed)
    knots, held = [], []
    t = 0.0
    for _ in poses:
        held.append((t, t + stand))
        knots += held[-1]
        t += stand + move
    times = np.arange(0.0, knots[-1], 1 / rate)
    phase = np.interp(times, knots, np.repeat(np.arange(len(poses)), 2))
    whole, part = np.floor(phase).astype(int), phase % 1
    smooth = (part**2 * (3 - 2 * part))[:, None]
    following = np.minimum(whole + 1, len(poses) - 1)
    q = np.asarray(poses)[whole] * (1 - smooth) + np.asarray(poses)[following] * smooth
    return begin + times, q + rng.normal(0, noise, q.shape), np.array(held) + begin


def record(folder, kind, arm_name, poses, *, late=0.0, tracker="point", noise=1e-5, header_clock=True, extra=None):
    """A recording of an arm whose tip a tracker follows, m, in a frame that is the arm's; its path, and the truth."""
    arm = aj.load_arm(arm_name)
    t, q, held = visited(poses, noise=1e-6)
    rng = np.random.default_rng(1)
    names = [f"arm_joint{i}" for i in range(1, arm.joints + 1)]
    with Recorder(folder, kind, TAGS) as bag:
        for time, readings in zip(t, q, strict=True):
            bag.joints("/joint_states", time, names, readings)
        seen = t[::2] + 0.003
        frames = np.asarray(arm.pose(np.array([np.interp(seen, t, column) for column in q.T]).T))
        for time, frame in zip(seen + late, frames, strict=True):
            xyz = frame[:3, 3] / 1e3 + rng.normal(0, noise, 3)
            turn = Rotation.from_matrix(frame[:3, :3]).as_quat() * rng.choice([-1, 1])
            quaternion = bag.make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", map(float, turn), strict=True)))
            if tracker == "point":
                message = bag.stamped("geometry_msgs/msg/PointStamped", time, point=bag.point(xyz))
                bag.write("/tracker", time, message)
            elif tracker == "pose":
                pose = bag.make("geometry_msgs/msg/Pose", position=bag.point(xyz), orientation=quaternion)
                bag.write("/tracker", time, bag.stamped("geometry_msgs/msg/PoseStamped", time, pose=pose))
            elif tracker == "tf":
                vector = bag.make("geometry_msgs/msg/Vector3", **dict(zip("xyz", map(float, xyz), strict=True)))
                transform = bag.make("geometry_msgs/msg/Transform", translation=vector, rotation=quaternion)
                children = [
                    bag.stamped("geometry_msgs/msg/TransformStamped", time, child_frame_id=child, transform=transform)
                    for child in ("tool", "elsewhere")
                ]
                bag.write("/tf", time, bag.make("tf2_msgs/msg/TFMessage", transforms=children))
        if extra is not None:
            extra(bag, t, q)
    return bag.path, held
