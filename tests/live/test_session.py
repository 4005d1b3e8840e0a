"""Sessions: what is taken, undone and excluded; journals that are continued, damaged and shared; processes killed."""

import json
import os
import random
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.live import guidance
from aacmm_jax.live.devices.device import AbstractDevice
from aacmm_jax.live.journal import Journal, journal_of
from aacmm_jax.live.places import TakenPose
from aacmm_jax.live.written import fitting
from tests.live import killed
from tests.live.unguided import NoGuide

pytestmark = pytest.mark.usefixtures("unguided")
SETUP = killed.setup()
ARM = SETUP.specification.arm


class Scripted(AbstractDevice):
    """Gives what a test puts into it."""

    joints = ARM.joints

    def __init__(self):
        super().__init__("scripted")
        self.connected, self.time, self.queue, self.random = True, 0.0, [], np.random.default_rng(0)

    def read(self):
        time.sleep(0.001)
        samples, self.queue = self.queue, []
        self.lines += len(samples)
        return samples

    def hold(self, q, seconds=1.8, **columns):
        """Move to a pose and hold it; waits until all was read."""
        path = [np.asarray(q) + 0.2 * (1 - i / 20) for i in range(20)] + [np.asarray(q)] * int(100 * seconds)
        samples = []
        for row in path:
            self.time += 0.01
            samples.append(aj.live.Sample(self.time, row + 1e-5 * self.random.normal(size=ARM.joints), columns))
        self._give(samples)

    def press(self, q, values, name="button"):
        """Readings with the button pressed or not."""
        self.time += 0.01 * len(values)
        self._give([aj.live.Sample(self.time, np.asarray(q), {name: value}) for value in values])

    def _give(self, samples):
        self.queue = samples
        until = time.monotonic() + 20
        while self.queue and time.monotonic() < until:
            time.sleep(0.002)
        time.sleep(0.05)


def poses_in(name: str, count: int):
    """Readings of the nominal arm in a place."""
    position = SETUP.place(name).position
    starts = np.random.default_rng(7).uniform(-1, 1, (40 * count, ARM.joints))
    q, arrived = aj.kinematics.project_to_targets(ARM, starts, np.tile(position, (len(starts), 1)))
    return q[arrived][:count]


@pytest.fixture
def device():
    return Scripted()


@pytest.fixture
def session(tmp_path, device):
    with aj.live.Session(SETUP, [device], path=tmp_path / "c.h5") as session:
        yield session


