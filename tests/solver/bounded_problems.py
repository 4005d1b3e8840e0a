"""Random bounded least-squares problems with a unique minimum: mixed scales, curved residuals, bounds active or not."""

import jax.numpy as jnp
import numpy as np

SIZES = ((3, 9), (6, 20), (12, 40))  # unknowns, residuals: few shapes, so that few solves are compiled


def draw(seed: int) -> dict[str, np.ndarray]:
    """Arrays of one problem: residual = A u + c sin(A u) - b with u = (y - centre) / unit, and a box.

    |c| < 1 makes u -> A u + c sin(A u) strictly monotone along every row. Units span eight decades, columns of A are
    correlated, and the box is drawn so that from none to most of the bounds are active.
    """
    random = np.random.default_rng(seed)
    p, m = SIZES[seed % len(SIZES)]
    shared = random.normal(size=(m, 1))
    matrix = random.normal(size=(m, p)) + random.uniform(0, 3) * shared
    curvature = random.choice([0.0, 0.3])
    unit = 10.0 ** random.uniform(-4, 4, size=p)
    centre = unit * random.normal(size=p)
    inside = random.normal(size=p)
    target = matrix @ inside
    target = target + curvature * np.sin(target) + random.choice([0.0, 0.01, 0.5]) * random.normal(size=m)
    width = random.choice([0.2, 1.0, 5.0])
    middle = inside * random.choice([0.0, 1.0])
    lower = centre + unit * (middle - width * random.uniform(0.1, 1, size=p))
    upper = centre + unit * (middle + width * random.uniform(0.1, 1, size=p))
    start = lower + random.uniform(0.05, 0.95, size=p) * (upper - lower)
    return dict(
        matrix=matrix,
        curvature=np.asarray(curvature),
        unit=unit,
        centre=centre,
        target=target,
        lower=lower,
        upper=upper,
        start=start,
    )


def residual(y, problem):
    """Residual for either NumPy or JAX arrays; ``problem`` is what `draw` returned."""
    numerics = np if isinstance(y, np.ndarray) else jnp
    image = problem["matrix"] @ ((y - problem["centre"]) / problem["unit"])
    return image + problem["curvature"] * numerics.sin(image) - problem["target"]


def jacobian(y: np.ndarray, problem) -> np.ndarray:
    """Analytic derivative, so that SciPy is not handicapped by finite differences."""
    image = problem["matrix"] @ ((y - problem["centre"]) / problem["unit"])
    return (1 + problem["curvature"] * np.cos(image))[:, None] * problem["matrix"] / problem["unit"]
