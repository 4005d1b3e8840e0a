"""A live capture: devices are read, poses taken at rest and kept on disk, and the next one is proposed.

Everything that people see is `Session.state`; everything that they do is a method.
"""

import atexit
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
from ..kinematics.arm import Arm
from . import guidance as guiding
from .captured import Captured, Whereabouts
from .devices import open_device
from .devices.device import AbstractDevice, check_joints
from .journal import Journal, journal_of
from .places import COLUMNS, Place, Setup, TakenPose
from .readings import Readings
from .samples import Sample, lines_of, mean_measured
from .shown import headline, links_of, shown_readings, state_of
from .sides import check_nothing_holds, from_both_sides, sides_of
from .stillness import Rest
from .written import fitting, written

_LOOK_EVERY = 0.1  # s of rest
_LONGEST_TEXT = 200
_LONGEST_END = 60.0  # s


class Session:
    """A live capture in progress; thread-safe. It reads its devices and computes guidance in threads of its own.

    Args:
        setup: The arm and the places (`setup_of`).
        devices: Devices, or the texts that describe them. One at least reads the joints.
        path: Where `finish` writes the capture; its journal is beside it, and is continued if it exists.
        target: Expanded uncertainty of a length that is enough, mm; None for none.
        automatic: Whether a pose is taken by itself at every rest in a place.
        stream: File to which everything that devices send is appended, line by line; by default it is not kept.
        both_sides: Whether every pose is taken twice, with each joint from one side and from the other.

    Raises:
        InputError: A device or the journal cannot be used, the journal is of another capture, or something holds the
            tip, which is to be moved from both sides.

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
        stream: str | os.PathLike | None = None,
        both_sides: bool = False,
    ):
        if both_sides:
            check_nothing_holds(setup)
        self.setup, self.path, self.target = setup, Path(path), target
        self._arm: Arm = to_numpy(setup.specification.arm)
        self._lock, self._wake, self._stop = threading.RLock(), threading.Event(), threading.Event()
        self._stream = None if stream is None else open(stream, "ab")  # noqa: SIM115 - closed by `close`
        self._captured = Captured(setup)
        self._auto, self._forced = automatic, None
        self._version = self._sound = 0
        self._where = Whereabouts(setup, self._arm, (), None)
        self._next: guiding.NextPose | None = None
        self._skipped: list[guiding.NextPose] = []
        self._busy: str | None = None
        self._planning = True  # until the first pose is proposed
        self._message = ""
        self._again: tuple[int | None, float] = None, np.inf  # pose that is to be taken again, and when that was said
        self._shown: tuple[int, dict[str, Any]] = -1, {}  # the version, and what is seen of it
        self._readings = Readings(self._arm)
        self._taken_until = -np.inf  # time of the device up to which rest has been used
        self._looked_at = -np.inf  # and when it was last looked at
        self._taken_q: Float[np.ndarray, " n"] | None = None
        self._both_sides, self._taken_sides = both_sides, np.zeros(self._arm.joints)
        self._journal, self._closed = Journal(journal_of(self.path)), False
        self._devices: list[AbstractDevice] = []
        self._threads: list[threading.Thread] = []
        try:
            self._captured.resume(self._journal)
            self._where = Whereabouts(setup, self._arm, self._captured.poses, None)
            if self._captured.poses:  # an arm that still is where it was when the last process ended is not taken again
                self._taken_q = self._captured.poses[-1].q
                self._taken_sides = sides_of(self._captured.poses[-1].columns, self._arm.joints)
            self._devices = [open_device(d, setup) if isinstance(d, str) else d for d in devices]
            check_joints(self._devices, self._arm.joints)
        except BaseException:
            self.close()
            raise
        self._threads = [threading.Thread(target=self._compute, name="live guidance", daemon=True)]
        for device in self._devices:  # each its own: one that cannot be reached holds up no other
            self._threads.append(threading.Thread(target=self._read_device, args=(device,), daemon=True))
        atexit.register(self._end)
        for thread in self._threads:
            thread.start()
        self._wake.set()

    # What people do.

    def take(self) -> int:
        """Take the present pose; its number. `InputError` where the arm moves, or it is not clear where the tip is."""
        with self._lock:
            rest = self._readings.rest
            if rest is None:
                raise InputError("the arm is moving; hold it still, then take the pose.")
            place = self._place_at(self._tip_of(rest.q))
            if place is None and self._next is not None:
                place = self.setup.place(self._next.place)
            if place is None:
                raise InputError("it is not clear in which place the tip is; choose the place first.")
            return self._take(rest, place)

    def undo(self) -> None:
        """Remove the last pose that was taken and not removed."""
        with self._lock:
            if not self._captured.poses:
                raise InputError("there is no pose to undo.")
            self._record({"event": "undo", "number": self._captured.poses[-1].number})

    def exclude(self, pose: int, excluded: bool = True) -> None:
        """Leave a pose out of the calibration, or take it in again."""
        with self._lock:
            if not any(taken.number == pose for taken in self._captured.poses):
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

    def skip(self) -> None:
        """Ask for another pose than the one that is proposed, which is not proposed again before the next start."""
        with self._lock:
            if self._next is None:
                raise InputError("no pose is proposed at present.")
            self._skipped.append(self._next)
            self._changed(compute=True)

    def finish(self, calibrate: bool = True) -> list[str]:
        """Write the capture, and the calibration with its report; the names of the files. The session goes on. Poses
        that guidance leaves out, since they do not fit, are in the journal only, as are those that follow by hand: no
        pose is taken by itself any more."""
        with self._lock:
            self._busy = "Calibrating" if calibrate else "Writing"
            self._version += 1
            until = self._captured.number
        try:
            poses = fitting(self._poses_seen, self._stop)
            true = next((arm for device in self._devices if (arm := device.truth()) is not None), None)
            arm = next((device for device in self._devices if device.joints), None)
            told = {} if arm is None else {"read_as": arm.read_as, "recorded_as": arm.recorded_as}
            sources = tuple(source for device in self._devices for source in device.sources)
            paths, says = written(self.setup, poses, self.path, calibrate, true, sources, **told)
        finally:
            with self._lock:
                self._busy = None
                self._version += 1
        with self._lock:
            self._auto = False
            used = [pose.number for pose in poses if not pose.excluded]
            self._record({"event": "finished", "paths": paths, "says": says, "poses": used, "until": until})
        return paths

    def report(self) -> Path | None:
        """The report that was written last."""
        with self._lock:
            paths = self._captured.finished.get("paths")
            found = Path(paths[-1]) if paths else None
        return found if found is not None and found.suffix == ".html" and found.is_file() else None

    def close(self) -> None:
        """Stop; everything is on disk already."""
        self._stop.set()
        self._wake.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(5.0 if thread is not self._threads[0] else 0.5)  # nobody waits for guidance
        for device in self._devices:
            device.close()
            if self._stream is not None:
                self._stream.write(device.raw())
        self._devices = []
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        if not any(thread.is_alive() for thread in self._threads[:1]):
            atexit.unregister(self._end)
        if not self._closed:
            self._closed = True
            self._journal.close()

    def _end(self) -> None:
        """Before the process ends, which a thread within compiled code would abort."""
        self.close()
        for thread in self._threads[:1]:
            thread.join(_LONGEST_END)

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
            if self._shown[0] != self._version:
                state = state_of(self.setup, self._captured, self._where, self._next, self.target)
                unread = [f"Not connected: {device.name}" for device in self._devices if not device.connected]
                if self._readings.q is None:  # whatever comes, nothing is readings
                    bad = [(device.name, device.bad.most_common(1)[0][0]) for device in self._devices if device.bad]
                    unread += [f"{name}: no line can be used yet ({reason})" for name, reason in bad]
                busy = self._busy or ("Planning the first poses" if self._planning and not unread else None)
                state |= {"headline": headline(busy, unread, state), "auto": self._auto}
                self._shown = self._version, state | {"busy": self._busy, "message": self._message}
            return live | self._shown[1]

    def _live(self) -> dict[str, Any]:
        rest, q = self._readings.rest, self._readings.q
        links = None if q is None else links_of(self._where.arm, q)
        place = None if links is None else self._place_at(np.array(links[-1]))
        return {
            "q": None if q is None else shown_readings(self._arm, q),
            "tip": links and links[-1],
            "links": links,
            "still": rest is not None,
            "since": None if rest is None else rest.until - rest.since,
            "rate": self._readings.rate,
            "place": place and place.name,
            "devices": [device.state() for device in self._devices],
        }

    # Inside; with the lock held.

    def _poses_seen(self) -> tuple[list[TakenPose], guiding.Guidance | None]:
        with self._lock:
            return list(self._captured.poses), self._where.guidance

    def _changed(self, compute: bool = False) -> None:
        self._version += 1
        if compute:
            self._wake.set()

    def _record(self, event: dict[str, Any]) -> None:
        """Put an event on disk, and then into effect."""
        if self._closed:
            raise InputError("the session is closed; open it again.")
        self._journal.append(event)
        self._captured.apply(event)
        self._where = Whereabouts(self.setup, self._arm, self._captured.poses, self._where.guidance)
        self._changed(compute=True)

    def _say(self, error: Exception) -> None:
        if self._message != in_words(error):
            self._message = in_words(error)
            self._changed()

    def _place_at(self, tip: Float[np.ndarray, " 3"]) -> Place | None:
        """The place that the tip is in: the one that was said, else the one that its position says."""
        if self._forced is not None:
            return self.setup.place(self._forced)
        return self._where.place_at(tip, bool(self._readings.measured), self._next and self._next.place)

    def _tip_of(self, q: Float[np.ndarray, " n"]) -> Float[np.ndarray, " 3"]:
        return np.array(links_of(self._where.arm, q)[-1])

    def _take(self, rest: Rest, place: Place) -> int:
        measured = mean_measured(self._readings.measured) if place.is_free else {}
        columns = self._readings.beside()
        if self._captured.temperature is not None:
            columns[COLUMNS["thermometer"]] = self._captured.temperature
        number = self._captured.number + 1
        self._record(
            {
                "event": "pose", "number": number, "place": place.name, "time": time.time(),
                "q": rest.q, "u": rest.u, "samples": rest.count, "columns": columns, "measured": measured,
            }
        )  # fmt: skip
        self._taken_until, self._taken_q, self._forced = rest.until, rest.q, None
        self._taken_sides = sides_of(columns, self._arm.joints)
        self._sound += 1
        return number

    # The threads.

    def _read_device(self, device: AbstractDevice) -> None:
        while not self._stop.is_set():
            samples = device.read()
            raw = device.raw()
            if not samples and not raw:
                continue
            with self._lock:
                if self._readings.q is None:
                    self._changed()  # from no line to lines, or to the first readings
                try:
                    if self._stream is not None:
                        self._stream.write(raw or lines_of(samples))
                        self._stream.flush()
                    self._add(samples)
                except Exception as error:  # whatever one device sends, the others are read on
                    self._say(error)

    def _add(self, samples: Iterable[Sample]) -> None:
        pressed: set[str] = set()
        for sample in samples:
            now_pressed, anew = self._readings.add(sample)
            pressed |= now_pressed
            if anew:
                self._taken_until = self._looked_at = -np.inf
            if sample.q is not None:
                self._take_by_itself()
        if "button" in pressed:
            self.take()
        if "skip" in pressed and self._next is not None:
            self.skip()

    def _take_by_itself(self) -> None:
        rest = self._readings.rest
        if not self._auto or rest is None or self._busy or rest.since <= self._taken_until:
            return
        if self._looked_at <= rest.until < self._looked_at + _LOOK_EVERY:
            return
        self._looked_at = rest.until
        # A pose that is to be taken again is where it was, seated anew since that was said.
        if self._taken_q is not None and rest.since <= self._again[1]:
            other_side = self._both_sides and np.mean(self._readings.sides.now == self._taken_sides) < 0.5
            if self._readings.is_near(rest, self._taken_q) and not other_side:
                self._taken_until = rest.until  # also while it ends, with readings of the next motion in it
                return
        place = self._place_at(self._tip_of(rest.q))
        if place is not None:
            self._take(rest, place)

    def _compute(self) -> None:
        guide: guiding.Guide | None = None  # made here, since it takes seconds
        while not self._stop.is_set():
            if not self._wake.wait(0.5):
                continue
            self._wake.clear()
            with self._lock:
                poses, skipped = list(self._captured.poses), list(self._skipped)
                q, forced = self._readings.q, self._forced
            found, proposed, message = None, None, ""
            try:
                guide = guiding.Guide(self.setup, self.target) if guide is None else guide
                if self._stop.is_set():
                    return
                try:
                    found = guide.calibrated(poses)
                except InputError as error:  # of data that do not determine enough yet
                    message = str(error)
                proposed = guide.next_pose(found, q, forced, skipped)
                if self._both_sides:
                    proposed = from_both_sides(self._arm, proposed, poses, skipped)
            except Exception as error:  # poses are taken without guidance, too
                message = in_words(error)
            with self._lock:
                self._where = Whereabouts(self.setup, self._arm, self._captured.poses, found)
                self._next, self._message, self._planning = proposed, message, False
                again = found.again.number if found is not None and found.again is not None else None
                if again != self._again[0]:
                    self._again = again, np.inf if again is None else self._readings.time
                self._changed()
                if proposed is not None:
                    for device in self._devices:
                        start = proposed.approach if self._both_sides else None
                        device.asked(self.setup.place(proposed.place), proposed.q, start)


def in_words(error: Exception) -> str:
    """The sentence of an error that says what to do; of any other, what failed."""
    return str(error) if isinstance(error, InputError) else f"this failed ({type(error).__name__}: {error})"
