"""The bounded solver: against SciPy on random boxes, on NIST's certified problems, and its derivatives."""

import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

import aacmm_jax as aj
from aacmm_jax.solver.active_set import Box, QuadraticModel
from aacmm_jax.solver.levenberg_marquardt import Rules, minimise
from aacmm_jax.solver.reason import numbers_of, reasons
from tests.refusals import assert_refused
from tests.solver import bounded_problems, nist_problems


@jax.jit
def solve(problem):
    solution = aj.least_squares(
        bounded_problems.residual,
        problem["start"],
        problem,
        lower=problem["lower"],
        upper=problem["upper"],
        throw=False,
    )
    stats = solution.stats
    cost = 0.5 * jnp.sum(bounded_problems.residual(solution.value, problem) ** 2)
    return solution.value, cost, stats["optimality"], aj.calibration.converged(stats["reason"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("third", "count"),
    [
        (0, 25),
        *(pytest.param(third, 25, marks=pytest.mark.slow) for third in (1, 2)),
        *(pytest.param(third, 70, marks=pytest.mark.exhaustive) for third in range(3)),
    ],
)
def test_never_worse_than_scipy_in_random_boxes(third, count):
    """Cost against SciPy's TRF at its tightest tolerances; the drawn boxes must hold both active and inactive
    bounds."""
    active = 0
    for seed in range(third, 3 * count, 3):
        problem = bounded_problems.draw(seed)
        value, cost, _, converged = solve({key: jnp.asarray(item) for key, item in problem.items()})
        reference = scipy.optimize.least_squares(
            bounded_problems.residual,
            problem["start"],
            jac=bounded_problems.jacobian,
            bounds=(problem["lower"], problem["upper"]),
            args=(problem,),
            x_scale="jac",
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
            max_nfev=5000,
        )
        assert converged, seed
        # Where the model can fit exactly both costs are rounding errors, so they are compared with the start's as well.
        start = 0.5 * np.sum(bounded_problems.residual(problem["start"], problem) ** 2)
        assert cost <= reference.cost * (1 + 1e-9) + 1e-24 * start, seed
        assert np.all(value >= problem["lower"]), seed
        assert np.all(value <= problem["upper"]), seed
        active += int(np.sum((value == problem["lower"]) | (value == problem["upper"])))
    assert active > 20


def test_residual_is_never_evaluated_outside_the_box():
    """Every point that the residual sees is recorded by the running program itself."""
    seen: list[np.ndarray] = []

    def recorded(y, problem):
        jax.debug.callback(lambda point: seen.append(np.array(point)), y)
        return bounded_problems.residual(y, problem)

    @jax.jit
    def run(problem):
        return aj.least_squares(
            recorded, problem["start"], problem, lower=problem["lower"], upper=problem["upper"], throw=False
        ).value

    evaluated = 0
    for seed in range(0, 60, 3):
        seen.clear()
        problem = bounded_problems.draw(seed)
        # A start outside is clipped before anything is evaluated.
        problem["start"] = problem["upper"] + 1.0
        run({key: jnp.asarray(item) for key, item in problem.items()}).block_until_ready()
        jax.effects_barrier()
        points = np.stack(seen)
        evaluated += len(points)
        assert np.all(points >= problem["lower"])
        assert np.all(points <= problem["upper"])
    assert evaluated > 60


def _by_optimistix(data):
    """`least_squares`, compiled."""

    @jax.jit
    def fit(start):
        solution = aj.least_squares(data.residual, start, throw=False)
        return solution.value, solution.stats["cost"], solution.stats["reason"]

    return lambda start: fit(jnp.asarray(start))


def _by_steps(data):
    """The same steps in NumPy, of which only residual and Jacobian are compiled."""
    evaluate = nist_problems.residual_and_jacobian(data.name)

    def model(y, _):
        residual, jacobian = map(np.asarray, evaluate(y))
        return QuadraticModel(0.5 * residual @ residual, jacobian.T @ residual, jacobian.T @ jacobian)

    def fit(start):
        start = np.asarray(start, dtype=float)
        free = np.full(start.shape, np.inf)
        with np.errstate(all="ignore"):
            last = minimise(model, start, None, Box(-free, free, None), Rules(), 1000)
        return last.y, last.model.cost, reasons(last.reason)

    return fit


# Compiling all of them takes minutes; BoxBOD and MGH10 are the hardest (see `levenberg_marquardt`).
_COMPILED = ("BoxBOD", "MGH10")


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("solver", "name"),
    [
        pytest.param(_by_steps, name, marks=pytest.mark.slow if name in ("Bennett5", "MGH17") else ())
        for name in nist_problems.MODELS
    ]
    + [
        pytest.param(_by_optimistix, name, marks=pytest.mark.slow if name in _COMPILED else pytest.mark.exhaustive)
        for name in nist_problems.MODELS
    ],
)
def test_nist_certified_digits(solver, name):
    """At least 6 certified digits of every parameter and 3 of its standard error, from both starts (NIST StRD)."""
    data = nist_problems.load(name)
    fit = solver(data)
    for start in data.starts:
        value, cost, reason = fit(start)
        assert aj.calibration.converged(reason)
        assert nist_problems.certified_digits(np.asarray(value), data.certified) >= 6
        assert 2 * cost <= data.certified_sum_of_squares * (1 + 1e-9) + 1e-20
        errors = nist_problems.standard_errors(data, jnp.asarray(value))
        assert name == "Lanczos1" or nist_problems.certified_digits(errors, data.standard_error) >= 3


