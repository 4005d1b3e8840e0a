"""``aacmm`` with blocks that are not computed but read, or that never end: what is tested is how a study is kept.

WHOLE is the file of the same study, run before; SECONDS what a block takes; STARTED a file that the first block makes.
"""

import os
import time
from pathlib import Path

import h5py
import numpy as np

from aacmm_jax.study import runner
from aacmm_jax.study.blocks import VARIABLES


def prepared(study, block, **_) -> dict[str, np.ndarray]:
    Path(os.environ["STARTED"]).touch()
    time.sleep(float(os.environ["SECONDS"]))
    with h5py.File(os.environ["WHOLE"]) as whole:
        return {name: whole["trials"][name][block.slices] for name in VARIABLES}


if __name__ in ("__main__", "__mp_main__"):  # the command's process, and those that it starts
    runner.run_block = prepared
    runner.check_reach = lambda study: None

if __name__ == "__main__":
    from aacmm_jax.cli import main

    main()
