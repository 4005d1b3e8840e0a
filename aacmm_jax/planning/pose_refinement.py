"""A design's poses moved by a gradient method, their tips kept in place."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..core.linear_algebra import inverse_positive_definite
from ..kinematics.arm import Arm
from ..kinematics.chain import forward_pass, jacobian_columns, sines_cosines
from ..kinematics.inverse_kinematics import damped_inverse, project_to_targets
from ..kinematics.parameters import Parameters
from ..kinematics.workspace import lowest_point
from ..model.measurement import Measurement
from ..uncertainty.identifiability import whitened_equations
from .placement import Place, Scene

_STEPS = 80
_ONTO = 4  # Newton's steps that bring a moved pose back into its socket, inside the derivative


class _Design(eqx.Module):
    """Everything the criterion needs but the poses; sockets in order."""

    arm: Arm
    space: Parameters
    targets: Float[Array, "N 3"]
    measurement: Measurement  # of the poses at the start
    functions: Float[Array, "v p"]


def refined(
    scene: Scene,
    place: Place,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    tell: Callable[[float], None] | None = None,
) -> Float[np.ndarray, "N n"]:
    """Poses with a criterion at least as good as that of ``q`` (socket after socket), within the limits, in their sockets to 1e-6 mm."""
    from scipy import optimize

    sizes = tuple(int(n) for n in np.bincount(owner, minlength=len(place.points)))
    lengths = [np.linalg.norm(place.points[b] - place.points[a]) for a, b in place.ends]
    measurement = Measurement(
        q=jnp.asarray(q),
        sines_cosines=sines_cosines(jnp.asarray(q)),
        nominal=jnp.asarray(np.array(lengths)),
        u=jnp.asarray(np.array(place.u)),
        sizes=sizes,
        ends=place.ends,
    )
    targets = place.points[owner]
    design = _Design(scene.arm, scene.space, jnp.asarray(targets), measurement, jnp.asarray(scene.goal.functions))

    @eqx.filter_jit
    @eqx.filter_value_and_grad
    def criterion(moved: Array, design: _Design) -> Array:
        at = _onto(design.arm, moved, design.targets)
        fresh = eqx.tree_at(lambda m: (m.q, m.sines_cosines), design.measurement, (at, sines_cosines(at)))
        rows = whitened_equations(design.arm, design.space, fresh.weighted(design.arm.geometry, scene.noise))
        information = rows.T @ rows + 1e-4 * jnp.eye(rows.shape[1])
        return scene.goal._replace(functions=design.functions).value(inverse_positive_definite(information))

    done = 0

    def told(_: np.ndarray) -> None:
        nonlocal done
        done += 1
        if tell:
            tell(min(done / _STEPS, 1.0))

    def both(flat: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = criterion(jnp.asarray(flat.reshape(q.shape)), design)
        return float(value), np.asarray(slope).ravel()

    bounds = np.tile(scene.limits, (len(q), 1))
    solution = optimize.minimize(
        both, q.ravel(), jac=True, method="L-BFGS-B", bounds=bounds, callback=told, options={"maxiter": _STEPS}
    )
    better, arrived = project_to_targets(scene.arm, solution.x.reshape(q.shape), targets, scene.limits)
    better = np.where((arrived & (lowest_point(scene.arm, better) >= scene.above))[:, None], better, q)
    return better if both(better.ravel())[0] <= both(q.ravel())[0] else q


def _onto(arm: Arm, q: Float[Array, "N n"], targets: Float[Array, "N 3"]) -> Float[Array, "N n"]:
    """Poses brought onto their targets by least steps, differentiably."""

    def step(rows: Array, _: None) -> tuple[Array, None]:
        forward = forward_pass(arm.geometry, sines_cosines(rows))
        gap = targets.T - forward.tip
        moves = damped_inverse(jacobian_columns(forward)["theta"], jnp.full(rows.shape[0], 1e-6))
        return rows + jnp.sum(moves * gap[None], axis=1).T, None

    return jax.lax.scan(step, q, None, length=_ONTO)[0]