def rosenbrock(y, args):
    steepness = 10.0 if args is None else args
    return {"valley": steepness * (y["b"] - y["a"] ** 2), "slope": 1 - y["a"]}


def test_pytrees_and_partial_bounds():
    start = {"a": jnp.array([-1.2]), "b": jnp.array([1.0])}
    free = aj.least_squares(rosenbrock, start)
    np.testing.assert_allclose([free.value["a"][0], free.value["b"][0]], [1, 1], rtol=1e-10)
    boxed = aj.least_squares(rosenbrock, start, upper={"a": 0.5, "b": jnp.inf})
    np.testing.assert_allclose([boxed.value["a"][0], boxed.value["b"][0]], [0.5, 0.25], rtol=1e-10)
    assert boxed.stats["reason"] == aj.Reason.gradient


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("mode", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev])
def test_derivative_follows_an_active_bound(mode):
    """With a on its bound u, the minimum is (u, u^2): d/du = (1, 2u) exactly, and nothing depends on the steepness."""

    def optimum(upper, steepness):
        start = {"a": jnp.array(-1.2), "b": jnp.array(1.0)}
        value = aj.least_squares(rosenbrock, start, steepness, upper={"a": upper, "b": jnp.inf}).value
        return jnp.stack([value["a"], value["b"]])

    by_bound, by_steepness = mode(optimum, (0, 1))(jnp.array(0.5), jnp.array(10.0))
    np.testing.assert_allclose(by_bound, [1, 1], atol=1e-10)
    np.testing.assert_allclose(by_steepness, [0, 0], atol=1e-10)
    # A bound that does not bind has no influence.
    np.testing.assert_allclose(mode(optimum)(jnp.array(5.0), jnp.array(10.0)), [0, 0], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "unit",
    [
        pytest.param(1e8, marks=pytest.mark.slow),
        *(pytest.param(unit, marks=pytest.mark.exhaustive) for unit in (1.0, 1e-8)),
    ],
)
def test_derivative_does_not_depend_on_units(unit):
    """The same problem with one unknown in another unit: y_1 = u on its bound, y_0 = unit / (1 + u) at the minimum."""

    def optimum(upper):
        residual = lambda y, _: jnp.stack([y[0] / unit * (1 + y[1]) - 1, 0.1 * (y[1] - 3)])  # noqa: E731
        return aj.least_squares(residual, jnp.array([0.5 * unit, 0.1]), upper=jnp.stack([jnp.inf, upper])).value

    value, slope = optimum(jnp.array(1.0)), jax.jacrev(optimum)(jnp.array(1.0))
    np.testing.assert_allclose(value / jnp.array([unit, 1.0]), [0.5, 1.0], rtol=1e-8)
    np.testing.assert_allclose(slope / jnp.array([unit, 1.0]), [-0.25, 1.0], rtol=1e-6)


