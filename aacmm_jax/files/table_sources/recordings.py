"""Recordings of ROS: bags of ROS 1, and of ROS 2 in SQLite or MCAP. A row for each pose in which the arm stood still.

Joint states say when the arm stands; what is measured meanwhile is averaged: points, poses, transforms, and corners of
tags. Messages of robot_calibration are poses already. Clocks are those of the headers, or that of the recorder where
headers have no time.
"""

import io
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ...core.errors import InputError
from ...core.text import pluralise, quoted, shorten
from .nested import table_text
from .standstills import standstills

_JOINTS = "sensor_msgs/msg/JointState"
_TREE = "tf2_msgs/msg/TFMessage"
_TAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
_CALIBRATION = "robot_calibration_msgs/msg/CalibrationData"
_AXES, _QUATERNION = ("x", "y", "z"), ("qx", "qy", "qz", "qw")
# What is followed: messages and the field of each that holds its point or pose.
_TRACKED = {
    "geometry_msgs/msg/PointStamped": "point",
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
    "geometry_msgs/msg/TransformStamped": "transform",
}
_READ = {_JOINTS, _TREE, _TAGS, _CALIBRATION, *_TRACKED}
# apriltag's corners as this package numbers them, clockwise from the upper left of the marker that OpenCV draws: its
# first is the upper right one. Found with markers of OpenCV detected by apriltag 3.
_CORNERS = (1, 0, 3, 2)
_TYPE = re.compile(r"[A-Za-z]\w*(/msg)?/[A-Za-z]\w*", re.ASCII)
_FIELD = re.compile(r"[A-Za-z]\w*", re.ASCII)
_COMPRESSED = b"\x28\xb5\x2f\xfd"  # as each message may be; CDR begins with other bytes
_UNPACKED = 2**28  # bytes that even a small file may unpack to
_NANOSECOND = 1e-9


class _Stream(NamedTuple):
    """What one topic, or one frame of it, says over time."""

    t: Float[np.ndarray, " N"]  # s
    values: Float[np.ndarray, "N k"]
    names: tuple[str, ...]  # of the columns


class _Content(io.BytesIO):
    """A file in memory, which rosbags takes in place of a path."""

    def __init__(self, name: str, content: bytes):
        super().__init__(content)
        self._name, self._content = PurePath(name), content
        self.stem, self.suffix, self.st_size = self._name.stem, self._name.suffix, len(content)

    def exists(self) -> bool:
        return True

    def is_dir(self) -> bool:
        return False

    def stat(self) -> "_Content":
        return self

    def open(self, *_: Any) -> io.BytesIO:
        return io.BytesIO(self._content)

    def __str__(self) -> str:
        return str(self._name)


def read(members: Mapping[str, bytes], tables: Sequence[str], corners: int) -> dict[str, Any]:
    """The lines of the table: a row for each pose, or of ``corners``, for each corner in each pose.

    ``tables`` are topics, of which `tf` and robot_calibration need a frame or sensor: ``/tf:tool``.
    """
    topics: dict[str, dict[str, list[Any]]] = {}  # by type and topic
    seen: dict[str, str] = {}
    for name, content in members.items():
        for topic, kind, time, message in _messages(name, content, seen):
            topics.setdefault(kind, {}).setdefault(topic, []).append((_time_of(message, time), message))
    return _Recorded(topics, seen, tables).table(corners)


