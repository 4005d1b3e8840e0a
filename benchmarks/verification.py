"""How often `aj.verify` is right about simulated deliveries, good and bad, from a handful of poses.

``python benchmarks/verification.py [--deliveries N]`` draws arms whose parameters are 0.5 mm and 1 mrad off their
drawing, and what their makers state: the true parameters with errors of a tenth to a half of that (good), or those of
another robot of the type, the right ones with wrong signs, or with errors of one to two times that (bad). Poses, with a
repeatability of 0.03 mm: eight in each of two sockets, with or without a certified distance, or in four; twelve seen by
a tracker; twelve images of a board by a camera on the arm. True is the RMS error of 400 tips over the workspace by
either arm, with base frame and tip fitted. Right is "better" or "worse" with the right sign, or "equivalent" where the
ratio of these errors is within the margin. Prints the verdicts against the ratio, the share of 95 % intervals of the
RMS error that contain that of five times as many such poses, and what recalibrations promise. Where the poses of
sockets do not decide, a second round follows the advice: the plate in two more places, with as many poses
as `verify` says decide it (at least twice, at most six times as many as before), and the verdict by all of them.
"""

import argparse
import warnings
from collections import Counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.kinematics.arm import is_length, joint_limits, parameter_names
from aacmm_jax.kinematics.parameters import ArmSpecification
from aacmm_jax.pipeline.verification import MARGIN

kinds = aj.data.observations
ROBOTS, KINDS = ("ur5e", "ur10e", "fr3", "irb120"), ("sockets", "sockets and length", "two places", "tracker", "board")
LENGTH, ANGLE = 0.5, 1e-3  # standard deviations of the true parameters, mm and rad
REPEATABILITY, TOOL = 0.03, np.array([15.0, -30.0, 110.0])  # mm
POSES, SEEN, TESTED = 8, 12, 400
MOST = 96  # poses of a second round where the first gives no number
MANY, CHECKED = 5, 20  # times as many poses, whose RMS error is the true one of such poses; deliveries compared so
UNDECIDED = "not decided"
LENS = (620.0, 615.0, 322.0, 241.0, -0.1, 0.05, 0.001, -0.001, 0.02)


def drawn(seed: int, robot: str, what: str) -> tuple[aj.Arm, aj.Arm, aj.Arm]:
    """The nominal arm, the true one, and the delivered one."""
    random = np.random.default_rng(seed)
    nominal = to_numpy(aj.load_arm(robot)).replace(probe=TOOL)
    space = aj.Parameters(nominal, tuple(x for x in parameter_names(nominal) if not x.startswith(("probe", "beta"))))
    sizes = np.where([is_length(name) for name in space.names], LENGTH, ANGLE)
    start, error = np.asarray(space.vector()), random.normal(size=len(sizes)) * sizes
    other = random.normal(size=len(sizes)) * sizes
    delivered = {
        "good": error + random.uniform(0.1, 0.5) * other,
        "another robot": other,
        "wrong signs": -error,
        "worse": error + random.uniform(1.0, 2.0) * other,
    }[what]
    return nominal, space.arm(start + error), space.arm(start + delivered)


def recorded(true: aj.Arm, kind: str, seed: int, times: int = 1) -> aj.Capture:
    """A handful of poses, or so many ``times`` as many."""
    poses, images = POSES * times, SEEN * times
    random, noise = np.random.default_rng(seed), aj.Noise(encoder_arcsec=5.0, seating=REPEATABILITY)
    options: dict[str, Any] = {"noise": noise, "seed": seed}
    if kind == "board":
        places: dict[str, Any] = {
            "frame": (3.08, 0.1, 0.0, -400.0, -150.0, 0.0),
            "mount": (60.0, -10.0, 20.0, 0, 0, 0.3),
        }
        grid = [(25.0 * i, 25.0 * j, 0.0) for j in range(5) for i in range(8)]
        eye = kinds.SimulatedPixels(
            *("eye", images, "webcam", "board", grid, LENS, (640, 480)),
            on_arm=True,
            distance=(250, 450),
            u=0.2,
            **places,
        )
        return aj.simulate(true, {}, observations=[eye], **options)
    if kind == "tracker":
        limits = np.clip(np.asarray(joint_limits(true, None)), -np.pi, np.pi)
        q = random.uniform(limits[:, 0], limits[:, 1], (images, true.joints))
        points = np.asarray(true.position(q)) @ Rotation.from_quat(random.normal(size=4)).as_matrix().T + 2000.0
        points = points + random.normal(size=points.shape) * np.hypot(REPEATABILITY, 0.02)
        return aj.Capture({}, [], [kinds.MeasuredPoints("tracker", q, points, u=0.02, target="ball")])
    sockets = {"A": (-350.0, -200.0, 100.0), "B": (-250.0, -200.0, 100.0)}
    if true.joints == 7 or (true.joints == 6 and float(np.asarray(true.d)[0]) > 250):  # those that reach forward
        sockets = {name: (400.0, y, 200.0) for name, (_, y, _) in zip("AB", ((0, 0.0, 0), (0, 100.0, 0)), strict=True)}
    if kind == "two places":  # the plate is moved
        sockets |= {"C": (-150.0, 300.0, 350.0), "D": (-150.0, 300.0, 450.0)}
    lengths = [aj.ReferenceLength("A", "B", 100.0, u=0.03)] if kind != "sockets" else []
    return aj.simulate(true, sockets, poses=poses, lengths=lengths, **options)


