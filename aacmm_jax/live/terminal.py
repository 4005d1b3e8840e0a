"""A live capture in a terminal: what the page shows, as text, and its keys."""

import contextlib
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

from ..core.errors import InputError
from ..core.text import printable
from .session import Session
from .shown import not_answering

KEYS = "space take   u undo   x exclude   n another pose   s new session   a automatic   f finish   q quit"
_POSES = 8  # of the last ones that are shown
_BELL = "\a"


def show(session: Session, calibrate: bool = True) -> list[str]:
    """Show a session until it is finished (f) or left (q, Ctrl-C); the files that were written.

    Without a terminal, keys are read from standard input, and each pose is a line.
    """
    from rich.console import Console
    from rich.live import Live

    console = Console()
    written: list[str] = []
    message, sound, counted = "", session.state()["sound"], 0
    told: set[str] = set()
    with _keys() as keys, contextlib.ExitStack() as stack:
        live = None
        if console.is_terminal:
            live = stack.enter_context(Live(console=console, refresh_per_second=8, transient=False, auto_refresh=False))
        while True:
            state = session.state()
            if live is not None:
                live.update(_view(state, message), refresh=True)
            else:
                for pose in state["poses"][counted:]:
                    print(f"pose {pose['number']} in {printable(pose['place'])}", flush=True)
                counted = len(state["poses"])
                for text in not_answering(state["live"]["devices"], told):
                    print(printable(text), flush=True)
            if state["sound"] != sound:
                sound = state["sound"]
                if live is not None:
                    console.file.write(_BELL)
            with contextlib.suppress(queue.Empty):
                key = keys.get(timeout=0.1)
                if key == "q":
                    return written
                try:
                    message = _obey(session, key, state)
                    if key == "f":
                        message = "Calibrating ..." if calibrate else "Writing ..."
                        if live is not None:
                            live.update(_view(state, message), refresh=True)
                        written = session.finish(calibrate)
                        return written
                except InputError as error:
                    message = str(error)
                if message and live is None:
                    print(printable(message), flush=True)


def _obey(session: Session, key: str, state: dict[str, Any]) -> str:
    """Do what a key says; a sentence on it."""
    if key == " ":
        return f"Pose {session.take()} taken."
    if key == "u":
        session.undo()
        return "The last pose is removed."
    if key == "x" and state["poses"]:
        last = state["poses"][-1]
        session.exclude(last["number"], not last["excluded"])
        return f"Pose {last['number']} is {'used again' if last['excluded'] else 'excluded'}."
    if key == "n":
        session.skip()
        return "Another pose will be proposed."
    if key == "s":
        session.mark("")
        return "A new session begins."
    if key == "a":
        session.auto(not state["auto"])
        return "Poses are taken by hand." if state["auto"] else "Poses are taken by themselves."
    return ""


def _view(state: dict[str, Any], message: str) -> Any:
    """What a terminal shows of a state."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    live, progress = state["live"], state["progress"]
    still = "still" if live["still"] else "moving"
    tip = "no readings yet" if live["tip"] is None else "tip " + ", ".join(f"{x:.1f}" for x in live["tip"]) + " mm"
    lines = [Text(state["headline"], style="bold"), Text(f"{still}; {tip}; {live['rate']:.0f} readings/s")]
    if (following := state["next"]) is not None:
        texts = [", ".join(f"{x:.1f}" for x in q) for q in (following["from"], following["q"]) if q is not None]
        lines.append(Text("next readings: " + " then ".join(texts)))
    places = Table("place", "poses", box=None)
    for place in state["places"]:
        places.add_row(Text(printable(place["name"])), f"{place['poses']} of {place['wanted']}")
    poses = Table("pose", "place", "residual (mm)", "expected", "", box=None)
    for pose in state["poses"][-_POSES:]:
        remark = "excluded" if pose["excluded"] else "does not fit" if pose["outlier"] else ""
        sizes = [_number(pose["residual_mm"]), _number(pose["expected_mm"])]
        poses.add_row(str(pose["number"]), Text(printable(pose["place"])), *sizes, remark)
    lines += [places, poses]
    if progress["u_length_mm"] is not None:
        after, wanted = _number(progress["u_after_ten_mm"]), progress["u_target_mm"]
        text = f"U of a length {_number(progress['u_length_mm'])} mm, after ten more poses {after} mm"
        lines.append(Text(text + (f", wanted {wanted:g} mm" if wanted else "")))
    lines += [Text(text) for text in (progress["limits"], *state["sentences"][:4]) if text]
    for device in live["devices"]:
        bad = ", ".join(f"{count} {reason}" for reason, count in device["bad"].items())
        where = "" if device["connected"] else "; not connected"
        text = f"{device['name']}: {device['lines']} lines{where}{'; bad: ' + bad if bad else ''} {device['message']}"
        lines.append(Text(printable(text), style="dim"))
    lines += [Text(printable(text)) for text in (message or state["message"],) if text]
    return Group(*lines, Text(KEYS, style="dim"))


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


@contextlib.contextmanager
def _keys() -> Iterator["queue.Queue[str]"]:
    """Keys as they are pressed, without Enter where standard input is a terminal."""
    pressed: queue.Queue[str] = queue.Queue()
    with _unbuffered() as read:

        def listen() -> None:
            while key := read():
                if key not in "\r\n":
                    pressed.put(key)

        threading.Thread(target=listen, name="live keys", daemon=True).start()
        yield pressed


def _console_key(read: Callable[[], str]) -> str:
    """A key of the console of Windows, where arrows and function keys are two characters and Ctrl-C is one."""
    while (key := read()) in ("\x00", "\xe0"):
        read()
    return "q" if key == "\x03" else key


@contextlib.contextmanager
def _unbuffered() -> Iterator[Callable[[], str]]:
    """A function that waits for one key of standard input; an empty text at its end."""
    if os.name == "nt" and sys.stdin.isatty():
        import msvcrt

        yield lambda: _console_key(msvcrt.getwch)  # pyright: ignore[reportAttributeAccessIssue]
        return
    if not sys.stdin.isatty():
        yield lambda: sys.stdin.read(1)
        return
    import termios
    import tty

    number = sys.stdin.fileno()
    before, ended = termios.tcgetattr(number), signal.getsignal(signal.SIGTERM)
    is_main = threading.current_thread() is threading.main_thread()
    try:
        if is_main:  # by default a process that is ended leaves the terminal without echo
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
        tty.setcbreak(number)
        yield lambda: os.read(number, 1).decode("latin-1")
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)
        if is_main:
            signal.signal(signal.SIGTERM, ended)