def until(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def numbers(session):
    return [pose["number"] for pose in session.state()["poses"]]


def test_rests_in_places_are_taken_once_and_others_are_not(session, device):
    first, second = poses_in("A", 2)
    device.hold(first)
    device.hold(first)  # moved away and back to the same readings
    device.hold(np.array([0.5, -0.5, 1.0, 0.3, 0.2, 0.1]))  # in the air
    device.hold(second)
    state = session.state()
    assert [pose["place"] for pose in state["poses"]] == ["A", "A"]
    assert state["sound"] == 2
    np.testing.assert_allclose(state["poses"][0]["tip"], SETUP.place("A").position, atol=0.05)
    json.dumps(state, allow_nan=False)
    until(lambda: session.state(session.state()["version"]).keys() == {"version", "sound", "live"})


def test_poses_are_taken_by_hand_undone_excluded_and_marked(session, device):
    session.auto(False)
    first, second = poses_in("bar/1", 2)
    device.hold(first, temperature_C=21.5)
    assert numbers(session) == []
    assert session.take() == 1
    session.mark("warm")
    device.hold(second)
    session.temperature(22.0)
    session.take()
    session.exclude(1)
    assert [(p["excluded"], p["session"]) for p in session.state()["poses"]] == [(True, 1), (False, 2)]
    session.undo()
    device.hold(first)
    assert session.take() == 3  # no number is given twice
    for wrong in (lambda: session.exclude(2), lambda: session.place("B"), lambda: session.temperature(500)):
        with pytest.raises(aj.InputError):
            wrong()


def test_the_button_takes_a_pose(session, device):
    session.auto(False)
    (q,) = poses_in("A", 1)
    device.hold(q)
    for pressed, poses in (((0.0, 1.0, 1.0), 1), ((1.0, 0.0), 1), ((0.0, 1.0), 2)):
        device.press(q, pressed)
        assert len(numbers(session)) == poses


class Proposing(NoGuide):
    """Proposes the same readings; the reason counts those that were skipped."""

    def next_pose(self, _, q, place, skipped):
        return guidance.NextPose("A", np.zeros(ARM.joints), f"{len(skipped)} skipped", 0.0)


def test_another_pose_is_proposed_when_asked_for(session, tmp_path, monkeypatch):
    with pytest.raises(aj.InputError, match="no pose is proposed"):
        session.skip()
    device = Scripted()  # a device is read by one session
    monkeypatch.setattr(guidance, "Guide", Proposing)
    device = Scripted()
    with aj.live.Session(SETUP, [device], path=tmp_path / "d.h5") as session:
        for number in range(3):
            until(lambda number=number: (session.state()["next"] or {}).get("why") == f"{number} skipped")
            if number:
                session.skip()
            else:
                device.press(np.zeros(ARM.joints), (0.0, 1.0, 1.0), "skip")
        assert numbers(session) == []


def test_a_place_that_was_said_counts(session, device):
    session.auto(False)
    (q,) = poses_in("A", 1)
    device.hold(q)
    session.place("bar/2")
    session.take()
    assert session.state()["poses"][0]["place"] == "bar/2"


def test_a_session_is_continued_with_the_same_capture(tmp_path):
    path, state, last = tmp_path / "c.h5", None, np.zeros(ARM.joints)
    for name in ("A", "bar/1"):
        device = Scripted()
        with aj.live.Session(SETUP, [device], path=path) as session:
            if state is not None:
                assert session.state()["poses"] == state["poses"]
            if state is not None:
                device.hold(last)  # the arm has not moved since
            for last in poses_in(name, 2):
                device.hold(last)
            state = session.state()
    assert [pose["place"] for pose in state["poses"]] == ["A", "A", "bar/1", "bar/1"]
    last_device = Scripted()
    last_device.read_as = (1, -2, *range(3, ARM.joints + 1))
    last_device.recorded_as = aj.data.RecordedAs(
        tuple(f"servo {i}" for i in range(ARM.joints)), "counts", 1e-3 * np.eye(ARM.joints), np.full(ARM.joints, 0.5)
    )
    with aj.live.Session(SETUP, [last_device], path=path) as session:
        assert session.finish(calibrate=False) == [str(path)]
    recording = aj.files.load_capture(path)
    assert (recording.capture.sizes, [part.name for part in recording.capture.observations]) == ((2,), ["bar"])
    assert (recording.read_as, recording.recorded_as.unit) == (last_device.read_as, "counts")
    np.testing.assert_array_equal(recording.recorded_as.factors, last_device.recorded_as.factors)


def test_two_processes_cannot_have_one_journal(session, tmp_path):
    with pytest.raises(aj.InputError, match="in use by another live capture"):
        Journal(journal_of(tmp_path / "c.h5"))


open_file = os.open


def journal_with(tmp_path, events: int) -> Path:
    path = tmp_path / "j.journal"
    journal = Journal(path)
    for i in range(events):
        journal.append({"event": "pose", "number": i, "q": np.array([0.1 * i, np.pi])})
    journal.close()
    return path


def test_a_journal_gives_back_the_same_numbers(tmp_path):
    journal = Journal(journal_with(tmp_path, 3))
    assert [event["q"] for event in journal.events] == [[0.1 * i, np.pi] for i in range(3)]
    journal.close()


def test_a_journal_is_written_as_bytes_where_files_have_a_text_mode(tmp_path, monkeypatch):
    opened, binary = [], 0o100000  # on Windows, without this flag, each line ends with a carriage return, too
    monkeypatch.setattr(os, "O_BINARY", binary, raising=False)
    monkeypatch.setattr(os, "open", lambda path, flags, *mode: opened.append(flags) or open_file(path, flags, *mode))
    journal_with(tmp_path, 1)
    assert [flags for flags in opened if flags & os.O_APPEND and not flags & binary] == []
    assert any(flags & os.O_APPEND for flags in opened)


def test_wherever_a_journal_is_cut_only_the_last_event_is_lost(tmp_path):
    content = journal_with(tmp_path, 2).read_bytes()
    ends = [i for i, byte in enumerate(content, start=1) if byte == 10]
    near = {cut + step for cut in (0, *ends) for step in (-2, -1, 0, 1)}
    for cut in sorted(cut for cut in near | set(range(0, len(content), 11)) if 0 <= cut <= len(content)):
        path = tmp_path / "cut.journal"
        path.write_bytes(content[:cut])
        journal = Journal(path)
        whole = sum(end <= cut for end in ends)
        assert (len(journal.events), journal.dropped) == (whole, int(cut not in (0, *ends)))
        journal.append({"event": "more"})
        journal.close()
        journal = Journal(path)
        assert (len(journal.events), journal.dropped) == (whole + 1, 0)
        journal.close()


@pytest.mark.parametrize("place", [0, 5, 20, 60])
def test_a_damaged_journal_is_refused_with_its_line(tmp_path, place):
    path = journal_with(tmp_path, 3)
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    with pytest.raises(aj.InputError, match=r"line [12] is damaged"):
        Journal(path)


def test_values_that_are_not_finite_are_refused(tmp_path):
    journal = Journal(tmp_path / "j")
    with pytest.raises(aj.InputError, match="not finite"):
        journal.append({"q": np.array([np.nan])})
    journal.append({"q": 1})
    journal.close()


def test_the_journal_of_another_arm_is_refused(tmp_path):
    with aj.live.Session(SETUP, [Scripted()], path=tmp_path / "c.h5"):
        pass
    cone = aj.data.observations.SimulatedSocket("B", (400, 200, 300), 5)
    other = aj.live.setup_of(SETUP.specification, SETUP.noise, [cone])
    with pytest.raises(aj.InputError, match="has the place 'A', which this capture does not have"):
        aj.live.Session(other, [Scripted()], path=tmp_path / "c.h5")
    with pytest.raises(aj.InputError, match="no device reads the joints"):
        aj.live.Session(SETUP, [], path=tmp_path / "d.h5")


def killed_at_random(folder: Path, kills: int, seed: int) -> dict[str, int]:
    """Kill a capture and continue it, so many times; every pose that it told must be in the journal, once."""
    path, told, dropped, moment = folder / "c.h5", {}, 0, random.Random(seed)
    for kill in range(kills):
        command = [sys.executable, "-m", killed.__name__, str(path), str(kill)]
        root = Path(killed.__file__).parents[2]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=root) as process:
            assert process.stdout.readline() == "ready\n"
            time.sleep(moment.uniform(0.05, 2.5))
            process.kill()
            for line in process.stdout.read().splitlines(keepends=True):
                if line.endswith("\n"):
                    number, *rest = json.loads(line)
                    told[number] = rest
        journal = Journal(journal_of(path))
        events = [event for event in journal.events if event["event"] == "pose"]
        dropped += journal.dropped
        journal.close()
        kept = {event["number"]: [event["place"], event["time"]] for event in events}
        assert len(kept) == len(events)
        assert {number: kept.get(number) for number in told} == told
    return {"kills": kills, "told": len(told), "kept": len(kept), "half lines": dropped}


