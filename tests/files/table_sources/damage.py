"""Files with bytes turned, or cut, anywhere."""

import numpy as np

import aacmm_jax as aj
from aacmm_jax.files.text_table import TextTable


def refused_when_damaged(path, tables=(), *, trials=40, bits=1):
    """The sentences with which damaged copies of a file are refused; others are read as another table."""
    content, rng, sentences = path.read_bytes(), np.random.default_rng(1), []
    for trial in range(trials):
        damaged = bytearray(content[: rng.integers(1, len(content))] if trial % 4 == 0 else content)
        for _ in range(bits):
            damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        try:
            TextTable(path, tables=list(tables))
        except aj.InputError as error:
            sentences.append(str(error))
    return [sentence for sentence in sentences if "\n" not in sentence]
