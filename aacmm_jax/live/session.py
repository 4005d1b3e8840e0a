"""A live capture: devices are read, poses taken at rest and kept on disk, and the next one is proposed.

Everything that people see is `Session.state`; everything that they do is a method.
"""

import contextlib
import itertools
import os
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError
from ..core.numpy_or_jax import to_numpy
from ..data.recording import Recording
from ..files.captures import save_capture
from ..kinematics.arm import Arm, joint_limits
from ..kinematics.chain import forward_pass, joint_motion
from . import guidance as guiding
from .devices import open_device
from .devices.device import AbstractDevice
from .journal import Journal, journal_of
from .places import COLUMNS, Place, Setup, TakenPose, capture_of, row_of_readings
from .samples import Sample
from .stillness import Rest, Stillness

_FORMAT = 1
_EXPECTED_WITHIN = 80.0  # mm: the first pose of a place is taken by itself within this distance of where it is expected
_FOUND_WITHIN = 15.0  # mm: and further ones of where the others are
_APART = 0.02  # rad, or m of prismatic joints: least change of a joint between two poses that are taken by themselves
_LONGEST_TEXT = 200
_DEGREES = 180 / np.pi


class Session:
    """A live capture in progress; thread-safe. It reads its devices and computes guidance in threads of its own.

    Args:
        setup: The arm and the places (`setup_of`).
        devices: Devices, or the texts that describe them. One at least reads the joints.
        path: Where `finish` writes the capture; its journal is beside it, and is continued if it exists.
        target: Expanded uncertainty (95 %) of a length that is enough, mm; None for none.
        automatic: Whether a pose is taken by itself at every rest in a place.

    Raises:
        InputError: A device or the journal cannot be used, or the journal is of another capture.

    Example:
        >>> import time
        >>> setup = aj.live.setup_of(
        ...     aj.files.load_specification("cheng2018-simulation"),
        ...     aj.files.load_noise("cheng2018-simulation"),
        ...     [aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5)],
        ... )
        >>> with aj.live.Session(setup, ["simulated:?seed=1&speed=20"], path="live.h5") as session:
        ...     while not session.state()["poses"]:
        ...         time.sleep(0.02)
        ...     print(session.state()["poses"][0]["place"])
        A
    """

    def __init__(
        self,
        setup: Setup,
        devices: Sequence[AbstractDevice | str],
        *,
        path: str | os.PathLike = "capture.h5",
        target: float | None = None,
        automatic: bool = True,
    ):
        self.setup, self.path, self.target = setup, Path(path), target
        self._arm: Arm = to_numpy(setup.specification.arm)
        self._lock, self._wake, self._stop = threading.RLock(), threading.Event(), threading.Event()
        self._poses: list[TakenPose] = []
        self._session, self._temperature, self._marks = 1, None, []
        self._auto, self._forced = automatic, None
        self._version = self._sound = 0
        self._guidance: guiding.Guidance | None = None
        self._next: guiding.NextPose | None = None
        self._busy: str | None = None
        self._message = ""
        self._paths: list[str] = []
        self._q: Float[np.ndarray, " n"] | None = None
        self._columns: dict[str, float] = {}
        self._measured: dict[str, Any] = {}
        self._sample_times: list[float] = []
        self._taken_until = -np.inf  # time of the device up to which rest has been used
        self._taken_q: Float[np.ndarray, " n"] | None = None
        self._button = False
        self._journal, self._closed = Journal(journal_of(self.path)), False
        self._devices: list[AbstractDevice] = []
        try:
            self._resume()
            self._devices = [open_device(d, setup) if isinstance(d, str) else d for d in devices]
            self._check_devices()
        except BaseException:
            self.close()
            raise
        self._stillness = Stillness(self._arm.joints)
        self._reader = threading.Thread(target=self._read_devices, name="live devices", daemon=True)
        self._worker = threading.Thread(target=self._compute, name="live guidance", daemon=True)
        self._reader.start()
        self._worker.start()
        self._wake.set()

    # What people do.

    def take(self) -> int:
        """Take the present pose; its number. `InputError` where the arm moves, or it is not clear where the tip is."""
        with self._lock:
            rest = self._stillness.rest
            if rest is None:
                raise InputError("the arm is moving; hold it still, then take the pose.")
            place = self._place_at(rest.q, sure=False)
            if place is None:
                raise InputError("it is not clear in which place the tip is; choose the place first.")
            return self._take(rest, place)

    def undo(self) -> None:
        """Remove the last pose that was taken and not removed."""
        with self._lock:
            if not self._poses:
                raise InputError("there is no pose to undo.")
            self._record({"event": "undo", "number": self._poses[-1].number})

    def exclude(self, pose: int, excluded: bool = True) -> None:
        """Leave a pose out of the calibration, or take it in again."""
        with self._lock:
            if not any(taken.number == pose for taken in self._poses):
                raise InputError(f"there is no pose {pose}.")
            self._record({"event": "exclude", "number": int(pose), "excluded": bool(excluded)})

    def mark(self, text: str = "") -> None:
        """Begin a new session: the probe was remounted, or the arm has warmed up."""
        with self._lock:
            self._record({"event": "mark", "text": str(text)[:_LONGEST_TEXT]})

    def temperature(self, celsius: float | None) -> None:
        """The thermometer's reading, C, of the poses from now on; None where a device reads it."""
        if celsius is not None and not (np.isfinite(celsius) and -50 <= celsius <= 100):
            raise InputError(f"the temperature is {celsius:g} C; give one between -50 and 100 C.")
        with self._lock:
            self._record({"event": "temperature", "celsius": None if celsius is None else float(celsius)})

    def auto(self, on: bool) -> None:
        """Whether a pose is taken by itself at every rest in a place."""
        with self._lock:
            self._auto = bool(on)
            self._changed()

    def place(self, name: str | None) -> None:
        """Say in which place the tip is until it has left it; None where that is to be found from the readings."""
        with self._lock:
            self._forced = None if name is None else self.setup.place(name).name
            self._changed(compute=True)

    def finish(self, calibrate: bool = True) -> list[str]:
        """Write the capture, and the calibration with its report; the names of the files. The session goes on."""
        with self._lock:
            poses, self._busy = list(self._poses), "Calibrating" if calibrate else "Writing"
            self._version += 1
        try:
            paths = self._written(poses, calibrate)
        finally:
            with self._lock:
                self._busy = None
                self._version += 1
        with self._lock:
            self._record({"event": "finished", "paths": paths})
        return paths

    def close(self) -> None:
        """Stop; everything is on disk already."""
        self._stop.set()
        self._wake.set()
        for name in ("_reader", "_worker"):
            thread = getattr(self, name, None)
            if thread is not None and thread is not threading.current_thread():
                thread.join(5.0)
        for device in self._devices:
            device.close()
        self._devices = []
        if not self._closed:
            self._closed = True
            self._journal.close()

    def __enter__(self) -> "Session":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # What people see.

    def state(self, since: int | None = None) -> dict[str, Any]:
        """Everything that there is to see, as JSON may hold it; where nothing but the readings has changed since the
        version ``since``, only these."""
        with self._lock:
            live = {"version": self._version, "sound": self._sound, "live": self._live()}
            if since == self._version:
                return live
            return live | {
                "arm": {"name": self.setup.specification.name, "joints": self._joints()},
                "headline": self._headline(),
                "places": [self._place_state(place) for place in self.setup.places],
                "poses": [self._pose_state(pose) for pose in self._poses],
                "next": self._next_state(),
                "progress": self._progress(),
                "sentences": list(self._guidance.sentences) if self._guidance else [],
                "stop": bool(self._guidance and self._guidance.stop),
                "paths": list(self._paths),
                "auto": self._auto,
                "session": self._session,
                "temperature": self._temperature,
                "busy": self._busy,
                "message": self._message,
            }

    def _joints(self) -> list[dict[str, Any]]:
        slides = self._arm.prismatic
        limits = np.asarray(joint_limits(self.setup.specification.arm, None)).tolist()
        return [
            {
                "name": f"joint {i}",
                "kind": "prismatic" if i in slides else "revolute",
                "unit": "mm" if i in slides else "deg",
                "limits": limits[i - 1] if i in slides else [x * _DEGREES for x in limits[i - 1]],
            }
            for i in range(1, self._arm.joints + 1)
        ]

    def _live(self) -> dict[str, Any]:
        rest, q = self._stillness.rest if hasattr(self, "_stillness") else None, self._q
        arm = self._present_arm()
        units = np.array([1.0 if i in self._arm.prismatic else _DEGREES for i in range(1, self._arm.joints + 1)])
        return {
            "q": None if q is None else (q * units).tolist(),
            "tip": None if q is None else links_of(arm, q)[-1],
            "links": None if q is None else links_of(arm, q),
            "still": rest is not None,
            "since": None if rest is None else rest.until - rest.since,
            "rate": self._rate(),
            "place": self._forced or (None if q is None or (at := self._place_at(q)) is None else at.name),
            "devices": [device.state() for device in self._devices],
        }

    def _rate(self) -> float:
        times = self._sample_times
        return 0.0 if len(times) < 2 or times[-1] == times[0] else (len(times) - 1) / (times[-1] - times[0])

    def _place_state(self, place: Place) -> dict[str, Any]:
        position = self._position_of(place)
        return {
            "name": place.name,
            "kind": place.kind,
            "position": None if position is None else position.tolist(),
            "poses": sum(pose.place == place.name and not pose.excluded for pose in self._poses),
            "wanted": place.wanted,
        }

    def _pose_state(self, pose: TakenPose) -> dict[str, Any]:
        found = self._guidance.poses.get(pose.number) if self._guidance else None
        return {
            "number": pose.number,
            "place": pose.place,
            "time": pose.time,
            "session": pose.session,
            "excluded": pose.excluded,
            "tip": np.asarray(self._tip(pose)).tolist(),
            "residual": None if found is None else np.asarray(found.residual).tolist(),
            "residual_mm": None if found is None else float(np.linalg.norm(found.residual)),
            "expected_mm": None if found is None else float(found.expected),
            "outlier": bool(found and found.outlier),
        }

    def _next_state(self) -> dict[str, Any] | None:
        proposed = self._next
        if proposed is None:
            return None
        return {
            "place": proposed.place,
            "q": np.asarray(proposed.q).tolist(),
            "links": links_of(self._present_arm(), proposed.q),
            "why": proposed.why,
            "distance": float(proposed.distance),
        }

    def _progress(self) -> dict[str, Any]:
        found = self._guidance
        return {
            "u_length_mm": found.u_length if found else None,
            "u_target_mm": self.target,
            "u_after_ten_mm": found.u_after_ten if found else None,
            "limits": found.limits if found else "",
        }

    def _headline(self) -> str:
        if self._busy:
            return f"{self._busy} ..."
        unread = [device.name for device in self._devices if not device.connected]
        if unread:
            return f"{unread[0]} is not connected"
        outliers = [p for p in self._poses if not p.excluded and self._pose_state(p)["outlier"]][-1:]
        if outliers and outliers[0] is self._poses[-1]:
            return f"Pose {outliers[0].number} does not fit: take it again in {outliers[0].place}"
        if self._guidance and self._guidance.stop:
            return "Enough: the target is met. Finish, or take more poses"
        if self._next is not None:
            return f"Go to {self._next.place} and hold still"
        return "Take a pose"

    # Inside; with the lock held.

    def _changed(self, compute: bool = False) -> None:
        self._version += 1
        if compute:
            self._wake.set()

    def _record(self, event: dict[str, Any]) -> None:
        """Put an event on disk, and then into effect."""
        if self._closed:
            raise InputError("the session is closed; open it again.")
        self._journal.append(event)
        self._apply(event)
        self._changed(compute=True)

    def _apply(self, event: dict[str, Any]) -> None:
        kind = event.get("event")
        if kind == "pose":
            arrays = {name: np.array(value) for name, value in event["measured"].items()}
            q, u = np.array(event["q"], dtype=float), np.array(event["u"], dtype=float)
            self._poses.append(
                TakenPose(event["number"], event["place"], event["time"], q, u, event["columns"], arrays, self._session)
            )
        elif kind == "undo":
            self._poses = [pose for pose in self._poses if pose.number != event["number"]]
        elif kind == "exclude":
            self._poses = [
                pose._replace(excluded=event["excluded"]) if pose.number == event["number"] else pose
                for pose in self._poses
            ]
        elif kind == "mark":
            self._session += 1
            self._marks.append((self._session, event["text"]))
        elif kind == "temperature":
            self._temperature = event["celsius"]
        elif kind == "finished":
            self._paths = list(event["paths"])

    def _resume(self) -> None:
        """Continue an existing journal, of the same arm and places; else begin one."""
        own = {"joints": self._arm.joints, "places": [place.name for place in self.setup.places]}
        journal, path = self._journal, self._journal.path
        if not journal.events:
            header = {"event": "begin", "format": _FORMAT, "arm": self.setup.specification.name} | own
            journal.append(header | {"time": time.time()})
            return
        first = journal.events[0]
        if first.get("event") != "begin" or first.get("format") != _FORMAT:
            raise InputError(f"{path} is not a journal that this version reads; choose another output path.")
        missing = sorted(set(first["places"]) - set(own["places"]))
        if first["joints"] != own["joints"] or missing:
            what = f"has the place '{missing[0]}'" if missing else f"is of an arm with {first['joints']} joints"
            raise InputError(
                f"{path} {what}, which this capture does not have; give the same arm and kit to continue it, or choose "
                "another output path."
            )
        try:
            for event in journal.events[1:]:
                self._apply(event)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path} has an event without {error}; restore the file from a copy.") from error

    def _check_devices(self) -> None:
        if not any(device.joints for device in self._devices):
            raise InputError("no device reads the joints; add one with --device.")
        for device in self._devices:
            if device.joints not in (0, self._arm.joints):
                raise InputError(
                    f"device {device.name} reads {device.joints} joints, but the arm has {self._arm.joints}; correct "
                    "its line format, or name the right arm."
                )

    def _present_arm(self) -> Arm:
        return self._guidance.arm if self._guidance else self._arm

    def _tip(self, pose: TakenPose) -> Float[np.ndarray, " 3"]:
        found = self._guidance.poses.get(pose.number) if self._guidance else None
        return np.asarray(self._arm.position(row_of_readings(self._arm, pose)) if found is None else found.tip)

    def _position_of(self, place: Place) -> Float[np.ndarray, " 3"] | None:
        """Where a place is: as found, else by its poses, else as expected."""
        if self._guidance and place.name in self._guidance.positions:
            return np.asarray(self._guidance.positions[place.name])
        own = [pose for pose in self._poses if pose.place == place.name and not pose.excluded]
        if own and not _is_free(place):
            return np.median([self._tip(pose) for pose in own], axis=0)
        return place.position

    def _place_at(self, q: Float[np.ndarray, " n"], sure: bool = True) -> Place | None:
        """The place that the tip is in: the one that was said, else the nearest within reach, else, where it may be
        anywhere, an instrument; with ``sure=False`` also the one that is proposed."""
        if self._forced is not None:
            return self.setup.place(self._forced)
        tip = np.asarray(links_of(self._present_arm(), q)[-1])
        nearest, distance = None, np.inf
        for place in self.setup.places:
            position = self._position_of(place)
            if position is None or _is_free(place):
                continue
            known = any(pose.place == place.name for pose in self._poses)
            away = float(np.linalg.norm(tip - position)) / (_FOUND_WITHIN if known else _EXPECTED_WITHIN)
            if away < min(distance, 1.0):
                nearest, distance = place, away
        if nearest is not None:
            return nearest
        free = [place for place in self.setup.places if _is_free(place)]
        proposed = [place for place in self.setup.places if self._next and place.name == self._next.place]
        if free and self._measured:
            return next((place for place in proposed if _is_free(place)), free[0])
        return proposed[0] if proposed and not sure else None

    def _take(self, rest: Rest, place: Place) -> int:
        measured = dict(self._measured) if _is_free(place) else {}
        columns = {name: value for name, value in self._columns.items() if name != "button"}
        if self._temperature is not None:
            columns[COLUMNS["thermometer"]] = self._temperature
        number = max((e.get("number", 0) for e in self._journal.events if e.get("event") == "pose"), default=0) + 1
        self._record(
            {
                "event": "pose", "number": number, "place": place.name, "time": time.time(),
                "q": rest.q, "u": rest.u, "samples": rest.count, "columns": columns, "measured": measured,
            }
        )  # fmt: skip
        self._taken_until, self._taken_q, self._forced = rest.until, rest.q, None
        self._sound += 1
        return number

    # The threads.

    def _read_devices(self) -> None:
        while not self._stop.is_set():
            any_came = False
            for device in self._devices:
                samples = device.read()
                any_came = any_came or bool(samples)
                if samples:
                    with self._lock, contextlib.suppress(InputError):
                        self._add(samples)
            if not any_came:
                time.sleep(0.002)

    def _add(self, samples: Iterable[Sample]) -> None:
        pressed = False
        for sample in samples:
            self._columns |= sample.columns
            if sample.measured:
                self._measured = dict(sample.measured)
            button = bool(self._columns.get("button", 0))
            pressed, self._button = pressed or (button and not self._button), button
            if sample.q is not None:
                self._q = sample.q
                self._stillness.add(sample)
                self._sample_times = [*self._sample_times[-50:], sample.time]
                self._take_by_itself()
        if pressed:
            self.take()

    def _take_by_itself(self) -> None:
        rest = self._stillness.rest
        if not self._auto or rest is None or self._busy or rest.since <= self._taken_until:
            return
        if self._taken_q is not None:
            slides = np.array([i in self._arm.prismatic for i in range(1, self._arm.joints + 1)])
            if np.max(np.abs(rest.q - self._taken_q) / np.where(slides, 1000.0, 1.0)) < _APART:
                return
        place = self._place_at(rest.q)
        if place is not None:
            self._take(rest, place)

    def _compute(self) -> None:
        while not self._stop.is_set():
            if not self._wake.wait(0.5):
                continue
            self._wake.clear()
            with self._lock:
                poses, q, forced = list(self._poses), self._q, self._forced
            try:
                found = guiding.calibrated(self.setup, poses, self.target)
                proposed = guiding.next_pose(self.setup, poses, found, q, forced)
                message = ""
            except InputError as error:
                found, proposed, message = None, None, str(error)
            with self._lock:
                self._guidance, self._next, self._message = found, proposed, message
                self._changed()
                if proposed is not None:
                    for device in self._devices:
                        device.asked(self.setup.place(proposed.place), proposed.q)

    def _written(self, poses: list[TakenPose], calibrate: bool) -> list[str]:
        from ..files.calibrations import save_calibration
        from ..pipeline.capture_calibration import calibrate_capture
        from ..report import write_report

        capture, _ = capture_of(self.setup, poses)
        measured = time.strftime("%Y-%m-%d")
        recording = Recording(capture, self.setup.specification, usual=self.setup.noise, measured=measured)
        save_capture(self.path, recording)
        paths = [str(self.path)]
        if calibrate:
            record = calibrate_capture(recording)
            calibration = self.path.with_name(f"{self.path.stem}-calibration.h5")
            save_calibration(calibration, record)
            page = calibration.with_suffix(".html")
            write_report(calibration, page)
            paths += [str(calibration), str(page)]
        return paths


def _is_free(place: Place) -> bool:
    """Whether the tip may be anywhere in a place: an instrument sees it."""
    return place.kind in ("points", "transforms", "pixels", "distances")


def links_of(arm: Arm, q: Float[np.ndarray, " n"]) -> list[list[float]]:
    """Points along an arm from the base to the tip, mm: along each joint's axis, then along its link."""
    row = np.concatenate([q, np.zeros(arm.columns - len(q))])[None]
    geometry = to_numpy(arm.geometry)
    forward = forward_pass(geometry, joint_motion(geometry, row))
    before, after, axes = (np.asarray(x)[..., 0] for x in (forward.origin_before, forward.origin, forward.z_before))
    points = [np.zeros(3)]
    for start, end, axis in zip(before, after, axes, strict=True):
        points += [start + axis * np.dot(end - start, axis), end]
    points.append(np.asarray(forward.tip)[..., 0])
    kept = [points[0], *(b for a, b in itertools.pairwise(points) if np.linalg.norm(b - a) > 1e-6)]
    return [point.tolist() for point in kept]
