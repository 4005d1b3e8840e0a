"""The poses of a design improved by a gradient method, their tips kept in their sockets."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.linear_algebra import inverse_positive_definite
from ..kinematics.arm import Arm
from ..kinematics.chain import sines_cosines
from ..kinematics.inverse_kinematics import newton_projection, project_to_targets
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import lowest_point
from ..model.measurement import Measurement
from ..uncertainty.identifiability import whitened_equations
from .placement import DesignProblem, FixturePlacement

_ITERATIONS = 80
_NEWTON_STEPS = 4  # that bring a moved pose back into its socket, inside the derivative


class _Design(eqx.Module):
    """What the criterion depends on, except the poses; sockets in order."""

    arm: Arm
    space: Parameters
    targets: Float[Array, "N 3"]
    measurement: Measurement  # of the poses at the start
    functions: Float[Array, "v p"]


def refined(
    problem: DesignProblem,
    placement: FixturePlacement,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    progress: Callable[[float], None],
) -> Float[np.ndarray, "N n"]:
    """Configurations within the limits, in their sockets to 1e-6 mm, with an objective no worse than that of ``q``.

    ``q`` is in the order of the sockets; ``progress`` is called with the fraction done.
    """
    from scipy import optimize

    sizes = tuple(int(n) for n in np.bincount(owner, minlength=len(placement.points)))
    lengths = [np.linalg.norm(placement.points[b] - placement.points[a]) for a, b in placement.ends]
    measurement = Measurement(
        q=jnp.asarray(q),
        sines_cosines=sines_cosines(jnp.asarray(q)),
        nominal=jnp.asarray(np.array(lengths)),
        u=jnp.asarray(np.array(placement.u)),
        sizes=sizes,
        ends=placement.ends,
    )
    targets = placement.points[owner]
    functions = jnp.asarray(problem.objective.functions)
    design = _Design(problem.arm, problem.space, jnp.asarray(targets), measurement, functions)

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def objective(moved: Array, design: _Design) -> Array:
        at = newton_projection(design.arm.geometry, moved, design.targets, _NEWTON_STEPS)
        fresh = eqx.tree_at(lambda m: (m.q, m.sines_cosines), design.measurement, (at, sines_cosines(at)))
        rows = whitened_equations(design.arm, design.space, fresh.weighted(design.arm.geometry, problem.noise))
        information = rows.T @ rows + 1e-4 * jnp.eye(rows.shape[1])
        return problem.objective._replace(functions=design.functions).value(inverse_positive_definite(information))

    done = 0

    def iterated(_: np.ndarray) -> None:
        nonlocal done
        done += 1
        progress(min(done / _ITERATIONS, 1.0))

    def value_and_gradient(flat: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = objective(jnp.asarray(flat.reshape(q.shape)), design)
        return float(value), np.asarray(gradient).ravel()

    region = problem.region
    solution = optimize.minimize(
        value_and_gradient, q.ravel(), jac=True, method="L-BFGS-B", bounds=np.tile(region.limits, (len(q), 1)),
        callback=iterated, options={"maxiter": _ITERATIONS},
    )  # fmt: skip
    better, arrived = project_to_targets(problem.arm, solution.x.reshape(q.shape), targets, region.limits)
    better = np.where((arrived & (lowest_point(problem.arm, better) >= region.above))[:, None], better, q)
    return better if value_and_gradient(better.ravel())[0] <= value_and_gradient(q.ravel())[0] else q