def _messages(name: str, content: bytes, seen: dict[str, str]) -> Iterator[tuple[str, str, float, Any]]:
    """Topic, type, time of recording and content of the messages that are read; ``seen`` collects all topics."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys import Stores, get_typestore

    if name.endswith(".zstd"):
        name, content = name.removesuffix(".zstd"), _unpacked(content)
    ros1 = name.lower().endswith(".bag")
    path: Any = _Content(name.lower(), content)
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    with Reader1(path) if ros1 else Reader2(path) as reader:
        wanted = [connection for connection in reader.connections if connection.msgtype in _READ]
        seen |= {connection.topic: connection.msgtype for connection in reader.connections}
        for connection in wanted:
            if connection.msgtype not in store.fielddefs:
                _register(store, connection)
        for connection, time, data in reader.messages(wanted) if wanted else ():
            packed = bytes(data[:4]) == _COMPRESSED
            read = store.deserialize_ros1 if ros1 else store.deserialize_cdr
            yield connection.topic, connection.msgtype, time * _NANOSECOND, read(
                _unpacked(data) if packed else data, connection.msgtype
            )  # fmt: skip


def _unpacked(content: bytes) -> bytes:
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd  # of rosbags

    with zstd.open(io.BytesIO(content), "rb") as stream:
        unpacked, limit = bytearray(), _UNPACKED + 2 * len(content)
        while part := stream.read(2**20):
            unpacked += part
            if len(unpacked) > limit:
                raise InputError(f"unpacks to more than {limit // 2**20} MiB; give a smaller recording.")
    return bytes(unpacked)


def _register(store: Any, connection: Any) -> None:
    """Learn a type from its definition in the recording.

    Python code is made of it, so that names in it must be names, and known types stay as they are.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import get_types_from_msg

    definition = connection.msgdef
    if definition.format != MessageDefinitionFormat.MSG:
        raise InputError(
            f"has no definition of {connection.msgtype} in the form of .msg, so the topic {quoted(connection.topic)} "
            "cannot be read; record it as MCAP, or with a version of ROS that stores definitions."
        )
    types = get_types_from_msg(definition.data, connection.msgtype)
    for kind, (_, fields) in types.items():
        if not _TYPE.fullmatch(kind) or not all(_FIELD.fullmatch(name) for name, _ in fields):
            raise InputError(f"has a definition of {connection.msgtype} with names that are not names; record again.")
    store.register({kind: ([], fields) for kind, (_, fields) in types.items() if kind not in store.fielddefs})


def _time_of(message: Any, recorded: float) -> float:
    """The time of the header, s, or that of recording where it has none."""
    message = message.joint_states if hasattr(message, "joint_states") else message
    stamp = message.header.stamp if hasattr(message, "header") else None
    seconds = 0.0 if stamp is None else stamp.sec + _NANOSECOND * stamp.nanosec
    return seconds or recorded


