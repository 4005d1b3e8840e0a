"""Hostile arguments of commands, run in this process.

Each call ends with exit code 0, 1 or 2 and, for 2, one sentence on standard error and no file written. Nothing that was
there before changes but the outputs that the call names, and no temporary file is left.
"""

import collections
import contextlib
import os
import random
from collections.abc import Iterator
from pathlib import Path

import aacmm_jax as aj

from .outcomes import DONE, LOST, REFUSED, UNEXPECTED, Attempt, command_line, contents, ending, is_sentence

SECONDS = 120
NUMBERS = [
    "nan",
    "inf",
    "-1",
    "1e300",
    "1_0",
    "\u0663",
    "",
    "1e-300",
    "0",
    "99999999999999999999",
    "abc",
    "--",
    "\x1b[2J",
]
COUNTS = ["0", "-1", "99999999", "1_0", "\u0663", "1.5", "9" * 5001, "nan", ""]
OUTPUTS = [
    *("folder", "none/x.h5", "read-only.h5", "/dev/null", "/proc/x", "x" * 300, "fifo", "loop", "old.h5", "new.h5"),
    *("arm.toml", "capture.h5", "A.csv", "m.toml", "p.toml", "link.csv", "calibration.h5", "s.toml", "", "."),
]
INPUTS = [
    *("folder", "none.h5", "/dev/null", "fifo", "loop", "A.csv", "m.toml", "p.toml", "arm.toml", "s.toml", "empty"),
    *("capture.h5", "calibration.h5", "cut.h5", "x" * 300, "", "\x1b[2J", "--", "\udcff"),
]
SOCKETS = ["A=1,2", "A=1,2,3,4", "=1,2,3", "A=nan,0,0", "A=1e300,0,0", "A=9999,9999,9999", "\x1b[2J=400,200,300", "A"]
LENGTHS = ["A", "A,A", "A,C", "A,B,-1", "A,B,nan", "A,B,1_0", '"A,B', "A,B,1,2", ",", "A,B,1e300"]
NAMES = [
    "d_1",
    "d_99",
    "",
    "\x1b[2J",
    "d_1,d_1",
    "alpha_1,,",
    "all",
    "d_1=1",
    "d_1=nan",
    "d_1=-1",
    "x=1",
    "=",
    "d_1=1e300",
]

READ_BY = {
    "m.toml": ("A.csv", "A.csv", "B.csv", "B.csv", "arm.toml"),
    "p.toml": ("PA.csv", "PA.csv"),
    "s.toml": ("arm.toml", "capture.h5"),
    "link.csv": ("A.csv",),
}  # what a file makes a command read; twice where it is no output of these calls


def prepare(folder: Path) -> None:
    """One file of every kind, and what is no file."""
    arm = aj.files.load_specification("cheng2018-simulation")
    aj.files.save_arm(arm.arm, folder / "arm.toml")
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    capture = aj.simulate(
        arm.arm, sockets, poses={"A": 30, "B": 3}, lengths=[("A", "B", 0.002)], encoder_arcsec=2, seating=0.005, seed=1
    )
    aj.files.save_capture(folder / "capture.h5", aj.Recording(capture, arm))
    (folder / "cut.h5").write_bytes((folder / "capture.h5").read_bytes()[:3000])
    for name in "AB":
        rows = [",".join(repr(float(x)) for x in row) for row in capture.sockets[name]]
        (folder / f"{name}.csv").write_text("\n".join(rows) + "\n")
    (folder / "PA.csv").write_text("100.0,0.5,0.25\n100.5,0.5,0.5\n100.5,0.25,0.125\n")
    (folder / "m.toml").write_text(
        'arm = "arm.toml"\n[angles]\nunit = "rad"\n'
        '[[socket]]\nname = "{h}"\nfile = "{h}.csv"\nexclude = ["PA.csv", "l*"]\n'
    )
    (folder / "p.toml").write_text('[points]\nunit = "mm"\n[[socket]]\nfile = "PA.csv"\n')
    (folder / "s.toml").write_text('arm = "arm.toml"\ntrials = 1\n[capture]\nfile = "capture.h5"\n')
    (folder / "l.toml").write_text('[laboratory]\nname = "L"\n')
    (folder / "empty").touch()
    (folder / "old.h5").write_text("old")
    (folder / "read-only.h5").touch(0o444)
    (folder / "folder").mkdir()
    os.mkfifo(folder / "fifo")
    (folder / "loop").symlink_to("loop")
    (folder / "link.csv").symlink_to("A.csv")


