"""A capture in a terminal of its own: its keys, and what is left however it ends."""

import contextlib
import os
import select
import signal
import subprocess
import sys
import termios
import time

import pytest

import aacmm_jax as aj
from aacmm_jax.live import terminal
from aacmm_jax.live.journal import Journal

KIT = """
[[artefact]]
name = "bar"
points = { 1 = [0, 0, 0], 2 = [300, 0, 0] }
frame = [0, 0, 0.7, 300, -200, 300]
u = 0.001
poses = 4
"""


# As a login gives it: what hangs up ends what runs in it. JAX allows no fork of this process.
OWN_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "status"),
    [("auxxsf", 0), ("q", 0), ("\x03", 130), (signal.SIGTERM, 143), (None, -signal.SIGHUP)],
    ids=["keys", "q", "Ctrl-C", "SIGTERM", "hang-up"],
)
def test_however_a_capture_ends_its_poses_are_kept_and_the_terminal_is_as_before(tmp_path, end, status):
    (tmp_path / "kit.toml").write_text(KIT)
    command = [sys.executable, "-m", "aacmm_jax", "live", "cheng2018-simulation", "--terminal", "--kit", "kit.toml"]
    command = [sys.executable, "-c", OWN_TERMINAL, *command]
    command += ["--device", "simulated:?speed=20", "-o", "c.h5", "--keep-stream", "stream.txt", "--capture-only"]
    terminal, own = os.openpty()
    before, seen, journal = termios.tcgetattr(own), b"", tmp_path / "c.h5.journal"
    until = time.monotonic() + 120

    def read(seconds: float = 0.1) -> bytes:
        with contextlib.suppress(OSError):
            return os.read(terminal, 65536) if select.select([terminal], [], [], seconds)[0] else b""
        return b""

    with subprocess.Popen(
        command, cwd=tmp_path, stdin=own, stdout=own, stderr=own, start_new_session=True,
        env={**os.environ, "TERM": "xterm"},
    ) as process:  # fmt: skip
        while time.monotonic() < until and (not journal.exists() or journal.read_bytes().count(b'"pose"') < 3):
            seen += read()
        if isinstance(end, str):
            for key in end:
                os.write(terminal, key.encode())
                seen += read(0.5)
        elif end is not None:
            process.send_signal(end)
        else:
            os.close(terminal)
        while process.poll() is None and time.monotonic() < until:
            seen += read() if end is not None else b""
            time.sleep(0.01)
        process.kill()
    assert (process.returncode, b"Traceback" in seen) == (status, False)
    if end is not None:
        assert termios.tcgetattr(own) == before
        os.close(terminal)
    os.close(own)
    left = Journal(journal)
    events = [event["event"] for event in left.events if event["event"] != "pose"]
    left.close()
    assert len(left.events) > len(events)
    if end == "auxxsf":
        assert events == ["begin", "undo", "exclude", "exclude", "mark", "finished"]
        assert aj.files.load_capture(tmp_path / "c.h5").nominal.arm.joints == 6


@pytest.mark.parametrize(
    ("typed", "key"), [("x", "x"), ("\x03", "q"), ("\xe0Hs", "s"), ("\x00;\xe0M ", " "), ("\xe0K\x03", "q")]
)
def test_arrows_of_the_console_of_windows_are_not_letters_and_ctrl_c_ends(typed, key):
    characters = iter(typed)
    assert terminal._console_key(lambda: next(characters)) == key
    assert not [*characters]
