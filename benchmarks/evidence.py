"""Public captures of real arms, calibrated by the command line and tested on poses that the calibration has not seen.

``make evidence`` (``python benchmarks/evidence.py [--only ur5 ...]``) runs the commands of every set of `SETS`, keeps
the figures in ``results/evidence.json``, and writes ``docs/evidence/table.md`` from them. All sets are in `examples`,
each with its licence. Fifteen minutes of CPU time; ``--only`` recomputes some sets, ``--write`` the page alone.
"""

import argparse
import atexit
import contextlib
import functools
import io
import json
import shlex
import sys
import tempfile
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aacmm_jax.cli import main as aacmm

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / "benchmarks/results/evidence.json", ROOT / "docs/evidence/table.md"
MODELS = {"D-H": "--model dh", "default": ""}


class Set(NamedTuple):
    """One capture and one way to hold poses out of it.

    Attributes:
        manifest: the capture, in `examples`.
        title: arm, instrument and poses.
        held_out: what is held out, in words.
        groups: what each run holds out, as options of ``calibrate``.
        authors: what the authors of the data report.
        caveats: what to know before comparing.
        other: another capture of the same arm, which is tested instead of the poses held out.
    """

    manifest: str
    title: str
    held_out: str
    groups: tuple[str, ...]
    authors: str
    caveats: str
    other: str = ""


def placements(*names: str) -> tuple[str, ...]:
    return tuple(f"--hold-out {name} --no-cross-validate" for name in names)


UR5 = "UR5, laser tracker (Jacobi 2025), 1,000 poses on a grid"
UR5_AUTHORS = "2.566 to 0.155 mm mean (20 other poses)"
UR10 = "UR10, laser tracker (Landgraf et al. 2021), 500 of 2,772 poses of series C"
MUKCA = "MUKCa (Franzese et al. 2025), ball in two sockets at 50 mm"
MUKCA_AUTHORS = "about 10 to 0.2 mm mean (all Panda and iiwa)"
TRACKER = (
    "The frame of the tracker and the place of the reflector are those of the calibration, not fitted to the held-out "
    "poses. "
)
MUKCA_CAVEATS = (
    "No instrument measured positions: the errors are distances from the centroid of each socket, and errors of the "
    "50 mm length. The u of the length (0.01 mm) is an assumption. The authors state the mean absolute error of their "
    "models on data that are partly those of the calibration. With three placements, two calibrate and one tests."
)
PANDA_2 = ["back_left", "back_right", "front_center", "front_left", "front_right", "mid-high", "mid_left", "mid_right"]
PANDA_3 = ["backcenter", "backleft", "backright", "frontcenter", "frontleft", "frontright"]
SETS = {
    "ur5": Set(
        "ur5/positions.toml",
        UR5,
        "a fifth, drawn at random (2 draws)",
        tuple(f"--hold-out 0.2 --seed {seed}" for seed in range(2)),
        UR5_AUTHORS,
        "The authors trained a graph neural network on top of D-H parameters with the grid, commanded 20 random poses "
        "with its corrections, and measured the robot again. Their figure therefore contains what the robot repeats "
        "(0.1 mm according to the maker), what it drifted between the two measurements, and the base frame found "
        "beforehand. Ours is a prediction for other poses of the same recording, between the poses calibrated with: an "
        "easier test. The 20 poses were not used here. The data set does not state the sign of the differences; "
        f"`examples/ur5/README.md` says how it was found. {TRACKER}The nominal robot's frames were fitted to the "
        "poses, so that its error is less than the 2.566 mm of the authors.",
    ),
    "ur5-octants": Set(
        "ur5/positions.toml",
        UR5,
        "two opposite octants of the grid, one at a time",
        tuple(f"--hold-out grid/{octant}" for octant in (1, 8)),
        UR5_AUTHORS,
        f"As above, but the held-out poses lie outside the region of those calibrated with. {TRACKER}",
    ),
    "ur10": Set(
        "ipa_ur10/positions.toml",
        UR10,
        "the other 2,272 poses of C",
        ("--only-poses 500 --seed 0",),
        "none in the repository of the data",
        f"A random split: see [Why random splits mislead](../explanation/random_splits.md). {TRACKER}",
    ),
    "ur10-series-a": Set(
        "ipa_ur10/positions.toml",
        UR10,
        "series A, robot and tracker mounted anew",
        ("--only-poses 500 --seed 0",),
        "none in the repository of the data",
        "Series A was recorded in other branches of the inverse kinematics. Base frame and target were mounted anew "
        "and are fitted to it. D-H parameters alone are worse than no calibration here.",
        other="ipa_ur10/series_a.toml",
    ),
    "panda_2": Set(
        "mukca/capture.toml",
        f"Panda, {MUKCA}, 497 poses",
        "each of 8 placements in turn",
        placements(*PANDA_2),
        MUKCA_AUTHORS,
        MUKCA_CAVEATS,
    ),
    "panda_3": Set(
        "mukca/panda_3.toml",
        f"another Panda, {MUKCA}, 387 poses",
        "each of 6 placements in turn",
        placements(*PANDA_3),
        MUKCA_AUTHORS,
        MUKCA_CAVEATS,
    ),
    "panda_3_bis": Set(
        "mukca/panda_3_bis.toml",
        f"the same Panda, ball mounted anew, {MUKCA}, 180 poses",
        "each of 3 placements in turn",
        placements("front", "left", "right-high"),
        MUKCA_AUTHORS,
        MUKCA_CAVEATS,
    ),
    "panda_6": Set(
        "mukca/panda_6.toml",
        f"Panda, {MUKCA}, 199 poses",
        "each of 3 placements in turn",
        placements("front", "left", "right"),
        MUKCA_AUTHORS,
        MUKCA_CAVEATS,
    ),
    "kuka_14": Set(
        "mukca/kuka_14.toml",
        f"KUKA iiwa 14, {MUKCA}, 180 poses",
        "each of 3 placements in turn",
        placements("front", "left_back", "raised_left"),
        MUKCA_AUTHORS,
        MUKCA_CAVEATS,
    ),
}