# Which of two equal gradients is the smaller one is decided by rounding: some of so many starts end with a step that is
# accepted, others with a refused one.
@given(st_numpy.arrays(float, st.integers(1, 4), elements=st.floats(2.0, 1e6)))
def test_a_false_derivative_is_not_called_converged(start):
    wrong = lambda y, _: QuadraticModel(0.5 * (y - 1) @ (y - 1), 1 - y, np.eye(len(y)))  # noqa: E731
    free = np.full(len(start), np.inf)
    ended = minimise(wrong, start, None, Box(-free, free, None), Rules(), 1000)
    assert ended.reason == numbers_of(aj.Reason.stalled)


_STARTS = np.concatenate(
    [[(3.0, 4.0), (2.0, 5.0), (30.0, 4.0), (0.5, 7.0)], np.random.default_rng(0).uniform(-50, 50, (200, 2))]
)
# A residual, its derivative as a multiple of the right one, and how the solves may end.
FALSE_DERIVATIVES = {
    "wrong sign": (lambda y: y - 1, -1.0, {"stalled"}),
    "small and of the wrong sign": (lambda y: y - 1, -0.1, {"stalled"}),
    "1,000 times": (lambda y: y - 1, 1e3, {"stalled"}),
    "zero": (lambda y: y - 1, 0.0, {"stalled"}),
    "kink": (lambda y: jnp.abs(y - 1) + 1, 1.0, {"stalled"}),
    "twice": (lambda y: y - 1, 2.0, {"gradient", "step", "rounding"}),  # every step goes half of the way
    "right": (lambda y: y - 1, 1.0, {"gradient", "step", "rounding"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", FALSE_DERIVATIVES)
def test_a_false_jvp_is_not_called_converged(case):
    residual, factor, ends = FALSE_DERIVATIVES[case]

    @jax.custom_jvp
    def wrong(y):
        return residual(y)

    wrong.defjvp(lambda p, t: (wrong(*p), factor * jax.jvp(residual, p, t)[1]))

    @jax.jit
    @jax.vmap
    def solved(start):
        found = aj.least_squares(lambda y, _: wrong(y), start, throw=False)
        return found.value, numbers_of(found.stats["reason"])

    values, reasons = (np.asarray(x) for x in solved(jnp.asarray(_STARTS)))
    assert {int(reason) for reason in reasons} <= {int(numbers_of(getattr(aj.Reason, name))) for name in ends}
    if "step" in ends:
        np.testing.assert_allclose(values, 1.0, atol=1e-6)


@pytest.mark.slow
def test_a_false_jvp_is_not_called_converged_without_optimisations():
    """Of XLA, which decide what is rounded."""
    flags = {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
    command = [sys.executable, "-m", "pytest", "-n", "0", "-m", "", "-k", "test_a_false_jvp and not without", __file__]
    done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("bound", [0.5, np.float64(0.5), np.float32(0.5), jnp.asarray(0.5), np.array(0.5)])
def test_scalar_bounds_of_every_type(bound):
    found = aj.least_squares(lambda y, _: y - 2.0, jnp.zeros(3), lower=np.int64(-1), upper=bound)
    np.testing.assert_array_equal(found.value, np.full(3, 0.5))


def test_bounds_in_trees_with_none():
    residual = lambda y, _: {"a": y["a"] - 2.0, "b": y["b"] + 2.0}  # noqa: E731
    start = {"a": jnp.zeros(2), "b": jnp.zeros(())}
    found = aj.least_squares(residual, start, lower={"a": None, "b": -1}, upper={"a": [1.0, np.inf], "b": None})
    np.testing.assert_allclose(found.value["a"], [1.0, 2.0], rtol=1e-12)
    assert found.value["b"] == -1


def test_bounds_that_do_not_fit_are_refused():
    for lower in ({"a": 0.0}, [0.0, 1.0], "low"):
        with pytest.raises(aj.InputError, match="lower does not match the start"):
            aj.least_squares(lambda y, _: y, jnp.zeros(3), lower=lower)


def test_without_64_bit_floats_nothing_runs():
    with jax.enable_x64(False), pytest.raises(aj.InputError, match="64-bit floats were turned off"):
        aj.least_squares(lambda y, _: y, jnp.zeros(3))


def test_crossed_bounds_are_refused():
    with pytest.raises(aj.InputError, match="lower bound 2 of unknown 1 is above its upper bound 1"):
        aj.least_squares(lambda y, _: y, jnp.array([1.0]), lower=2.0, upper=1.0)


@pytest.mark.slow
def test_solves_under_vmap_equal_single_solves():
    problems = [bounded_problems.draw(seed) for seed in range(0, 24, 3)]
    stacked = {key: jnp.stack([jnp.asarray(problem[key]) for problem in problems]) for key in problems[0]}
    together = jax.jit(jax.vmap(solve))(stacked)[0]
    for value, problem in zip(together, problems, strict=True):
        single = solve({key: jnp.asarray(item) for key, item in problem.items()})[0]
        np.testing.assert_allclose(value / problem["unit"], single / problem["unit"], atol=1e-8)


@pytest.mark.parametrize(
    ("residual", "start", "reason", "result"),
    [
        (lambda y, _: jnp.log(y), -1.0, aj.Reason.nonfinite, optx.RESULTS.nonfinite),
        (lambda y, _: jnp.stack([10 * (y[1] - y[0] ** 2), 1 - y[0]]), [-1.2, 1.0], aj.Reason.max_steps, None),
    ],
)
def test_failure_is_data_and_an_exception_only_on_request(residual, start, reason, result):
    steps = 3 if result is None else 100
    solution = aj.least_squares(residual, jnp.asarray(start), max_steps=steps, throw=False)
    assert solution.stats["reason"] == reason
    assert solution.result == (optx.RESULTS.nonlinear_max_steps_reached if result is None else result)
    assert_refused(lambda: aj.least_squares(residual, jnp.asarray(start), max_steps=steps), aj.Reason[reason])
    with pytest.raises(eqx.EquinoxRuntimeError):
        eqx.filter_jit(lambda y: aj.least_squares(residual, y, max_steps=steps).value)(jnp.asarray(start))


def test_the_solution_is_a_point_that_was_evaluated():
    """A last step into where the residual does not exist is not taken unseen, however small it is."""
    solution = aj.least_squares(lambda y, _: jnp.sqrt(y - 1.0), jnp.array([1.05]), throw=False)
    assert np.all(np.isfinite(np.sqrt(np.asarray(solution.value) - 1.0)))
    assert float(solution.stats["cost"]) == pytest.approx(0.5 * float(solution.value[0] - 1.0), rel=1e-12)


def test_optimistix_takes_the_solver():
    fn, start, target = (lambda y, target: y - target), jnp.zeros(2), jnp.array([1.0, 3.0])
    options = {"lower": jnp.zeros(2), "upper": jnp.full(2, 2.0)}
    solution = optx.least_squares(fn, aj.solver.BoundedLevenbergMarquardt(), start, target, options)
    assert solution.result == optx.RESULTS.successful
    np.testing.assert_allclose(solution.value, [1.0, 2.0], rtol=0, atol=1e-12)