def hostile_words(choose: random.Random) -> list[str]:
    """A command with one or two hostile words in it."""
    one = choose.choice
    output = one([*OUTPUTS, "new.h5", "new.h5"])
    socket = ["--socket", "A=400,200,300", "--socket", "B=600,200,300", "--poses", "3"]
    pick = choose.random()
    if pick < 0.25:
        more = [
            *one([("--socket", one(SOCKETS)), ("--length", one(LENGTHS)), ("--poses", one(COUNTS)), ()]),
            *one([("--seating-mm", one(NUMBERS)), ("--seed", one(COUNTS)), ("--true-arm", one(INPUTS)), ()]),
        ]
        return ["simulate", one(["arm.toml", "arm.toml", one(INPUTS)]), *socket, "-o", output, *more]
    if pick < 0.4:
        return ["import", one(["m.toml", "m.toml", one(INPUTS)]), "-o", output]
    if pick < 0.6:
        more = one(
            [
                ("--hold", one(NAMES)),
                ("--held", one(NAMES)),
                ("--free", one(NAMES)),
                ("--bound", one(NAMES)),
                ("--only", one(NAMES)),
                ("--length-bound-mm", one(NUMBERS)),
                ("--encoder-arcsec", one(NUMBERS), "--seating-mm", one(NUMBERS)),
                ("--figure", one(["x.png", "x.xyz", "capture.h5", "folder/x.png", "none/x.png"])),
                ("--max-steps", one(COUNTS)),
            ]
        )
        return ["calibrate", one(["capture.h5", "capture.h5", one(INPUTS)]), "-o", output, *more]
    if pick < 0.7:
        more = one(
            [("-o", output), ("--mpe", one([*NAMES, "Deltam=nan", "Deltam=1_0"])), ("--max-rms-mm", one(NUMBERS))]
        )
        return ["evaluate", one(["calibration.h5", one(INPUTS)]), *one([("capture.h5",), (one(INPUTS),), ()]), *more]
    if pick < 0.78:
        form = one(["toml", "json", "csv", "dcc", "xyz"])
        about = ("--about", one(["l.toml", one(INPUTS)]))
        return ["export", one(["calibration.h5", one(INPUTS)]), "--format", form, "-o", output, *one([about, ()])]
    if pick < 0.84:
        return ["report", one(["calibration.h5", one(INPUTS)]), "-o", output, *one([("--about", one(INPUTS)), ()])]
    if pick < 0.9:
        return ["show", one(INPUTS), *one([(), ("--json",), ("--cell", one(COUNTS)), ("--figures", one(OUTPUTS))])]
    if pick < 0.94:
        return ["compare", "calibration.h5", one(INPUTS), *one([("--csv", output), ("--level", one(NUMBERS))])]
    if pick < 0.97:
        return ["study", one(["s.toml", one(INPUTS)]), "-o", output, *one([("--trials", one(COUNTS)), ("--resume",)])]
    more = one(
        [("--poses", one(COUNTS)), ("--region", one(NAMES)), ("--length-mm", one(NUMBERS)), ("--socket", one(SOCKETS))]
    )
    return ["plan", one(["arm.toml", one(INPUTS)]), "-o", output, *more]


def judged(
    words: list[str], code: int, errors: str, before: dict[str, bytes], after: dict[str, bytes]
) -> tuple[str, str]:
    """The outcome of a command that ended, and what is wrong with it."""
    sentence = errors.strip()
    if code not in (0, 1, 2) or "failed unexpectedly" in errors or "Traceback" in errors:
        return UNEXPECTED, f"exit code {code}: {sentence}"
    if code == 2 and not is_sentence(sentence) and "Usage:" not in errors:
        return UNEXPECTED, f"not one sentence: {sentence!r}"
    if "\x1b" in errors.replace(" ".join(words), ""):
        return UNEXPECTED, f"control characters: {sentence!r}"
    changed = {name for name in before | after if before.get(name) != after.get(name)}
    if any(name.endswith(".part") for name in after):
        return LOST, f"a temporary file is left: {sorted(after)}"
    if code == 2 and changed:
        return LOST, f"refused, but changed {sorted(changed)}"
    named = collections.Counter(os.path.normpath(word) for word in words)
    named.update(name for word in words for name in READ_BY.get(word, ()))
    lost = sorted(name for name in changed if name in before and named[name] != 1)  # once: as the output
    return (LOST, f"changed {lost}") if lost else (REFUSED if code == 2 else DONE, "")


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many commands in a folder, each of which starts from the same files."""
    choose = random.Random(seed)
    with contextlib.chdir(folder):
        prepare(folder)
        code, _, errors = command_line(["calibrate", "capture.h5", "-o", "calibration.h5"])
        assert (folder / "calibration.h5").exists(), (code, errors)
        before = contents(folder)
        for _ in range(count):
            words = hostile_words(choose)
            outcome, found = ending(lambda words=words: command_line(words), SECONDS)
            after = contents(folder)
            if outcome is None:
                outcome, found = judged(words, found[0], found[2], before, after)
            yield Attempt(words[0], outcome, f"{[word[:60] for word in words]} {found}")
            for path in set(after) - set(before):
                (folder / path).unlink()
            for path, stored in before.items():
                if after.get(path) != stored:
                    (folder / path).write_bytes(stored)
