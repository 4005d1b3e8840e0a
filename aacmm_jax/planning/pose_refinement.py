"""The poses of a design improved by a gradient method, their tips kept in their sockets."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.numpy_or_jax import to_numpy
from ..kinematics.arm import Arm, by_joint, locate
from ..kinematics.chain import ForwardPass, forward_pass, joint_errors, joint_motion, reading_units
from ..kinematics.jacobian import moved_by_correction, reading_columns, readings_gradient
from ..kinematics.workspace import reached
from .fedorov_exchange import covariance_of
from .information import DesignProblem, candidates_of, pool_of
from .options import FixturePlacement

_ITERATIONS = 80
_NEWTON_STEPS, _ARRIVED = 8, 1e-9  # mm
_FRACTIONS = (1.0, 0.5, 0.25)  # of the way to the best poses, where some of these cannot be taken


def refined(
    problem: DesignProblem,
    placement: FixturePlacement,
    q: Float[np.ndarray, "N n"],
    owner: Int[np.ndarray, " N"],
    progress: Callable[[float], None],
    allowed: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> Float[np.ndarray, "N n"]:
    """Configurations within the limits, in their sockets to 1e-6 mm, with an objective no worse than that of ``q``.

    The optimiser (L-BFGS-B) moves the readings freely; each pose is then brought back into its socket by a combination
    of the directions that are normal to the socket's configurations at ``q``, so the derivative is exact.
    ``progress`` is called with the fraction done; ``allowed(q, owner)`` says which poses may be taken, besides what
    `reached` checks.
    """
    from scipy import optimize

    region, targets = problem.region, placement.points[owner]
    units = reading_units(problem.arm.geometry)  # the optimiser's variables are alike in size
    sockets = TangentProjection.at(problem, q, targets)
    done = 0

    def iterated(_: np.ndarray) -> None:
        nonlocal done
        done += 1
        progress(min(done / _ITERATIONS, 1.0))

    def of_readings(flat: np.ndarray) -> tuple[float, np.ndarray]:
        at = sockets.projected(flat.reshape(q.shape) * units)
        value, gradient = value_and_gradient(problem, placement, at, owner)
        return value, (sockets.pulled_back(at, gradient) * units).ravel()

    solution = optimize.minimize(
        of_readings, (q / units).ravel(), jac=True, method="L-BFGS-B",
        bounds=np.tile(region.limits / units[:, None], (len(q), 1)),
        callback=iterated, options={"maxiter": _ITERATIONS},
    )  # fmt: skip
    change = sockets.projected(solution.x.reshape(q.shape) * units) - q
    best, best_value = q, _value(problem, placement, q, owner)
    for fraction in _FRACTIONS:
        moved, possible = reached(region, q + fraction * change, targets, sockets=owner)
        if allowed is not None:
            possible &= allowed(moved, owner)
        moved = np.where(possible[:, None], moved, q)
        value = _value(problem, placement, moved, owner)
        if value < best_value:
            best, best_value = moved, value
    return best


class TangentProjection(NamedTuple):
    """Projection to the configurations whose tips are in their sockets, along the normals of these at a start."""

    problem: DesignProblem
    targets: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3 n"]  # dtip/dq at the start, normal where readings are counted in their units

    @classmethod
    def at(
        cls, problem: DesignProblem, q: Float[np.ndarray, "N n"], targets: Float[np.ndarray, "N 3"]
    ) -> "TangentProjection":
        """The projection for the neighbourhood of q."""
        units = reading_units(problem.arm.geometry)
        return cls(problem, targets, _tip_columns(problem.arm, q, _forward(problem, q)) * units**2)

    def projected(self, q: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        """q + normals^T x, with x of each pose such that its tip is in its socket: by Newton's method."""
        for _ in range(_NEWTON_STEPS):
            forward = _forward(self.problem, q)
            gap = self.targets - forward.tip.T
            if np.abs(gap).max() < _ARRIVED:
                break
            multipliers = np.linalg.solve(self._mixed(q, forward), gap[:, :, None])
            q = q + np.einsum("nc,ncj->nj", multipliers[:, :, 0], self.normals)
        return q

    def pulled_back(self, q: Float[np.ndarray, "N n"], gradient: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n"]:
        """The derivative by what was projected, from that by the projection ``q``."""
        forward = _forward(self.problem, q)
        normal_part = np.einsum("ncj,nj->nc", self.normals, gradient)
        multipliers = np.linalg.solve(np.swapaxes(self._mixed(q, forward), 1, 2), normal_part[:, :, None])
        return gradient - np.einsum("nc,ncj->nj", multipliers[:, :, 0], _tip_columns(self.problem.arm, q, forward))

    def _mixed(self, q: Float[np.ndarray, "N n"], forward: ForwardPass) -> Float[np.ndarray, "N 3 3"]:
        return _tip_columns(self.problem.arm, q, forward) @ np.swapaxes(self.normals, 1, 2)


def _forward(problem: DesignProblem, q: Float[np.ndarray, "N n"]) -> ForwardPass:
    geometry = to_numpy(problem.arm.geometry)
    return forward_pass(geometry, joint_motion(geometry, q))


def _tip_columns(arm: Arm, q: Float[np.ndarray, "N n"], forward: ForwardPass) -> Float[np.ndarray, "N 3 n"]:
    """Derivative of the tips by the readings, that of joint corrections by them included."""
    columns = np.asarray(reading_columns(forward)).transpose(2, 1, 0)
    slopes = _slopes_of_errors(arm, q)
    return columns if slopes is None else columns + columns @ slopes


def _slopes_of_errors(arm: Arm, q: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N n n"] | None:
    """How the errors of the joints (rows) change with the readings; None where coefficients are 0."""
    if arm.corrections is None or not np.any(np.asarray(arm.coefficients)):
        return None
    geometry = to_numpy(arm.geometry)

    def errors(readings: np.ndarray) -> np.ndarray:
        return np.asarray(joint_errors(geometry, joint_motion(geometry, readings))[0])[:, 0].T

    return np.moveaxis(_by_readings(arm, q, errors), 0, 2)


def _by_readings(arm: Arm, q: Float[np.ndarray, "N n"], function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Derivative of a smooth function of the readings, ``(n, ...)``, by central differences."""
    slopes = []
    for joint, unit in enumerate(reading_units(arm.geometry)):
        step = np.zeros(arm.joints)
        step[joint] = 1e-5 * unit
        slopes.append((function(q + step) - function(q - step)) / (2 * step[joint]))
    return np.stack(slopes)


def _value(problem: DesignProblem, placement: FixturePlacement, q: np.ndarray, owner: np.ndarray) -> float:
    candidates = candidates_of(problem, placement, pool_of(problem, q, owner))
    return problem.objective.value(covariance_of(candidates.information(candidates.rows), candidates.parameters))


def value_and_gradient(
    problem: DesignProblem, placement: FixturePlacement, q: Float[np.ndarray, "N n"], owner: Int[np.ndarray, " N"]
) -> tuple[float, Float[np.ndarray, "N n"]]:
    """The objective of poses in their sockets, and its derivative by the readings.

    With the information sum A_j^T W_j A_j of rows A_j = [J_j, -1] and weights W_j = (K_j S K_j^T + s^2)^-1, where J_j
    and K_j are derivatives of tip j by parameters and readings, and H = dvalue/d(covariance) between the covariances of
    all unknowns: dvalue = -2 <W_j A_j H, dA_j> + 2 <W_j A_j H A_j^T W_j K_j S, dK_j>, summed over the poses j.
    """
    pool = pool_of(problem, q, owner)
    candidates = candidates_of(problem, placement, pool)
    rows, p = candidates.rows, candidates.parameters
    covariance = np.linalg.inv(candidates.information(rows))
    of_parameters = covariance[:p, :p]
    weighted = covariance[:, :p] @ problem.objective.gradient(of_parameters) @ covariance[:p]
    roots_transposed = np.swapaxes(pool.roots, 1, 2)
    by_rows = roots_transposed @ (rows @ weighted)  # W_j A_j H
    by_covariance = by_rows @ np.swapaxes(rows, 1, 2) @ pool.roots
    forward = _forward(problem, q)
    readings = np.asarray(reading_columns(forward))
    encoder = np.broadcast_to(np.asarray(problem.noise.of_readings(forward.kinds)), readings.shape[:1])
    of_readings = 2 * np.einsum("ncd,kdn->kcn", by_covariance, readings) * encoder[:, None, None] ** 2
    slides = np.array(by_joint(problem.arm, False, True))[:, None, None]
    by_functions = np.zeros((0 if forward.errors is None else len(forward.errors.functions.term_of_row), len(q)))
    cotangents = {"theta": np.where(slides, 0.0, of_readings), "d": np.where(slides, of_readings, 0.0)}
    for index, (name, scale) in enumerate(zip(problem.space.names, np.asarray(problem.space.scale), strict=True)):
        kind, i = locate(problem.arm, name)
        cotangent = -2 * scale * by_rows[:, :, index].T
        if kind in ("coefficients", "gravity"):
            for joint, by in moved_by_correction(forward, kind, i):
                cotangents["d" if slides[joint] else "theta"][joint] += by * cotangent
            by_functions += _by_functions(problem, forward, kind, i, cotangent)
            continue
        cotangents.setdefault(kind, np.zeros((3 if kind == "probe" else len(readings), *readings.shape[1:])))
        cotangents[kind][i] += cotangent
    gradient = np.asarray(readings_gradient(forward, cotangents)).T
    slopes = _slopes_of_errors(problem.arm, q)
    if slopes is not None:  # the joints move by their readings and by what corrections change with these
        gradient = gradient + np.einsum("njk,nj->nk", slopes, gradient)
    if np.any(by_functions):
        gradient = gradient + _gradient_of_functions(problem.arm, q, by_functions)
    return problem.objective.value(of_parameters), gradient


def _by_functions(
    problem: DesignProblem, forward: ForwardPass, kind: str, i: int, cotangent: Float[np.ndarray, "3 N"]
) -> Float[np.ndarray, "rows N"]:
    """Derivative by the known functions of joint corrections of the product of a column with ``cotangent``."""
    assert forward.errors is not None
    functions, columns = forward.errors.functions, np.asarray(reading_columns(forward))
    of_joints = np.einsum("ncN,cN->nN", columns, cotangent)
    derivatives = np.zeros((len(functions.term_of_row), cotangent.shape[1]))
    coefficients, gravity = np.asarray(problem.arm.coefficients), [*np.asarray(problem.arm.gravity), 1.0]
    for row, (term, component) in enumerate(zip(functions.term_of_row, functions.component_of_row, strict=True)):
        joint = functions.terms[term].joint - 1
        if kind == "coefficients" and term == i:
            derivatives[row] = gravity[component] * of_joints[joint]
        if kind == "gravity" and component == i:
            derivatives[row] = coefficients[term] * of_joints[joint]
    return derivatives


def _gradient_of_functions(
    arm: Arm, q: Float[np.ndarray, "N n"], by_functions: Float[np.ndarray, "rows N"]
) -> Float[np.ndarray, "N n"]:
    """Derivative by the readings through the known functions, by central differences: they are smooth and cheap."""
    geometry = to_numpy(arm.geometry)

    def weighted(readings: np.ndarray) -> np.ndarray:
        return np.sum(by_functions * np.asarray(joint_motion(geometry, readings).functions)[:, 0], axis=0)

    return _by_readings(arm, q, weighted).T
