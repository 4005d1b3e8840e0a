"""An attack on the toolkit with damaged and hostile inputs, counted by outcome; the same seed repeats it.

A single bit of a file is flipped, and the file is read as a command would read it. The outcome must be one of two: the
same result as before, or a refusal in one sentence. Run as a script, it prints a table:

    python benchmarks/hostile.py --seed 1 --flips 2000

A part of it runs with the tests (tests/files/test_hostile.py).
"""

import argparse
import collections
import contextlib
import io
import json
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import aacmm_jax as aj
from aacmm_jax.files.hdf5 import read_summary

SAME, REFUSED, SILENT, UNEXPECTED, HANG = (
    "same result", "refused in one sentence", "silent difference", "unexpected failure", "hang"
)  # fmt: skip
SECONDS = 20  # after which a read counts as hanging
SPECIFICATION = """
arm = "cheng2018-simulation"
trials = 6
seed = 3
[deviation]
length_mm = 1.0
[capture]
positions_mm = [[400, 200, 300]]
poses = 20
pool = 4096
[noise]
encoder_arcsec = [1, 4]
[bounds]
length_mm = 10
[identification]
method = "stage1"
"""


class Target(NamedTuple):
    """A file whose bits are flipped, and what is read of it."""

    file: Path
    read: Callable[[], Any]
    command: list[str]  # of the command line, that reads it


def same_form(value: Any) -> Any:
    """A result as nested tuples that compare equal exactly where every bit of it is equal."""
    import jax

    if isinstance(value, dict):
        return tuple((key, same_form(item)) for key, item in sorted(value.items()))
    if isinstance(value, tuple | list | frozenset):
        items = sorted(value) if isinstance(value, frozenset) else value
        return tuple(same_form(item) for item in items)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return tuple(map(str, value.tolist()))
    if isinstance(value, np.ndarray | np.generic | jax.Array | float):
        array = np.asarray(value)
        return array.dtype.str, array.shape, array.tobytes()
    leaves, structure = jax.tree.flatten(value)
    if len(leaves) == 1 and leaves[0] is value:
        return repr(value)
    return str(structure), tuple(same_form(leaf) for leaf in leaves)


def targets(folder: Path) -> dict[str, Target]:
    """One file of each kind, made in a folder."""
    arm = aj.files.load_specification("cheng2018-simulation")
    sockets = {"A": (400, 200, 300), "B": (300, 350, 300), "C": (300, -350, 400)}
    capture = aj.simulate(arm.arm, sockets, poses=14, lengths=[("A", "B", 0.002)], encoder_arcsec=2.0, seed=1)
    recording = aj.Recording(capture, arm, arm, seed=1)
    record = aj.calibration.record_of(aj.calibrate(arm.arm, capture, arm.bounds()), recording)
    aj.files.save_capture(folder / "capture.h5", recording)
    aj.files.save_calibration(folder / "calibration.h5", record)
    evaluation = aj.acceptance.evaluation_of(record, recording, maxima={"rms_mm": 0.1})
    aj.files.save_evaluation(folder / "evaluation.h5", evaluation)
    tips = {name: np.asarray(arm.arm.position(q)) for name, q in capture.sockets.items()}
    measured = aj.acceptance.Measured(tips, capture.lengths, ())
    aj.files.save_points(folder / "points.h5", aj.acceptance.PointsRecord(measured))
    (folder / "study.toml").write_text(SPECIFICATION)
    study = aj.study.read_study(folder / "study.toml")
    aj.study.run_study(study, folder / "study.h5", chunk=3)
    (folder / "parts").mkdir()
    aj.study.run_study(study, folder / "parts" / "study.h5", chunk=3, keep_parts=True)
    block = sorted((folder / "parts" / "study.h5.parts").glob("*.h5"))[0]

    def study_results(path: Path) -> Any:
        results = aj.study.Results.of(path)
        return results.finished, [results.columns(cell) for cell in range(len(results.study.cells))], [
            list(results.errors(cell)) for cell in range(len(results.study.cells))
        ]  # fmt: skip

    def reader(kind: str, load: Callable) -> Target:
        path = folder / f"{kind}.h5"
        both = lambda: (read_summary(path, ("capture", "calibration", "evaluation", "study")), load(path))  # noqa: E731
        return Target(path, both, ["show", str(path), "--json"])

    return {
        "capture": reader("capture", aj.files.load_capture),
        "calibration": reader("calibration", aj.files.load_calibration),
        "evaluation": reader("evaluation", aj.files.load_evaluation),
        "points": reader("points", aj.files.load_points),
        "study": reader("study", study_results),
        "block": Target(
            block,
            lambda: study_results(folder / "parts" / "study.h5"),
            ["show", str(folder / "parts" / "study.h5"), "--json"],
        ),
    }