class _Recorded:
    """The streams of a recording, and the poses in it."""

    def __init__(self, topics: Mapping[str, Mapping[str, list[Any]]], seen: Mapping[str, str], tables: Sequence[str]):
        self._topics, self._seen, self._tables = topics, seen, tables
        # The messages of robot_calibration of 2014 have no observations by sensor.
        self._available = {
            **{topic: _JOINTS for topic in topics.get(_JOINTS, ())},
            **{topic: kind for kind in _TRACKED for topic in topics.get(kind, ())},
            **{topic: _TAGS for topic in topics.get(_TAGS, ())},
            **{f"{topic}:{t.child_frame_id}": _TREE for topic, items in topics.get(_TREE, {}).items()
               for _, message in items for t in message.transforms},
            **{f"{topic}:{o.sensor_name}": _CALIBRATION for topic, items in topics.get(_CALIBRATION, {}).items()
               for _, message in items for o in getattr(message, "observations", ())},
        }  # fmt: skip
        for name in tables:
            if name not in self._available and name not in topics.get(_CALIBRATION, ()):
                raise InputError(f"has no topic {quoted(name)} that can be read; it has {self._listed()}.")
        self._messages: list[tuple[float, Any]] = []  # of robot_calibration, one for each pose
        self._joints, self._poses, self._still = self._pose_readings()

    def _listed(self) -> str:
        """The topics that can be read, or all with their types where none can."""
        names = [f"{name} ({kind.rpartition('/')[2]})" for name, kind in self._available.items()]
        return shorten(names or [f"{topic} ({kind})" for topic, kind in self._seen.items()], 12) or "no topics"

    def _of(self, kind: str) -> list[str]:
        """What is chosen of a type, or all where nothing of it is."""
        names = [name for name, other in self._available.items() if other == kind]
        return [name for name in names if name in self._tables] or names

    def _pose_readings(self) -> tuple[_Stream, np.ndarray, list[tuple[float, float]]]:
        """The joint states, their mean in each pose, and from when to when each pose was held."""
        if _CALIBRATION in self._topics:
            (topic, *others) = [name for name in self._topics[_CALIBRATION] if not self._tables or any(
                wanted.partition(":")[0] == name for wanted in self._tables)] or self._topics[_CALIBRATION]  # fmt: skip
            if others:
                raise InputError(f"has several topics of CalibrationData; add table = {quoted(topic)}.")
            streams = _joint_streams([(t, m.joint_states) for t, m in self._topics[_CALIBRATION][topic]])
            self._messages = self._topics[_CALIBRATION][topic]
            if len(streams[0].t) < len(self._messages):
                raise InputError(f"has messages with different joints in {quoted(topic)}; record again.")
            return streams[0], streams[0].values, [(t, t) for t in streams[0].t.tolist()]
        names = self._of(_JOINTS)
        if len(names) != 1:
            what = f"several topics of joint states ({shorten(names)})" if names else "no topic of joint states"
            advice = f"add table = {quoted(names[0])}" if names else f"it has {self._listed()}"
            raise InputError(f"has {what}; {advice}.")
        joints, *_ = _joint_streams(self._topics[_JOINTS][names[0]])
        held = standstills(joints.t, joints.values)
        if not held:
            raise InputError(
                f"has no pose in which the arm stood still, by {len(joints.t):,} messages of {quoted(names[0])}; have "
                "the arm stand for a second in each pose, and record joint states at 10 Hz or more."
            )
        means = np.array([joints.values[first : last + 1].mean(axis=0) for first, last in held])
        return joints, means, [(float(joints.t[first]), float(joints.t[last])) for first, last in held]

    def table(self, corners: int) -> dict[str, Any]:
        """The lines of the table."""
        return self._corner_table(corners) if corners else self._pose_table()

    def _pose_table(self) -> dict[str, Any]:
        tracked = {name: stream for name in self._tracked_names() if (stream := self._tracked(name)) is not None}
        header = ["image", "time_s", *(f"{name} [SI]" for name in self._joints.names)]
        rows = [
            [i, round(first - self._still[0][0], 6), *q.tolist()]
            for i, ((first, _), q) in enumerate(zip(self._still, self._poses, strict=True), start=1)
        ]
        missing = np.zeros(len(rows), dtype=bool)
        for name, stream in tracked.items():
            self._check_clock(name, stream)
            before = f"{name} " if len(tracked) > 1 else ""
            units = [" [m]" if column in _AXES else "" for column in stream.names]
            header += [f"{before}{column}{unit}" for column, unit in zip(stream.names, units, strict=True)]
            header += [f"{before}u_{axis} [m]" for axis in _AXES]
            measured = [self._mean(stream, *times) for times in self._still]
            for row, values in zip(rows, measured, strict=True):
                row += [None] * (len(stream.names) + len(_AXES)) if values is None else values
            if len(tracked) == 1 or name in self._tables:
                missing |= np.array([values is None for values in measured])
        used = [row for row, without in zip(rows, missing, strict=True) if not without]
        if not used:
            raise InputError(
                f"has no measurement of {shorten(list(tracked))} in any of the {len(rows)} poses in which the arm "
                "stood still; check that both are recorded with the same clock."
            )
        return table_text([header, *used], header=True, note=self._note(len(used), tracked))

    def _note(self, used: int, tracked: Mapping[str, Any]) -> str:
        count, how = len(self._still), "" if _CALIBRATION in self._topics else " in which the arm stood still"
        without = f", {used} of them with {shorten(list(tracked))}" if tracked else ""
        return f"{pluralise(count, 'pose')}{how}{without}"

    def _tracked_names(self) -> list[str]:
        """What is measured in the poses: what is chosen, else all of it."""
        kinds = (*_TRACKED, _TREE) if _CALIBRATION not in self._topics else (_CALIBRATION,)
        names = [name for name, kind in self._available.items() if kind in kinds]
        return [name for name in names if name in self._tables] or names

    def _tracked(self, name: str) -> _Stream | None:
        """A stream of points or poses, m; None where there are several points at a time."""
        kind, (topic, _, part) = self._available[name], name.partition(":")
        if kind == _CALIBRATION:
            points = [(t, self._features(message, part)) for t, message in self._messages]
            if any(len(found) > 1 for _, found in points):
                return None
            times = np.array([t for t, found in points if len(found)])
            return _Stream(times, np.array([found[0] for _, found in points if len(found)]).reshape(-1, 3), _AXES)
        found: list[tuple[float, list[float]]] = []
        for t, message in self._topics[kind][topic]:
            if kind == _TREE:
                found += [
                    (_time_of(frame, t), _numbers(frame.transform))
                    for frame in message.transforms
                    if frame.child_frame_id == part
                ]
            else:
                found.append((t, _numbers(getattr(message, _TRACKED[kind]))))
        found.sort(key=lambda item: item[0])
        values = np.array([values for _, values in found], dtype=float)
        names = (*_AXES, *_QUATERNION)[: values.shape[1]]
        return _Stream(np.array([t for t, _ in found]), values, names)

    @staticmethod
    def _features(message: Any, sensor: str) -> Float[np.ndarray, "k 3"]:
        """The points that a sensor saw, as robot_calibration has them: m, or px of an image."""
        observation = next((o for o in message.observations if o.sensor_name == sensor), None)
        features = [] if observation is None else observation.features
        return np.array([[f.point.x, f.point.y, f.point.z] for f in features], dtype=float).reshape(-1, 3)

    def _check_clock(self, name: str, stream: _Stream) -> None:
        ours, theirs = (self._still[0][0], self._still[-1][1]), (stream.t[0], stream.t[-1])
        if theirs[1] < self._joints.t[0] or theirs[0] > self._joints.t[-1]:
            raise InputError(
                f"has joint states from {ours[0]:.3f} s to {ours[1]:.3f} s, but {name} from {theirs[0]:.3f} s to "
                f"{theirs[1]:.3f} s, so their clocks do not overlap; synchronise the clocks and record again."
            )

    @staticmethod
    def _mean(stream: _Stream, first: float, last: float) -> list[float | None] | None:
        """The mean between two times, and the standard deviation of the mean of the coordinates, m; None without
        values."""
        values = stream.values[(stream.t >= first) & (stream.t <= last)]
        if not len(values):
            return None
        mean = values.mean(axis=0)
        turned = values[:, len(_AXES) :]
        if turned.size:  # q and -q are one rotation; their mean is the eigenvector that is nearest to all
            mean[len(_AXES) :] = np.linalg.eigh(turned.T @ turned)[1][:, -1]
        u = values[:, : len(_AXES)].std(axis=0, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else [None] * 3
        return [*mean.tolist(), *(number if number is None else float(number) for number in u)]

    def _corner_table(self, dimension: int) -> dict[str, Any]:
        """A row for each corner in each pose: pixels, or mm of a camera that measures points."""
        kind = _CALIBRATION if _CALIBRATION in self._topics else _TAGS
        names = self._of(kind)
        if len(names) != 1:
            what = f"several topics of corners ({shorten(names)})" if names else "no topic of corners"
            advice = f"add corner_table = {quoted(names[0])}" if names else f"it has {self._listed()}"
            raise InputError(f"has {what}; {advice}.")
        (topic, _, sensor), scale = names[0].partition(":"), 1.0 if dimension < 3 else 1e3
        rows: list[list[Any]] = []
        if kind == _CALIBRATION:
            for i, (_, message) in enumerate(self._messages, start=1):
                points = self._features(message, sensor)[:, :dimension] * scale
                rows += [[i, k, *point] for k, point in enumerate(points.tolist())]
        else:
            if dimension != 2:
                raise InputError(f"has corners of tags in px in {topic}, but the camera measures points; change it.")
            times = np.array([t for t, _ in self._topics[_TAGS][topic]])
            self._check_clock(topic, _Stream(np.sort(times), np.zeros((len(times), 0)), ()))
            for i, (first, last) in enumerate(self._still, start=1):
                found: dict[int, list[list[float]]] = {}
                for k in np.flatnonzero((times >= first) & (times <= last)):
                    for tag in self._topics[_TAGS][topic][k][1].detections:
                        for corner, point in zip(_CORNERS, tag.corners, strict=True):
                            found.setdefault(4 * int(tag.id) + corner, []).append([point.x, point.y])
                rows += [[i, key, *np.mean(points, axis=0).tolist()] for key, points in sorted(found.items())]
        if not rows:
            raise InputError(f"has no corners in {names[0]} in any of {pluralise(len(self._still), 'pose')}.")
        poses = len({row[0] for row in rows})
        axes = ("u", "v") if dimension == 2 else ("x_mm", "y_mm", "z_mm")
        note = self._note(poses, {names[0]: None})
        return table_text([["image", "id", *axes], *rows], header=True, note=note)


def _joint_streams(messages: Sequence[tuple[float, Any]]) -> list[_Stream]:
    """Joint states by the joints that they are of, those with the most joints first; in the order of time."""
    by_names: dict[tuple[str, ...], dict[float, Any]] = {}
    for t, state in messages:
        if len(state.position) == len(state.name) > 0:
            by_names.setdefault(tuple(state.name), {})[t] = state.position
    if not by_names:
        raise InputError("has joint states without positions; record joint states with positions.")
    most = sorted(by_names.items(), key=lambda item: (len(item[0]), len(item[1])), reverse=True)
    return [
        _Stream(np.array(sorted(states)), np.array([states[t] for t in sorted(states)], dtype=float), names)
        for names, states in most
    ]


def _numbers(value: Any) -> list[float]:
    """The numbers of a point, or of a pose or transform: position, and quaternion with the scalar part last."""
    value = getattr(value, "pose", value)  # with covariance
    place = getattr(value, "translation", getattr(value, "position", value))
    turn = getattr(value, "rotation", getattr(value, "orientation", None))
    numbers = [place.x, place.y, place.z]
    return numbers if turn is None else [*numbers, turn.x, turn.y, turn.z, turn.w]
