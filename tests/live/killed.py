"""A live capture to be killed: prints each pose when its state has it. ``python killed.py FILE SEED``"""

import json
import sys
import time

import aacmm_jax as aj


def setup():
    """A ball bar and a socket."""
    specification = aj.files.load_specification("cheng2018-simulation")
    ends, frame = {"1": (0, 0, 0), "2": (300, 0, 0)}, (0, 0, 0.7, 300, -200, 300)
    kit = [
        aj.data.observations.SimulatedArtefact("bar", ends, 5, frame, u=0.001),
        aj.data.observations.SimulatedSocket("A", (400, 200, 300), 5),
    ]
    return aj.live.setup_of(specification, aj.files.load_noise("cheng2018-simulation"), kit)


if __name__ == "__main__":
    device = f"simulated:?seed={sys.argv[2]}&speed=40&hold=0.6"
    with aj.live.Session(setup(), [device], path=sys.argv[1]) as session:
        told = {pose["number"] for pose in session.state()["poses"]}
        print("ready", flush=True)
        while True:
            for pose in session.state()["poses"]:
                if pose["number"] not in told:
                    told.add(pose["number"])
                    print(json.dumps([pose["number"], pose["place"], pose["time"]]), flush=True)
            time.sleep(0.003)