NOT_HERE = (
    "Not in the table: the Kinova arm of MUKCa, whose joints have play and whose authors say that the method fails on "
    "it; the 20 random poses of the UR5, with which the authors tested, and the Barrett WAM of the same source; data "
    "without a licence, and data without joint readings."
)


def run(command: str, folder: Path) -> dict[str, Any]:
    """What a command prints with ``--json``; in this process, so that JAX is imported once."""
    output = io.StringIO()
    arguments, sys.argv = sys.argv, [*shlex.split(command), "--json"]
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(io.StringIO()), contextlib.chdir(folder):
            aacmm()
    except SystemExit as ended:
        # Exit code 1: done, but an error was found; what was printed says which.
        if ended.code not in (0, 1, None):
            raise RuntimeError(f"failed: {command}") from ended
    finally:
        sys.argv = arguments
    return json.loads(output.getvalue())


def commands(of: Set, group: str, model: str) -> list[str]:
    """The commands of one run: calibrate, and test on the poses that were held out."""
    calibrate = f"aacmm calibrate examples/{of.manifest} {group} {MODELS[model]}".rstrip()
    capture = f"examples/{of.other or of.manifest}"
    return [
        f"{calibrate} -o calibration.h5",
        f"aacmm import {capture} -o test.h5",
        "aacmm evaluate calibration.h5 test.h5",
    ]


def measured(of: Set, group: str, model: str, nominal: bool) -> dict[str, float]:
    """Errors of one run, mm: of the poses held out, of lengths among them, and of the nominal arm."""
    calibrate, *evaluate = commands(of, group, model)
    folder, calibrated = calibrated_by(calibrate)
    row = {} if of.other else poses_of(calibrated)
    if nominal or of.other or calibrated["sockets_used"]:
        tested = [run(command, folder) for command in evaluate][-1]["held_out"]
        before, after = tested["nominal"], tested["calibrated"]
        row["nominal"] = before.get("rms_mm", before.get("observed_rms_mm"))
        if of.other:
            row |= {"rms": after["observed_rms_mm"], "mean": after["observed_mean_mm"]}
            row |= {"poses": sum(part["poses"] for part in tested["observations"])}
        if "length_error_mean_absolute_mm" in after:
            row |= {"length": after["length_error_mean_absolute_mm"]}
            row |= {"nominal_length": before["length_error_mean_absolute_mm"]}
    return row