@pytest.mark.slow
def test_a_killed_capture_has_every_pose_that_it_told(tmp_path):
    assert killed_at_random(tmp_path, 3, seed=1)["told"] > 0


ENDING = """
import sys, time
import jax
import aacmm_jax as aj
from aacmm_jax.live import guidance
from tests.live.killed import Hasty, setup
from tests.live.unguided import NoGuide

class Compiling(NoGuide):
    def __init__(self, *_):
        until, size = time.monotonic() + 3, 3
        while time.monotonic() < until:
            size += 1
            jax.jit(lambda x: sum((x * i) @ x.T for i in range(50))).lower(jax.numpy.ones((size, size))).compile()

guidance.Guide = Compiling
session = aj.live.Session(setup(), [Hasty(1)], path=sys.argv[1])
time.sleep(0.5)
if sys.argv[2] == "closed":
    session.close()
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", ["closed", "left"])
def test_a_process_ends_well_while_guidance_is_compiled(tmp_path, how):
    command = [sys.executable, "-c", ENDING, str(tmp_path / "capture.h5"), how]
    ended = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_what_guidance_leaves_out_is_not_written():
    """One pose of twenty that is 0.5 mm off makes the calibration of a SCARA worse than its nominal arm."""
    poses = [TakenPose(number, "A", 0.0, np.zeros(6), np.zeros(6)) for number in (1, 2, 3)]
    looks = [{1: False, 2: True}, {1: False, 2: True, 3: False}]  # the last pose is seen at the second look

    def look():
        outliers = looks.pop(0) if len(looks) > 1 else looks[0]
        found = {number: SimpleNamespace(outlier=outlier) for number, outlier in outliers.items()}
        return poses, SimpleNamespace(poses=found)

    assert [pose.number for pose in fitting(look, threading.Event())] == [1, 3]
    assert len(looks) == 1
    assert fitting(lambda: (poses, None), threading.Event()) == poses
