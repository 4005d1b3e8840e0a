"""Coverage of the 95 % intervals of a robot's parameters: two arms on a torso, on a rail, and on bases of their own.

python benchmarks/robots.py [--trials 300] [--first 0] [--only torso]. Every tenth trial draws a true robot with errors
of up to 1 mm and 2 mrad, and four sockets with 24 poses each, in turn of both arms; each draws encoder noise of 10
arcsec (10 um of the rail), which is stated. The longest link is held at its true length. Tied parameters are those of
joints that both arms have.
"""

import argparse

import numpy as np

import aacmm_jax as aj
from aacmm_jax.kinematics.arm import value_of
from aacmm_jax.kinematics.robots import chains_of, mount_names

NOISE = aj.Noise(encoder_arcsec=10.0, linear_encoder=0.01)
SOCKETS = {"A": (500, 100, 500), "B": (100, -250, 700), "C": (200, 300, 600), "D": (350, -100, 450)}
BETWEEN = {"A": (250, 150, 300), "B": (250, -200, 350), "C": (200, 0, 450), "D": (300, 50, 200)}  # two bases
ARM = {"alpha": [1.57, 0.05, 1.57, -1.57, 0.0], "a": [30.0, -425.0, -92.0, 20.0, 0.0], "d": [89, 10, 109, 94.7, 82]}
TRUNK = {"alpha": [0.3, 0.0], "a": [40.0, 0.0], "d": [200.0, 60.0]}
COVERAGE_FACTOR = 1.96


def arm(side: int, slides: bool) -> aj.Arm:
    """A trunk of two joints, the first of which may be a rail, and an arm to the left (1) or right (-1) of it."""
    rows = {kind: [*TRUNK[kind], *ARM[kind]] for kind in ARM}
    rows["alpha"][1], rows["a"][1] = 0.5 * side, 100.0 * side
    limits = [[-300.0, 300.0] if slides else [-1.0, 1.0], *[[-2.5, 2.5]] * 6]
    return aj.Arm(**rows, probe=(20.0, 30.0, 100.0), limits=limits, prismatic=[1] * slides)


def robots() -> dict[str, aj.Arm]:
    """The robots by name."""
    names = {"left": ["first", "second", *"abcde"], "right": ["first", "second", *"ghijk"]}
    made = {}
    for name, slides in (("torso", False), ("rail", True)):
        both = {"left": arm(1, slides), "right": arm(-1, slides)}
        made[name] = aj.kinematics.together(both, joints=names)
    plain = aj.Arm(**ARM, probe=(20.0, 30.0, 100.0), limits=[[-2.5, 2.5]] * 5)
    made["two bases"] = aj.kinematics.together({"left": plain, "right": plain}, bases={"right": (500.0, 30.0, 20.0)})
    return made


def kinds_of(robot: aj.Arm, names: tuple[str, ...]) -> list[str]:
    """Whether each parameter is tied, of a base, or of one arm."""
    left, right = (set(joints) for _, joints in robot.chains)
    bases = {name for chain in chains_of(robot).values() for name in mount_names(chain)}
    tied = {f"{kind}_{joint}" for joint in left & right for kind in ("alpha", "a", "d", "theta", "beta")}
    return ["base" if name in bases else "tied" if name in tied else "untied" for name in names]


def covered(name: str, robot: aj.Arm, trials: range) -> dict[str, list[np.ndarray]]:
    """By kind of parameter, of every trial which of the true values the intervals contain."""
    sockets = BETWEEN if name == "two bases" else SOCKETS
    whole = aj.Parameters.independent(robot)
    lengths = [parameter for parameter in whole.names if parameter.startswith(("a_", "d_"))]
    longest = max(lengths, key=lambda parameter: abs(value_of(robot, parameter)))
    space = aj.Parameters(whole.base, tuple(parameter for parameter in whole.names if parameter != longest))
    bounds, exact, true = aj.Bounds.around(robot, space), None, robot
    kinds, inside = np.array(kinds_of(robot, space.names)), {}
    deviation = NOISE.of_columns(robot.geometry.kinds, robot.joints, robot.columns)
    for trial in trials:
        random = np.random.default_rng(trial)
        if exact is None or trial % 10 == 0:
            true = aj.perturbed_arm(space, length=1.0, angle=0.002, seed=trial)
            exact = aj.simulate(true, sockets, poses=24, seed=trial)
        noisy = {key: np.asarray(q) + deviation * random.normal(size=q.shape) for key, q in exact.sockets.items()}
        result = aj.identify(space.base, aj.Capture(noisy), bounds, hold=None, noise=NOISE)
        u = np.sqrt(np.diag(np.asarray(result.covariance)))
        within = np.abs(np.asarray(space.vector(result.arm)) - np.asarray(space.vector(true))) < COVERAGE_FACTOR * u
        for kind in dict.fromkeys(kinds):
            inside.setdefault(kind, []).append(within[kinds == kind])
    return inside


def main() -> None:
    """Print the coverage of each kind of parameter of each robot."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--first", type=int, default=0, help="seed of the first trial, a multiple of ten")
    parser.add_argument("--only", help="of this robot alone")
    options = parser.parse_args()
    trials = range(options.first, options.first + options.trials)
    for name in [options.only] if options.only else robots():
        for kind, rows in covered(name, robots()[name], trials).items():
            shares = np.mean(rows, axis=1)
            error = shares.std(ddof=1) / np.sqrt(len(shares))
            text = f"coverage {100 * shares.mean():.1f} +- {100 * error:.1f} %"
            print(f"{name:10s} {kind:7s} {len(rows[0]):3d} parameters: {text}", flush=True)


if __name__ == "__main__":
    main()