@functools.cache
def calibrated_by(command: str) -> tuple[Path, dict[str, Any]]:
    """The folder in which a calibration was written, kept until the process ends, and what was printed."""
    holder = tempfile.TemporaryDirectory()
    atexit.register(holder.cleanup)
    folder = Path(holder.name)
    (folder / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
    return folder, run(command, folder)


def poses_of(calibrated: dict[str, Any]) -> dict[str, float]:
    held_out = calibrated["held_out_poses"]["held_out"]
    return {
        "poses": held_out["poses"],
        "rms": held_out["rms_mm"],
        "mean": held_out["mean_mm"],
        "predicted": held_out["rms_predicted_mm"],
    }


def computed(of: Set, known: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """The figures by model and run, after each run; those that are known are not computed again."""
    for model in MODELS:
        for group in of.groups:
            rows = known.setdefault(model, {})
            if group not in rows:
                # The nominal arm is evaluated beside D-H alone.
                rows[group] = measured(of, group, model, nominal=model == "D-H")
                print(of.manifest, group, model, rows[group], flush=True)
                yield known


def together(rows: list[dict[str, float]], key: str) -> float:
    """RMS over the poses of all runs, or the mean by poses; NaN where a run lacks it."""
    values = np.array([row.get(key, np.nan) for row in rows])
    weights = np.array([row["poses"] for row in rows])
    if key in ("mean", "length", "nominal_length"):
        return float(np.average(values, weights=weights if key == "mean" else None))
    return float(np.sqrt(np.average(values**2, weights=weights)))


def shown(value: float) -> str:
    return f"{value:.3f}" if value < 1 else f"{value:.2f}"


def page(results: dict[str, Any]) -> str:
    """The page: the table, then commands and caveats of each row."""
    lines = [
        "# All real data in one table",
        "",
        "Every public set of readings of a real arm with a licence that we know of, calibrated with the commands below",
        "the table. All errors are of poses that the calibration has *not* used: RMS distance, mean distance in",
        "brackets, and after a semicolon the mean absolute error of the 50 mm length, in mm. D-H: Denavit-Hartenberg",
        "parameters alone. Default: with the model of the joints that `calibrate` chooses, without the held-out poses.",
        "Predicted: the RMS distance that the calibration (default) states for these poses beforehand.",
        "",
        "`make evidence` recomputes everything and writes this page; the figures of each run are in",
        "`benchmarks/results/evidence.json`. [Real arms](real_arms.md) discusses them.",
        "",
        "| | arm and data | held out | authors | nominal | D-H | default | predicted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    present = [name for name, of in SETS.items() if complete(of, results.get(name, {}))]
    for number, name in enumerate(present, start=1):
        of, (plain, default) = SETS[name], ([*results[name][model].values()] for model in MODELS)
        nominal = shown(together(plain, "nominal")) + length(plain, "nominal_length")
        by_model = [
            f"{shown(together(rows, 'rms'))} ({shown(together(rows, 'mean'))}){length(rows, 'length')}"
            for rows in (plain, default)
        ]
        predicted = together(default, "predicted")
        last = "" if np.isnan(predicted) else shown(predicted)
        cells = [str(number), of.title, of.held_out, of.authors, nominal, *by_model, last]
        lines.append(f"| {' | '.join(cells)} |")
    lines += [
        "",
        "## Commands and caveats",
        "",
        "The commands are those of the first run of each row, in a clone of the",
    ]
    lines += ["source; the other runs hold out the next group or take the next seed. D-H: with `--model dh`."]
    of = None
    for number, name in enumerate(present, start=1):
        before, of = of, SETS[name]
        caveats = "As above." if before and of.caveats == before.caveats else of.caveats.strip()
        lines += ["", *textwrap.wrap(f"**{number}. {of.title}.** {caveats}", 120), "", "```text"]
        lines += [*commands(of, of.groups[0], "default"), "```"]
    return "\n".join([*lines, "", *textwrap.wrap(NOT_HERE, 120)]) + "\n"


def complete(of: Set, rows: dict[str, Any]) -> bool:
    return all(set(of.groups) <= rows.get(model, {}).keys() for model in MODELS)


def length(rows: list[dict[str, float]], key: str) -> str:
    return f"; {shown(together(rows, key))}" if key in rows[0] else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=SETS, action="append", default=[], help="sets to compute; default: all")
    parser.add_argument("--missing", action="store_true", help="compute only the runs that are not stored")
    parser.add_argument("--write", action="store_true", help="write the page from the stored results, compute nothing")
    given = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for name in [] if given.write else given.only or SETS:
        for rows in computed(SETS[name], results.get(name, {}) if given.missing else {}):
            results[name] = rows
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    PAGE.write_text(page(results))


if __name__ == "__main__":
    main()
