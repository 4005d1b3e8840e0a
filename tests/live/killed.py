"""A live capture to be killed: prints each pose when its state has it. ``python killed.py FILE SEED``"""

import json
import sys
import time
from typing import TextIO

import numpy as np

import aacmm_jax as aj
from aacmm_jax.live import guidance
from aacmm_jax.live.devices.device import AbstractDevice
from tests.live.unguided import NoGuide


def setup():
    """A ball bar and a socket."""
    specification = aj.files.load_specification("cheng2018-simulation")
    ends, frame = {"1": (0, 0, 0), "2": (300, 0, 0)}, (0, 0, 0.7, 300, -200, 300)
    kit = [
        aj.data.observations.SimulatedArtefact("bar", ends, 5, frame, u=0.001),
        aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5),
    ]
    return aj.live.setup_of(specification, aj.files.load_noise("cheng2018-simulation"), kit)


class Hasty(AbstractDevice):
    """An arm that is at rest in a place after each motion, a pose at every read."""

    joints, connected = 6, True

    def __init__(self, seed: int):
        super().__init__("hasty")
        self.random, self.time = np.random.default_rng(seed), 0.0
        target = np.tile([400.0, 200.0, 300.0], (400, 1))
        arm = aj.load_arm("cheng2018-simulation")
        q, arrived = aj.kinematics.project_to_targets(arm, self.random.uniform(-1, 1, (400, 6)), target)
        self.poses = q[arrived]

    def read(self):
        goal = self.poses[self.random.integers(len(self.poses))]
        path = [goal + 0.3 * (1 - i / 30) for i in range(30)] + [goal] * 150
        samples = []
        for q in path:
            self.time += 0.01
            samples.append(aj.live.Sample(self.time, q + 1e-5 * self.random.normal(size=6)))
        return samples


def capture(path: str, seed: int, out: TextIO) -> None:
    """Capture until killed, without guidance; says "ready" and each pose."""
    guidance.Guide = NoGuide
    with aj.live.Session(setup(), [Hasty(seed)], path=path) as session:
        told = {pose["number"] for pose in session.state()["poses"]}
        print("ready", file=out, flush=True)
        while True:
            for pose in session.state()["poses"]:
                if pose["number"] not in told:
                    told.add(pose["number"])
                    print(json.dumps([pose["number"], pose["place"], pose["time"]]), file=out, flush=True)
            time.sleep(0.003)


if __name__ == "__main__":
    capture(sys.argv[1], int(sys.argv[2]), sys.stdout)