@contextlib.contextmanager
def limited_time() -> Iterator[None]:
    """An exception in work that takes too long."""

    def stop(*_: object) -> None:
        raise TimeoutError

    former = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former)


def outcome(read: Callable[[], Any], expected: Any) -> tuple[str, str]:
    """What came of a read: the outcome, and the message where there is one."""
    try:
        with limited_time(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = same_form(read())
    except aj.InputError as error:
        text = str(error)
        return (REFUSED if "\n" not in text and text.endswith((".", "?")) else UNEXPECTED), text
    except TimeoutError:
        return HANG, ""
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return UNEXPECTED, f"{type(error).__name__}: {error}"
    return (SAME if found == expected else SILENT), ""


def flips(target: Target, count: int, random: np.random.Generator) -> Iterator[tuple[int, int, str, str]]:
    """Flip single bits of a file, one at a time: the byte, the bit, the outcome and its message."""
    content = target.file.read_bytes()
    expected = same_form(target.read())
    try:
        for position, bit in zip(
            random.integers(len(content), size=count), random.integers(8, size=count), strict=True
        ):
            damaged = bytearray(content)
            damaged[position] ^= 1 << int(bit)
            target.file.write_bytes(damaged)
            yield int(position), int(bit), *outcome(target.read, expected)
    finally:
        target.file.write_bytes(content)


def command_line(arguments: list[str]) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of a command, run in this process."""
    from aacmm_jax.cli import main

    output, errors, former = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["aacmm", *arguments]
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            main()
        code = 0
    except SystemExit as ended:
        code = int(ended.code or 0)
    finally:
        sys.argv = former
    return code, output.getvalue(), errors.getvalue()


def commands(target: Target, count: int, random: np.random.Generator) -> Iterator[tuple[int, int, str, str]]:
    """The same as `flips`, through the command line."""
    before = command_line(target.command)

    def read() -> Any:
        code, output, errors = command_line(target.command)
        if code == 2:
            raise aj.InputError(errors.strip().removeprefix("Error: "))
        return code, output, errors

    yield from flips(target._replace(read=read), count, random)
    assert command_line(target.command) == before


def attack_files(
    folder: Path, seed: int, count: int, sample: int, kinds: list[str] | None = None
) -> dict[str, collections.Counter[str]]:
    """Flip bits of files of all kinds; counts by kind and outcome. ``sample``: of each kind, by the command line."""
    found: dict[str, collections.Counter[str]] = {}
    for number, (kind, target) in enumerate(targets(folder).items()):
        if kinds and kind not in kinds:
            continue
        for way, work, times in (("", flips, count), (" (command)", commands, sample)):
            counter = found[kind + way] = collections.Counter()
            for position, bit, result, message in work(target, times, np.random.default_rng([seed, number])):
                counter[result] += 1
                if result in (SILENT, UNEXPECTED, HANG):
                    print(f"{kind}: byte {position} bit {bit}: {result} {message}", file=sys.stderr, flush=True)
            print(f"{kind}{way}: {dict(counter)}", file=sys.stderr, flush=True)
    return found


# Mutated texts (--texts) and hostile calls (--calls) are added here, each as a function like `attack_files`.


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--flips", type=int, default=2000, help="single-bit flips in a file of each kind")
    options.add_argument("--sample", type=int, default=20, help="of them, through the command line")
    options.add_argument("--texts", type=int, default=0, help="mutated texts (not yet written)")
    options.add_argument("--calls", type=int, default=0, help="hostile calls (not yet written)")
    options.add_argument("--kinds", nargs="*", help="kinds of files; default: all")
    given = options.parse_args()
    started, folder = time.process_time(), Path(tempfile.mkdtemp())
    try:
        found = attack_files(folder, given.seed, given.flips, given.sample, given.kinds)
    finally:
        shutil.rmtree(folder)
    seconds = time.process_time() - started
    print(json.dumps({"seed": given.seed, "outcomes": found, "cpu_seconds": round(seconds)}, indent=2))
    if any(counter[bad] for counter in found.values() for bad in (SILENT, UNEXPECTED, HANG)):
        sys.exit(1)


if __name__ == "__main__":
    main()
