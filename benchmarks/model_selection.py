"""Which model of its joints a simulated measuring arm is found to need, and what of it is recovered.

``python benchmarks/model_selection.py [--trials N] [--first SEED] [--fault NAME]`` simulates what a laboratory would
record in a day: 204 poses of the arm of Cheng et al. 2018 (encoders of 2 arcsec, a seat of 5 um) in six sockets, each
visited in four rounds, three reference lengths (u 1 um), and a room between 15 and 25 C. Each fault alone, and all
together: two eccentric encoders (10 arcsec), links that bend under their weight about joints 2 and 3 (10 arcsec), a
gear ratio 1 % off, an arm that expands by 11.5 um/(m K). Written: how often `compare_models` recommends the right
model, normalised errors of the coefficients and coverage of lengths with the right model, and how often plain
Denavit-Hartenberg is warned of; into ``results/model-selection-DATE.json``.
"""

import argparse
import datetime
import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import aacmm_jax as aj
from aacmm_jax.kinematics import with_corrections
from aacmm_jax.kinematics.inverse_kinematics import random_configurations

SOCKETS = {
    "A": (400, 200, 300),
    "B": (600, 200, 300),
    "C": (300, -400, 200),
    "D": (500, 300, 0),
    "E": (-300, 500, 300),
    "F": (200, -700, 400),
}
LENGTHS = [("A", "B"), ("C", "D"), ("E", "F")]
ROUNDS, POSES, U_LENGTH = 4, 34, 0.001
NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
ARCSEC = aj.units.ARCSEC
RIGHT = {
    "nothing": "dh",
    "eccentric": "harmonics=1",
    "bending": "gravity",
    "gear": "gear",
    "expansion": "expansion",
    "all": "expansion,gear,gravity,harmonics=1",
}
MODELS = (
    "dh",
    *("expansion", "gear", "gravity", "harmonics=1"),
    *("expansion,gear", "expansion,gravity", "gear,gravity"),
    *("expansion,harmonics=1", "gear,harmonics=1", "gravity,harmonics=1", "expansion,gear,gravity"),
    *("expansion,gear,harmonics=1", "expansion,gravity,harmonics=1", "gear,gravity,harmonics=1"),
    "expansion,gear,gravity,harmonics=1",
)


def true_arm(fault: str, random: np.random.Generator) -> aj.Arm:
    """An arm 0.5 mm and 0.05 deg off the nominal one, with what is wrong."""
    plain = aj.load_arm("cheng2018-simulation").replace(thermometer=True)
    arm = with_corrections(plain, RIGHT["all"])
    space = aj.Parameters.free_of(plain)
    shift = random.uniform(-1, 1, len(space.names)) * np.where(space.lengths, 0.5, np.deg2rad(0.05))
    changes = dict(zip(space.names, np.asarray(space.vector()) + shift, strict=True))
    if fault in ("eccentric", "all"):
        for joint in random.choice(4, 2, replace=False) + 1:
            phase = random.uniform(0, 2 * np.pi)
            changes |= {f"cos1_{joint}": 10 * ARCSEC * np.cos(phase), f"sin1_{joint}": 10 * ARCSEC * np.sin(phase)}
    if fault in ("bending", "all"):
        # The upper arm and the forearm: 10 arcsec for the longest lever, about 0.75 m and 0.6 m.
        changes |= {"compliance3_2": -10 * ARCSEC / 0.75 / 2, "compliance5_2": -10 * ARCSEC / 1.3 / 2}
        changes |= {"compliance5_3": -10 * ARCSEC / 0.6}
    if fault in ("gear", "all"):
        changes |= {f"gear_{random.integers(4) + 1}": 0.01}
    if fault in ("expansion", "all"):
        changes |= {"expansion": 11.5e-6}
    known = set(aj.kinematics.parameter_names(arm))
    return arm.replace(**{name: value for name, value in changes.items() if name in known})


def day(random: np.random.Generator) -> dict[str, np.ndarray]:
    """Temperatures of each socket's poses: the sockets are visited one after the other, in several rounds."""
    each = np.array_split(np.arange(POSES), ROUNDS)
    start, found = random.uniform(0, 1), {name: np.zeros(POSES) for name in SOCKETS}
    for round_number, poses in enumerate(each):
        for place, name in enumerate(SOCKETS):
            time_of_day = (round_number + (place + np.linspace(0, 1, len(poses))) / len(SOCKETS)) / ROUNDS
            found[name][poses] = 20 + 5 * np.sin(2 * np.pi * (time_of_day + start))
    return found


def record(arm: aj.Arm, seed: int) -> aj.Capture:
    """A day's capture, with noise."""
    import jax

    random = np.random.default_rng([seed, 1])
    q, points = {}, {name: np.array(point, dtype=float) for name, point in SOCKETS.items()}
    limits = np.tile([-np.pi, np.pi], (arm.joints, 1)) if arm.limits is None else np.asarray(arm.limits)
    growth = float(np.asarray(arm.replace().coefficients)[-1]) if False else _growth(arm)
    temperatures = day(random)
    for number, (name, point) in enumerate(points.items()):
        target = point + random.normal(0, float(NOISE.seating), (POSES, 3))
        scale = 1 + growth * (temperatures[name] - 20)
        key = jax.random.fold_in(jax.random.key(seed), number)
        angles = np.asarray(random_configurations(arm, target / scale[:, None], key, limits))
        angles = angles + 2 * ARCSEC * random.normal(size=angles.shape)
        q[name] = np.column_stack([angles, temperatures[name]])
    lengths = []
    for one, other in LENGTHS:
        value = np.linalg.norm(points[one] - points[other]) + random.normal(0, U_LENGTH)
        lengths.append(aj.ReferenceLength(one, other, value, U_LENGTH))
    return aj.Capture(q, lengths)


def _growth(arm: aj.Arm) -> float:
    names = aj.kinematics.parameter_names(arm)
    assert arm.coefficients is not None
    first = names.index("probe_z") + 1
    return float(np.asarray(arm.coefficients)[names.index("expansion") - first])