def second_round(first: aj.Capture, checked: Any, true: aj.Arm, seed: int) -> aj.Capture:
    """The poses that did not decide, and those that are recorded then."""
    times = int(np.clip(-(-(checked.decided_by or MOST) // checked.poses), 2, 6))
    again = recorded(true, "two places", seed + 10_000, times)
    return aj.join_sessions({"first": first, "second": again}, own_probe=False)


def true_error(arm: aj.Arm, true: aj.Arm, seed: int = 0) -> float:
    """RMS distance of tips over the workspace with the base frame and the tip of ``arm`` fitted to the true arm, mm."""
    limits = np.clip(np.asarray(joint_limits(true, None)), -np.pi, np.pi)
    q = np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (TESTED, true.joints))
    points, poses = np.asarray(true.position(q)), np.asarray(arm.replace(probe=np.zeros(3)).pose(q))
    error, turned = points - np.asarray(arm.position(q)), poses[:, :3, :3]
    columns = np.concatenate(
        [np.stack([np.cross(axis, points) for axis in np.eye(3)], axis=2), np.tile(np.eye(3), (TESTED, 1, 1)), turned],
        axis=2,
    ).reshape(-1, 9)
    rest = error.ravel() - columns @ np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
    return float(np.sqrt(np.sum(rest**2) / TESTED))


def judged(verdict: str, ratio: float) -> str:
    """Whether a verdict is right, where the ratio of the true errors, delivered over nominal, is this."""
    if verdict == UNDECIDED:
        return UNDECIDED
    true = MARGIN <= ratio <= 1 / MARGIN if verdict == "equivalent" else (verdict == "better") == (ratio < 1)
    return "right" if true else "wrong"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--deliveries", type=int, default=100)
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    for kind in arguments.kinds:
        counts: dict[str, Counter[str]] = {"first round": Counter(), "after a second": Counter()}
        clear = inside = 0
        gains, needed = [], []
        for seed in range(arguments.deliveries):
            what = ("good", ("another robot", "wrong signs", "worse")[seed // 2 % 3])[seed % 2]
            robot = "ur10e" if kind == "board" else ROBOTS[seed % len(ROBOTS) if seed % 3 else 0]
            nominal, true, delivered = drawn(seed, robot, what)
            capture, specification = recorded(true, kind, seed), ArmSpecification(nominal, robot)
            checked = last = aj.verify(aj.Recording(capture, specification), delivered)
            errors = true_error(nominal, true), true_error(delivered, true)
            ratio = errors[1] / errors[0]
            if checked.verdict == "not decided" and capture.sockets:
                both = second_round(capture, checked, true, seed)
                last = aj.verify(aj.Recording(both, specification), delivered)
            is_clear = ratio < MARGIN or ratio > 1 / MARGIN
            clear += is_clear
            for (name, count), found in zip(counts.items(), (checked, last), strict=True):
                outcome = judged(found.verdict, ratio)
                count.update(
                    {outcome, found.verdict, *(["near"] if found.verdict == UNDECIDED and not is_clear else [])}
                )
                if outcome == "wrong" or (found is last and outcome == UNDECIDED):
                    limits = f"{found.ratio_lower:.2f} to {found.ratio_upper:.2f}"
                    print(f"  {outcome}, {name}: {kind}, seed {seed}, {robot}, {what}, {found.verdict}, ", end="")
                    print(f"ratio {ratio:.2f} ({limits}), share {found.share:.2f}, {found.poses} poses", flush=True)
            if seed < CHECKED:
                many = aj.Recording(recorded(true, kind, seed, MANY), specification)
                inside += checked.delivered.lower <= aj.verify(many, delivered).delivered.rms <= checked.delivered.upper
            gains.append((checked.volume / errors[1], checked.recalibrated))
            if checked.decided_by is not None:
                needed.append(checked.decided_by)
        for name, count in counts.items():
            print(
                f"{kind:20s} {name}: right {count['right']} ({count['equivalent']} equivalent), "
                f"wrong {count['wrong']}, "
                f"not decided {count[UNDECIDED]} ({count['near']} of them with a ratio within the margin)"
            )
        print(
            f"clear {clear}; RMS error inside its interval {inside}; "
            f"expected over true error of the volume {np.percentile([g[0] for g in gains], [5, 50, 95]).round(2)}; "
            f"recalibrated {np.median([g[1] for g in gains]):.3f} mm; "
            f"decided by {np.median(needed):.0f} poses"
        )


if __name__ == "__main__":
    main()
