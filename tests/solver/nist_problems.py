"""All NIST StRD nonlinear regression problems (folder nist/): parser of the files, and models written from the formulas
in them."""

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

FOLDER = Path(__file__).resolve().parent / "nist"


def _gauss(b, x):
    first = b[2] * jnp.exp(-((x - b[3]) ** 2) / b[4] ** 2)
    return b[0] * jnp.exp(-b[1] * x) + first + b[5] * jnp.exp(-((x - b[6]) ** 2) / b[7] ** 2)


def _lanczos(b, x):
    return b[0] * jnp.exp(-b[1] * x) + b[2] * jnp.exp(-b[3] * x) + b[4] * jnp.exp(-b[5] * x)


def _chwirut(b, x):
    return jnp.exp(-b[0] * x) / (b[1] + b[2] * x)


def _enso(b, x):
    year = b[1] * jnp.cos(2 * jnp.pi * x / 12) + b[2] * jnp.sin(2 * jnp.pi * x / 12)
    second = b[4] * jnp.cos(2 * jnp.pi * x / b[3]) + b[5] * jnp.sin(2 * jnp.pi * x / b[3])
    return b[0] + year + second + b[7] * jnp.cos(2 * jnp.pi * x / b[6]) + b[8] * jnp.sin(2 * jnp.pi * x / b[6])


def _saturation(b, x):
    return b[0] * (1 - jnp.exp(-b[1] * x))


def _cubic_ratio(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


MODELS = {
    "Misra1a": _saturation,
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Lanczos3": _lanczos,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Hahn1": _cubic_ratio,
    "Nelson": lambda b, x: b[0] - b[1] * x[:, 0] * jnp.exp(-b[2] * x[:, 1]),
    "MGH17": lambda b, x: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "ENSO": _enso,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": _cubic_ratio,
    "BoxBOD": _saturation,
    "Rat42": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "MGH10": lambda b, x: b[0] * jnp.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x: b[0] / (1 + jnp.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
}


class Dataset(NamedTuple):
    name: str
    starts: np.ndarray  # (2, p)
    certified: np.ndarray  # (p,)
    standard_error: np.ndarray  # (p,)
    certified_sum_of_squares: float
    x: np.ndarray
    y: np.ndarray

    def residual(self, b, _=None):
        return MODELS[self.name](b, jnp.asarray(self.x)) - jnp.asarray(self.y)


def load(name: str) -> Dataset:
    lines = (FOLDER / f"{name}.dat").read_text().splitlines()
    rows = [re.split(r"\s+", line.split("=")[1].strip()) for line in lines if re.match(r"\s*b\d+\s*=\s*[-\d.]", line)]
    values = np.array([[float(v) for v in row[:4]] for row in rows])
    squares = next(float(line.split(":")[1]) for line in lines if line.startswith("Residual Sum of Squares"))
    first, last = map(int, re.search(r"Data\s+\(lines\s+(\d+)\s+to\s+(\d+)\)", "\n".join(lines[:10])).groups())
    data = np.array([[float(v) for v in line.split()] for line in lines[first - 1 : last]])
    y, x = data[:, 0], data[:, 1:].squeeze()
    return Dataset(name, values[:, :2].T, values[:, 2], values[:, 3], squares, x, np.log(y) if name == "Nelson" else y)


def certified_digits(estimate: np.ndarray, certified: np.ndarray) -> float:
    """LRE: the smallest number of agreeing digits over the parameters, 11 at most (what is certified)."""
    with np.errstate(divide="ignore"):
        return float(np.min(np.minimum(-np.log10(np.abs(estimate - certified) / np.abs(certified)), 11)))


@functools.cache
def residual_and_jacobian(name: str) -> Callable:
    """Compiled, for all who need it."""
    data = load(name)
    return jax.jit(lambda b: (data.residual(b), jax.jacfwd(data.residual)(b)))


def standard_errors(data: Dataset, estimate) -> np.ndarray:
    """Of every parameter, from the Jacobian at the estimate and the residual variance."""
    residual, jacobian = map(np.asarray, residual_and_jacobian(data.name)(estimate))
    variance = np.sum(residual**2) / (len(data.y) - len(estimate))
    triangle = np.linalg.qr(jacobian)[1]
    return np.sqrt(variance * np.sum(np.linalg.inv(triangle) ** 2, axis=1))
