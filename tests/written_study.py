"""The file of a study without its trials, for tests of what shows one: no program is compiled."""

from pathlib import Path

import numpy as np

import aacmm_jax as aj
from aacmm_jax.study.blocks import VARIABLES, computed_with
from aacmm_jax.study.store import Results, write_block


def write_study(path: Path, study: "aj.study.Study") -> None:
    """Write a finished study: results of the right kind, drawn at random about the nominal arm."""
    stored, random = Results(path, study, 1000, computed_with()), np.random.default_rng(0)
    stored.create()
    nominal, steps = np.asarray(study.space.vector()), np.asarray(study.space.scale)
    counts = {"converged": 1, "reason": 0, "steps": 12, "truth_inside": 1, "active": 0}
    for block in stored.blocks:
        shapes = {name: stored.empty(name, *block.shape).shape for name in VARIABLES}
        results = {
            name: np.full(shape, counts[name]) if name in counts else 0.01 * np.abs(random.normal(size=shape))
            for name, shape in shapes.items()
        }
        results["k"] = results["scale"] = 1 + 1e-5 * random.normal(size=shapes["k"])
        results["true"] = nominal + 0.1 * steps * random.normal(size=shapes["true"])
        results["estimate"] = results["true"] + 0.001 * steps * random.normal(size=shapes["true"])
        write_block(stored.file_of(block), results)
    stored.finish()
