"""Hostile calls of the command line, in this process: ``python benchmarks/hostile_calls.py [--count 200] [--seed 1]``.

Each call must end with exit code 0, 1 or 2 and, for 2, one sentence on standard error and no file written; nothing that
was there before may change but the outputs that the call names, and no temporary file may be left. Prints counts and
every call that broke this; exit code 1 where there was one.
"""

import argparse
import collections
import contextlib
import io
import os
import random
import signal
import sys
import tempfile
from pathlib import Path

import aacmm_jax as aj
from aacmm_jax.cli import main as aacmm
from aacmm_jax.data.recording import Recording
from aacmm_jax.files.arms import specification_toml

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


class Hang(BaseException):
    """The time limit of one call has passed."""


def stop(*_: object) -> None:
    raise Hang


def prepare(folder: Path) -> None:
    """One file of every kind, and what is no file."""
    arm = aj.files.load_specification("cheng2018-simulation")
    (folder / "arm.toml").write_text(specification_toml(arm))
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300)}
    capture = aj.simulate(
        arm.arm, sockets, poses={"A": 30, "B": 3}, lengths=[("A", "B", 0.002)], encoder_arcsec=2, seating=0.005, seed=1
    )
    aj.files.save_capture(folder / "capture.h5", Recording(capture, arm))
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


def call(choose: random.Random) -> list[str]:
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


def run(words: list[str]) -> tuple[int | str, str, str]:
    """Exit code (or what went wrong), standard output and standard error."""
    output, errors = io.StringIO(), io.StringIO()
    signal.alarm(SECONDS)
    kept = sys.argv
    sys.argv = ["aacmm", *words]
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            aacmm()
        code: int | str = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 0 if ended.code is None else str(ended.code)
    except Hang:
        code = "hang"
    except BaseException as error:
        code = f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        sys.argv = kept
    return code, output.getvalue(), errors.getvalue()


def content(folder: Path) -> dict[str, bytes]:
    """Every regular file below a folder."""
    found = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def judged(words: list[str], code: int | str, errors: str, before: dict[str, bytes], after: dict[str, bytes]) -> str:
    """What is wrong with how a call ended; empty where nothing is."""
    sentence = errors.strip()
    if code == "hang":
        return "hang"
    if code not in (0, 1, 2) or "failed unexpectedly" in errors or "Traceback" in errors:
        return "unexpected failure"
    if code == 2 and not (sentence.endswith((".", "?")) and sentence.count("\n") == 0) and "Usage:" not in errors:
        return "not one sentence"
    if "\x1b" in errors.replace(" ".join(words), ""):
        return "control characters"
    changed = {name for name in before | after if before.get(name) != after.get(name)}
    if any(name.endswith(".part") for name in after):
        return "temporary file left"
    if code == 2 and changed:
        return f"exit code 2, but changed {sorted(changed)}"
    named = collections.Counter(os.path.normpath(word) for word in words)
    named.update(name for word in words for name in READ_BY.get(word, ()))
    lost = {name for name in changed if name in before and named[name] != 1}  # once: as the output
    return f"changed {sorted(lost)}" if lost else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    choose = random.Random(options.seed)
    signal.signal(signal.SIGALRM, stop)
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as name, contextlib.chdir(name):
        folder = Path(name)
        prepare(folder)
        run(["calibrate", "capture.h5", "-o", "calibration.h5"])
        before = content(folder)
        if "calibration.h5" not in before:
            sys.exit("the calibration that the calls start from failed")
        for number in range(options.count):
            words = call(choose)
            code, _, errors = run(words)
            after = content(folder)
            wrong = judged(words, code, errors, before, after)
            counts[f"exit code {code}" if not wrong else wrong.partition(" [")[0]] += 1
            if wrong:
                shown = [word[:60] for word in words]
                print(f"{number}: {wrong}: {shown!r} -> {code}: {errors[:300]!r}", flush=True)
            for path in set(after) - set(before):
                (folder / path).unlink()
            for path, stored in before.items():
                if after.get(path) != stored:
                    (folder / path).write_bytes(stored)
    print(", ".join(f"{count} {what}" for what, count in sorted(counts.items())))
    sys.exit(0 if all(what.startswith("exit code") for what in counts) else 1)


if __name__ == "__main__":
    main()
