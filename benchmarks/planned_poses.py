"""The uncertainty of lengths against the number of poses: planned ones, and random ones in the same sockets.

`python benchmarks/planned_poses.py` (two minutes of CPU) writes results/planned_poses.json; docs/figures.py draws it.
The arm is the simulated one of Cheng et al. 2018, with 2 arcsec and 5 um of noise, in four sockets with two reference
lengths (u = 2 um) where a plan of 25 poses places them, 20 to 1000 mm above the table, with the tool at most 55 deg
from the vertical; lengths of 300 mm over the volume. Random poses are uniform in the joints and moved to the sockets;
the median of sets of them is given.
"""

import json
import math
from pathlib import Path

import numpy as np

import aacmm_jax as aj
from aacmm_jax.data.noise import small_arm_noise

HERE = Path(__file__).parent
POSES, SEEDS, CANDIDATES = (12, 17, 25, 40, 70), (0,), 800


def curves(sockets: int, seed: int) -> dict:
    """Largest and median standard uncertainty of 300 mm, um, for each number of poses in sockets placed once."""
    arm = aj.load_arm("cheng2018-simulation")
    options = {
        "noise": small_arm_noise(),
        "seed": seed,
        "check_length": 300.0,
        "candidates": CANDIDATES,
        "cone": aj.kinematics.Cone(math.radians(55)),
    }
    placed = aj.planning.plan(arm, sockets=sockets, poses=25, **options)
    lengths = [(length.start, length.end) for length in placed.lengths]
    rows = {"poses": list(POSES)}
    for poses in POSES:
        found = aj.planning.plan(arm, sockets=placed.sockets, lengths=lengths, poses=poses, **options)
        for name, prediction in (("planned", found.predicted), ("random", found.random)):
            for what in ("largest", "median"):
                rows.setdefault(f"{name}, {what}", []).append(round(1e3 * getattr(prediction, what), 2))
    return rows


def main() -> None:
    kinds = {"four sockets, two lengths": 4}
    found = {title: [curves(sockets, seed) for seed in SEEDS] for title, sockets in kinds.items()}
    (HERE / "results" / "planned_poses.json").write_text(json.dumps(found, indent=1) + "\n")
    for title, rows in found.items():
        for key in rows[0]:
            means = np.exp(np.mean([np.log(row[key]) for row in rows], axis=0))
            print(title, key, [round(float(value), 1) for value in means])


if __name__ == "__main__":
    main()
