"""Errors on held-out poses of real robots: this toolkit, figaroh, pybotics and OpenCV on the same poses.

``python benchmarks/accuracy.py [--only points] [--only hand-eye] [--rows pybotics]`` calibrates a UR5 with 800 of 1,000
positions of a reflector and predicts the other 200 (``points``), and finds the target on the flange of a UR10 and its
base in the tracker's frame, by 500 of 2,772 measured poses, with the arm as the maker states it (``hand-eye``). Writes
``results/accuracy.json`` after each row; ``--rows`` computes those alone whose name contains a text. Peers that are not
installed are named as absent; `make peers` installs them.
"""

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from contenders import HERE, peer_python
from evidence import ROOT, run

import aacmm_jax as aj
from aacmm_jax.pipeline.hold_out import held_out_poses

RESULTS = HERE / "results/accuracy.json"
POINTS = "examples/ur5/positions.toml --hold-out 0.2 --seed 0"
HAND_EYE = "examples/ipa_ur10/transforms.toml --only-poses 500 --seed 0"
Row = dict[str, Any]
Rows = dict[str, Callable[[], Row]]  # each is computed when it is called


def ours(command: str) -> Row:
    """The errors that the command prints of the poses held out."""
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "examples").symlink_to(ROOT / "examples", target_is_directory=True)
        begin = time.process_time()
        printed = run(command, Path(name))
        seconds = time.process_time() - begin
    held_out = printed["held_out_poses"]["held_out"]
    angle = {} if held_out["rms_angle_rad"] is None else {"rms_mrad": 1e3 * held_out["rms_angle_rad"]}
    row = {"command": command, "rms_mm": held_out["rms_mm"], "mean_mm": held_out["mean_mm"]} | angle
    return row | {"predicted_mm": held_out["rms_predicted_mm"], "cpu_s": seconds}


def peer(name: str, script: str, **given: Any) -> dict[str, np.ndarray] | None:
    """What a peer's script writes, in its own environment; None where that is not installed."""
    python = peer_python(name)
    if python is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        np.savez(source, **given)
        subprocess.run([python, HERE / "peers" / name / script, source, target], check=True, stdout=subprocess.DEVNULL)
        return dict(np.load(target))


def distances(rows: dict[str, np.ndarray] | None, points: np.ndarray) -> Row:
    if rows is None:
        return {"absent": True}
    error = np.linalg.norm(rows["points"] - points, axis=1)
    row = {"rms_mm": float(np.sqrt(np.mean(error**2))), "mean_mm": float(np.mean(error))}
    return row | {"parameters": len(rows["values"]), "cpu_s": float(rows["seconds"])}


def points() -> Rows:
    """Positions of a reflector on a UR5; base frame and reflector are unknown."""
    recording = aj.files.read_manifest(ROOT / "examples/ur5/positions.toml")
    masks = held_out_poses(recording.capture, 0.2, None, 0)
    parts = recording.capture.observations
    q, seen = (np.concatenate([np.asarray(getattr(part, key)) for part in parts]) for key in ("q", "points"))
    out = np.concatenate([masks[part.name] for part in parts])
    arm = recording.nominal.arm
    given = {key: np.asarray(getattr(arm, key)) for key in ("alpha", "a", "d")}
    given |= {"q": q[~out], "points": seen[~out], "q_unseen": q[out], "points_unseen": seen[out]}
    rows: Rows = {
        "aacmm_jax, D-H": lambda: ours(f"aacmm calibrate {POINTS} --model dh"),
        "aacmm_jax, default": lambda: ours(f"aacmm calibrate {POINTS}"),
    }

    def by(name: str, script: str, **options: Any) -> Row:
        return distances(peer(name, script, **given, **options), given["points_unseen"])

    for elastic, estimation in ((False, "structural"), (True, "structural"), (False, "map")):
        name = f"figaroh 1.0.2, {estimation}{', elastic joints' if elastic else ''}"
        rows[name] = partial(by, "figaroh", "solve.py", elastic=elastic, estimation=estimation)
    for parallel in (False, True):
        name = f"pybotics 3.1.2 and SciPy, d_2 and d_3 {'free' if parallel else 'fixed'}"
        rows[name] = partial(by, "pybotics", "points.py", parallel=parallel)
    return rows


def hand_eye() -> Rows:
    """Poses of a target on a UR10 with the maker's parameters."""
    recording = aj.files.read_manifest(ROOT / "examples/ipa_ur10/transforms.toml")
    (part,) = recording.capture.observations
    assert isinstance(part, aj.data.observations.MeasuredTransforms)
    out = held_out_poses(recording.capture, None, 500, 0)[part.name]
    seen = np.tile(np.eye(4), (len(out), 1, 1))
    seen[:, :3, :3], seen[:, :3, 3] = np.asarray(part.rotations), np.asarray(part.points)
    flange = np.asarray(recording.nominal.arm.replace(probe=np.zeros(3)).pose(part.q))

    @cache
    def found() -> dict[str, np.ndarray] | None:
        return peer("opencv", "solve.py", flange=flange[~out], seen=seen[~out])

    def by(name: str) -> Row:
        every = found()
        return {"absent": True} if every is None else posed(every, name, flange, seen, out)

    rows: Rows = {"aacmm_jax, arm fixed": lambda: ours(f"aacmm calibrate {HAND_EYE} --arm-fixed")}
    for name in ("SHAH", "LI", "TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        rows[f"OpenCV 4, {name.capitalize()}"] = partial(by, name)
    return rows


def posed(found: dict[str, np.ndarray], name: str, flange: np.ndarray, seen: np.ndarray, out: np.ndarray) -> Row:
    """Errors of the held-out poses; where OpenCV gives the mount alone, the base is the mean over the poses used."""
    mounted = flange @ found[f"mount {name}"]
    base = found.get(f"base {name}")
    if base is None:
        base = np.mean(seen[~out] @ np.linalg.inv(mounted[~out]), axis=0)
        left, _, right = np.linalg.svd(base[:3, :3])
        base[:3, :3] = left @ right
    wrong = np.linalg.inv(base @ mounted[out]) @ seen[out]
    distance = np.linalg.norm((base @ mounted[out] - seen[out])[:, :3, 3], axis=1)
    angle = np.arccos(np.clip((np.trace(wrong[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    row = {"rms_mm": float(np.sqrt(np.mean(distance**2))), "mean_mm": float(np.mean(distance))}
    return row | {"rms_mrad": float(1e3 * np.sqrt(np.mean(angle**2))), "cpu_s": float(found[f"seconds {name}"])}


PARTS = {"points": points, "hand-eye": hand_eye}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS, action="append", help="parts to run; all by default")
    parser.add_argument("--rows", default="", help="compute only the rows whose name contains this text")
    given = parser.parse_args()
    for part in given.only or PARTS:
        for name, computed in PARTS[part]().items():
            if given.rows in name:
                row = computed()
                print(name, row, flush=True)
                results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}  # now: others may run beside this
                results.setdefault(part, {})[name] = row
                RESULTS.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
