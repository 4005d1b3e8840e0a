"""Bad input from Python: every refusal names what is wrong, where, and what to do. Nearly all come before any solve."""

import json
import re
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import aacmm_jax as aj

from .refusals import assert_refused, refusal


@pytest.fixture(scope="module")
def given(paper_arm):
    """What the calls below are made of: the paper's arm, its free parameters and box, and ten poses."""
    space = aj.Parameters.free_of(paper_arm)
    q = np.random.default_rng(0).uniform(-1, 1, (10, 6))
    capture = aj.Capture({"A": q, "B": q[:1]}, [aj.ReferenceLength("A", "B", 100.0)])
    return SimpleNamespace(
        arm=paper_arm,
        space=space,
        bounds=aj.Bounds.around(paper_arm, space),
        start=space.vector(),
        q=q,
        capture=capture,
    )


def with_value(q: np.ndarray, pose: int, joint: int, value: float) -> np.ndarray:
    changed = q.copy()
    changed[pose - 1, joint - 1] = value
    return changed


def changed_arm(arm: aj.Arm, **changes) -> aj.Arm:
    kinds = {kind: getattr(arm, kind) for kind in ("alpha", "a", "d", "theta", "probe")}
    return aj.Arm(**(kinds | changes))


def shifted(given: SimpleNamespace, **changes: float) -> np.ndarray:
    """The start with some parameters moved."""
    start = np.array(given.start)
    for name, change in changes.items():
        start[given.space.index(name)] += change
    return start


@pytest.mark.parametrize(
    ("sockets", "parts"),
    [
        (lambda q: {"A": with_value(q, 3, 4, np.nan)}, ["socket 'A' pose 3 joint 4 is nan", "must be finite"]),
        (
            lambda q: {"A": q, "B": with_value(q, 1, 6, -np.inf)},
            ["socket 'B' pose 1 joint 6 is -inf", "must be finite"],
        ),
        (lambda q: {"A": [[0.1, 0.2], [0.1]]}, ["socket 'A'", "rows of unequal length"]),
        (lambda q: {"A": [["left", "right"]]}, ["socket 'A' must contain real numbers", "text"]),
        (lambda q: {"A": q + 1j}, ["socket 'A' must contain real numbers", "complex"]),
        (lambda q: {"A": [["0.1", "0.2"]]}, ["socket 'A' must contain real numbers", "text"]),
        (lambda q: {"A": q > 0}, ["socket 'A' must contain real numbers", "true or false"]),
        (lambda q: {"": q}, ["a socket has the name ''", "of one line"]),
        (lambda q: {"A\n": q}, ["a socket has the name 'A\\n'"]),
        (lambda q: {"A": q, "B": q[:, :5]}, ["socket 'B' has 5 columns", "socket 'A' has 6", "one column per joint"]),
        (lambda q: {"A": q[0]}, ["socket 'A' has shape (6,)", "expected (poses, joints)"]),
        (lambda q: {"A": q[:0]}, ["socket 'A' has shape (0, 6)", "at least one"]),
        (lambda q: {}, ["at least one socket"]),
        (lambda q: {"A": q, "B": q}, ["sockets 'A' and 'B' have exactly the same poses", "given twice?"]),
    ],
    ids=[
        *("nan", "infinite", "ragged", "text", "complex", "numbers as text", "booleans", "no name", "line end"),
        *("columns", "one row", "no pose", "no socket", "socket twice"),
    ],
)
def test_angles(given, sockets, parts):
    assert_refused(lambda: aj.Capture(sockets(given.q)), *parts)


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda q: aj.ReferenceLength("A", "B", 0.0), ["'A' to 'B' is 0 mm", "positive"]),
        (lambda q: aj.ReferenceLength("A", "B", -200.0), ["'A' to 'B' is -200 mm", "positive"]),
        (lambda q: aj.ReferenceLength("A", "B", np.nan), ["'A' to 'B' is nan", "finite"]),
        (lambda q: aj.ReferenceLength("A", "B", [1.0, 2.0]), ["'A' to 'B' has shape (2,)", "one number"]),
        (
            lambda q: aj.ReferenceLength("A", "B", 200.0, u=-0.002),
            ["u of reference length 'A' to 'B' is -0.002 mm", "zero or positive"],
        ),
        (lambda q: aj.ReferenceLength("A", "A", 200.0), ["'A' to 'A'", "itself", "two different sockets"]),
        (
            lambda q: aj.Capture({"plate": q, "B": -q}, [aj.ReferenceLength("plaet", "B", 200.0)]),
            ["'plaet' to 'B'", "unknown socket 'plaet'", "did you mean 'plate'?"],
        ),
        (
            lambda q: aj.Capture({"plate": q, "B": -q}, [aj.ReferenceLength("plate", "9", 200.0)]),
            ["unknown socket '9'", "choose one of plate, B"],
        ),
        (lambda q: aj.Capture({"plate": q}).select("palte"), ["'palte'", "did you mean 'plate'?"]),
        (lambda q: aj.Capture({"plate": q}).select(without="p*"), ["contains no socket", "select at least one"]),
        (lambda q: aj.scale_from_lengths(measured=[200.0, -1.0], nominal=200.0), ["measured[1] is -1 mm", "positive"]),
        (lambda q: aj.scale_from_lengths(measured=[200.0], nominal=[1.0, 2.0]), ["(2,)", "one number"]),
        (lambda q: aj.scale_from_lengths(measured=[], nominal=200.0), ["measured", "at least one"]),
    ],
    ids=[
        *("zero", "negative", "nan", "two values", "negative u", "same socket", "misspelt socket", "unknown socket"),
        *("select none", "select nothing left", "scale negative", "scale shapes", "scale of nothing"),
    ],
)
def test_lengths_and_sockets(given, call, parts):
    assert_refused(lambda: call(given.q), *parts)


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"a": [1.0, 2.0]}, ["a has shape (2,)", "give (..., joints) with 6 joints"]),
        ({"alpha": 1.5}, ["alpha has shape ()", "give (..., joints)"]),
        ({"d": [[1.0], [1.0, 2.0]]}, ["d has rows of unequal length"]),
        ({"d": ["one"] * 6}, ["d must contain real numbers", "text"]),
        ({"d": [0.0, 0.0, np.inf, 0.0, 0.0, 0.0]}, ["d[2] is inf; give finite numbers"]),
        ({"probe": [0.0, 102.0]}, ["probe has shape (2,)", "give (..., 3)"]),
        ({"alpha": np.zeros((3, 6)), "a": np.zeros((2, 6))}, ["(3,), (2,)", "the same batch shape"]),
        (
            {"limits": [(-1, 1)] * 3 + [(1, -1)] + [(-1, 1)] * 2},
            ["joint 4", "1 to -1 rad", "lower limit below the upper limit"],
        ),
        ({"limits": [(-1, np.inf)] + [(-1, 1)] * 5}, ["joint 1", "inf rad", "finite"]),
        ({"limits": [(-1, 1)] * 5}, ["limits must be 6 rows"]),
        ({"limits": [(-1, 0, 1)] * 6}, ["6 rows of (lowest, highest)"]),
    ],
    ids=[
        *("short", "scalar", "ragged", "text", "infinite", "probe", "batches"),
        *("limits reversed", "limits infinite", "limits rows", "limits columns"),
    ],
)
def test_arm(paper_arm, changes, parts):
    assert_refused(lambda: changed_arm(paper_arm, **changes), *parts)


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (lambda x: aj.Parameters.free_of(x.arm, held=["d_33"]), ["'d_33'", "6-joint arm", "did you mean 'd_3'?"]),
        (lambda x: aj.Parameters.free_of(x.arm, free=["beto_2"]), ["'beto_2'", "did you mean 'beta_2'?"]),
        (
            lambda x: aj.Parameters.free_of(x.arm, held=["d_1"], free=["d_1"]),
            ["'d_1'", "as held and as free", "only one"],
        ),
        (lambda x: aj.Parameters.free_of(x.arm, held=["d_1", "d_1"]), ["'d_1'", "twice in held", "once"]),
        (lambda x: aj.Bounds.around(x.arm, x.space, override={"prob_z": 60}), ["'prob_z'", "did you mean 'probe_z'?"]),
        (
            lambda x: aj.Bounds.around(x.arm, x.space, override={"d_1": 60}),
            ["'d_1' is held, not free", "such as 'alpha_1'"],
        ),
        (lambda x: aj.Bounds.around(x.arm, x.space, length=-1.0), ["length is -1", "zero or positive"]),
        (lambda x: aj.Bounds.around(x.arm, x.space, override={"d_3": np.nan}), ["override['d_3'] is nan"]),
        (
            lambda x: aj.Bounds(x.space, x.start, shifted(x, a_2=-1.5)),
            ["bounds of a_2 are 62 to 60.5", "not above the upper"],
        ),
        (
            lambda x: aj.Bounds(x.space, shifted(x, d_4=np.nan), x.start),
            ["bounds of d_4 are nan to 0", "must be numbers"],
        ),
        (lambda x: aj.Bounds(x.space, x.start[:-1], x.start), ["lower has shape (20,)", "21 parameters are free"]),
        (lambda x: aj.Bounds(x.space, x.start, [[0.0], [0.0, 1.0]]), ["upper has rows of unequal length"]),
        (lambda x: x.space.arm([1.0, 2.0]), ["vector has shape (2,)", "21 parameters are free"]),
        (lambda x: aj.Parameters(x.arm, ("d_3", "d_3")), ["'d_3' is given twice in names", "once"]),
        (lambda x: x.arm.jacobian(x.q, "d_9"), ["unknown parameter 'd_9'"]),
        (lambda x: x.arm.jacobian(x.q, ["q_7"]), ["'q_7'", "6-joint arm", "did you mean"]),
        (
            lambda x: x.arm.position(x.q[:, :5]),
            ["q has shape (10, 5)", "6 joints", "last axis must run over the joints"],
        ),
        (lambda x: x.arm.position("straight up"), ["q must contain real numbers"]),
    ],
    ids=[
        *("held", "free", "held and free", "held twice", "override", "override of held", "negative width"),
        *(
            "nan width",
            "reversed",
            "nan bound",
            "short bound",
            "ragged bound",
            "short vector",
            "parameters twice",
            "jacobian of one",
            "jacobian",
            "columns",
            "text",
        ),
    ],
)
def test_parameters_and_bounds(given, call, parts):
    assert_refused(lambda: call(given), *parts)


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (lambda x: {"hold": "dd_3"}, ["'dd_3'", "did you mean 'd_3'?"]),
        (lambda x: {"hold": "theta_2"}, ["'theta_2'", "is an angle", "hold a length", "'a_1'"]),
        (lambda x: {"hold": "d_1"}, ["'d_1' is held, not free"]),
        (lambda x: {"capture": aj.Capture({"A": x.q[:, :5]})}, ["5 columns", "6 joints", "one column per joint"]),
        (
            lambda x: {"bounds": aj.Bounds(x.space, shifted(x, d_3=1.0), shifted(x, d_3=2.0))},
            ["the arm is outside the bounds: d_3 is 750, not within 751 to 752", "move the start or widen"],
        ),
        (lambda x: {"start": shifted(x, a_4=11.0)}, ["the start is outside", "a_4 is 73, not within 52 to 72"]),
        (lambda x: {"start": shifted(x, a_4=np.nan)}, ["the start is outside", "a_4 is nan"]),
        (lambda x: {"max_steps": -1}, ["max_steps is -1", "at least 1"]),
        (
            lambda x: {"start": x.start[:-2]},
            ["the start has shape (19,)", "21 parameters are free", "one value per free parameter"],
        ),
    ],
    ids=["misspelt", "angle", "held", "columns", "arm outside", "start outside", "start nan", "steps", "start short"],
)
@pytest.mark.parametrize("run", [aj.identify, aj.calibrate], ids=["identify", "calibrate"])
def test_identification(given, run, arguments, parts):
    chosen = {"capture": given.capture, "bounds": given.bounds} | arguments(given)
    # Both need lengths to come as far as these checks; a capture of five columns brings its own.
    if run is aj.calibrate and not chosen["capture"].lengths:
        q = chosen["capture"].q
        chosen["capture"] = aj.Capture({"A": q, "B": -q}, given.capture.lengths)
    assert_refused(lambda: run(given.arm, chosen.pop("capture"), chosen.pop("bounds"), **chosen), *parts)


@pytest.mark.first_rows(6)
@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda x: aj.calibrate(x.arm, aj.Capture({"A": x.q}), x.bounds),
            ["no reference length", "add a reference length", "identify for stage 1"],
        ),
        (lambda x: aj.fix_scale(x.arm, aj.Capture({"A": x.q})), ["no reference length", "add a reference length"]),
        (
            lambda x: aj.evaluate(x.arm, aj.Capture({"A": x.q[:, :5]})),
            ["5 columns", "6 joints", "one column per joint"],
        ),
        (
            lambda x: aj.calibrate(x.arm, x.capture, x.bounds, method="both"),
            ["method is 'both'", "two-stage, joint"],
        ),
    ],
    ids=["calibrate without length", "fix_scale without length", "evaluate columns", "method"],
)
def test_calibration_and_evaluation(given, call, parts):
    assert_refused(lambda: call(given), *parts)


@pytest.mark.parametrize(
    "call",
    [
        lambda x, batch: batch.select("A"),
        lambda x, batch: aj.stack_captures([batch]),
        lambda x, batch: aj.fix_scale(x.arm, batch),
        lambda x, batch: aj.observability(x.arm, batch),
        lambda x, batch: aj.files.save_capture("no.h5", aj.Recording(batch, aj.files.load_specification("panda"))),
    ],
    ids=["select", "stack", "fix_scale", "observability", "save_capture"],
)
def test_one_capture_is_needed(given, call):
    assert_refused(lambda: call(given, aj.stack_captures([given.capture] * 2)), "a batch of stacked captures")


class Reached(Exception):
    """The solve would begin."""


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("hold", ["longest", None])
@pytest.mark.parametrize(
    ("sizes", "held"),
    [((7,), None), ((4, 4), None), ((1, 1, 1), None), ((2, 1), ["alpha_1"]), ((2,), "lengths"), ((4, 1), "lengths")],
    ids=str,
)
def test_too_few_poses(given, monkeypatch, sizes, held, hold):
    """A socket of m poses gives 3 (m - 1) equations; the number of poses named as enough is the least."""
    if held == "lengths":
        # Angles alone: nothing slides with the scale, so every free one is determined.
        held = [name for name in aj.kinematics.parameter_names(given.arm) if not name.startswith(("alpha", "theta"))]
    space = aj.Parameters.free_of(given.arm, held=held)
    bounds = aj.Bounds.around(given.arm, space)

    def reached(*arguments):
        raise Reached

    def run(sizes):
        random = np.random.default_rng(0)
        capture = aj.Capture({f"S{i}": random.uniform(-1, 1, (size, 6)) for i, size in enumerate(sizes)})
        return aj.identify(given.arm, capture, bounds, hold=hold)

    sentence = refusal(lambda: run(sizes))
    assert "record more poses or fix more parameters" in sentence
    poses, sockets, equations, unknowns, needed = map(int, re.findall(r"\d+", sentence))
    assert (poses, sockets, equations) == (sum(sizes), len(sizes), 3 * sum(size - 1 for size in sizes))
    # One length is the scale, which repeatability does not see, whether it is held or slides.
    assert unknowns == len(space.names) - any(space.lengths)
    assert equations < unknowns
    assert 3 * (needed - sockets) >= unknowns > 3 * (needed - 1 - sockets)
    monkeypatch.setattr("aacmm_jax.pipeline.single._identified", reached)
    more = needed - sum(sizes)
    refusal(lambda: run((sizes[0] + more - 1, *sizes[1:])))
    with pytest.raises(Reached):
        run((sizes[0] + more, *sizes[1:]))


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"encoder_arcsec": -2.0}, ["encoder_arcsec is -2", "zero or positive"]),
        ({"resolution_arcsec": -1.0}, ["resolution_arcsec is -1"]),
        ({"seating": np.nan}, ["seating is nan"]),
        ({"poses": 0}, ["number of poses of socket 'A' is 0", "at least 1"]),
        (
            {"poses": {"A": 3}, "sockets": {"A": (400, 200, 300), "B": (500, 200, 300)}},
            ["number of poses of socket 'B' is 0"],
        ),
        ({"poses": {"A": 3, "plate": 2}}, ["unknown socket 'plate'", "choose one of A."]),
        ({"sockets": {}}, ["at least one socket"]),
        ({"sockets": {"A": (400.0, 200.0)}}, ["socket 'A' has shape (2,)", "three coordinates", "mm"]),
        ({"sockets": {"A": (400.0, np.inf, 200.0)}}, ["socket 'A'", "not finite"]),
        ({"limits": [(-1, 1)] * 5}, ["6 rows of (lowest, highest)"]),
        ({"limits": [(-1, 1)] * 5 + [(2, 1)]}, ["limits of joint 6 are 2 to 1 rad"]),
        ({"lengths": [("A", "B")], "poses": 1}, ["'A' to 'B' names the unknown socket 'B'; choose one of A."]),
        ({"lengths": [("A", "B", 1.0, 2.0)], "poses": 1}, ["('A', 'B', 1.0, 2.0)", "(socket, socket, u)"]),
        ({"seed": 2**63, "poses": 1}, ["the seed is 9223372036854775808", "whole number of at most 63 bits"]),
        (
            {"sockets": {"far": (9000, 0, 0)}, "poses": 1},
            ["socket 'far' at (9000, 0, 0) mm", "cannot be reached", "1864 mm"],
        ),
    ],
    ids=[
        *("encoder", "resolution", "seating", "no poses", "no poses of one", "poses of unknown", "no socket"),
        *(
            "two coordinates",
            "infinite",
            "limits rows",
            "limits reversed",
            "length",
            "length of four",
            "seed",
            "out of reach",
        ),
    ],
)
def test_simulation(paper_arm, arguments, parts):
    chosen = {"sockets": {"A": (400, 200, 300)}} | arguments
    assert_refused(lambda: aj.simulate(paper_arm, **chosen), *parts)


def test_deviation_and_batch(given):
    assert_refused(lambda: aj.perturbed_arm(given.space, length=-1.0, angle=0.0), "length is -1", "zero or positive")
    batch = changed_arm(given.arm, a=np.zeros((2, 6)))
    assert_refused(lambda: aj.simulate(batch, {"A": (400, 200, 300)}), "needs a single arm")


def test_values_are_not_looked_at_inside_jit(given):
    """Traced values cannot be checked, and lists may hold them; shapes are checked as ever."""
    capture = jax.jit(lambda q: aj.Capture({"A": q}))(with_value(given.q, 1, 1, np.nan))
    assert np.isnan(capture.q[0, 0])
    jax.jit(lambda x: aj.Bounds(given.space, [x] * 21, given.start).lower)(1e3)
    assert_refused(
        lambda: jax.jit(lambda x: aj.Bounds(given.space, [x] * 20, given.start).lower)(1.0), "lower has shape (20,)"
    )


# Of another type than the annotations say, which the run-time type checker of the tests would refuse first.
WRONG_TYPES = {
    "aj.Capture({'A': q, 'B': -q}, [('A', 'B', 100.0)])": "not a reference length; give aj.ReferenceLength(",
    "aj.Capture({1: q})": "a socket has the name 1",
    "aj.identify(arm, capture, bounds, noise=2.0)": "noise is 2.0; give a Noise.",
    "aj.simulate(arm, {'A': (400, 200, 300)}, poses=2.5)": "poses is 2.5; give a whole number",
    "aj.simulate(arm, {'A': (400, 200, 300)}, poses=1, seed=1.5)": "seed is 1.5; give a whole number",
    "aj.load_arm(None)": "the path of a file is of type NoneType",
    "aj.Arm(alpha=[0.0], a=[1.0], d=[0.0], limits=[0, 1])": "limits must be 1 row of (lowest, highest)",
}


# Refused as well, in one sentence of whatever words.
REFUSED = """
aj.Capture({"A": masked(q)})
aj.Capture({"A": list(masked(q))})
aj.Capture({"A": q.astype("datetime64[s]")})
aj.Capture({"A": None})
aj.Capture("A")
aj.Capture(q)
aj.Capture({"A": q}, 5)
aj.Capture({"A": q, "B": q[:1]}, [None])
aj.ReferenceLength("A", "B", masked(np.array(200.0)))
aj.ReferenceLength("A", "B", "200")
aj.ReferenceLength("A", "B", True)
aj.ReferenceLength("A", "B", 200 + 1j)
aj.ReferenceLength("A", "B", 200.0, u=None)
aj.ReferenceLength(1, 2, 200.0)
capture.select(5)
capture.select([5])
capture.select(without=None)
aj.stack_captures(None)
aj.stack_captures(capture)
aj.stack_captures([capture, 5])
aj.Arm(alpha=masked(np.ones(2)), a=[1.0, 2.0], d=[1.0, 2.0])
arm.position(masked(q))
aj.Noise(seating=masked(np.array(0.1)))
aj.Noise(encoder_arcsec=True)
aj.Bounds(5, bounds.lower, bounds.upper)
aj.Bounds(space, masked(np.asarray(bounds.lower)), bounds.upper)
aj.Bounds.around(arm, 5)
aj.Bounds.around(arm, space, length="x")
aj.Bounds.around(arm, space, override=5)
aj.Bounds.around(arm, space, override={"d_3": "x"})
aj.Parameters(5, ("d_3",))
aj.Parameters(arm, "d_3")
aj.Parameters(arm, ("d_99",))
aj.Parameters.free_of(5)
aj.Parameters.free_of(arm, held=5)
aj.perturbed_arm(space, length="x", angle=0.0)
aj.perturbed_arm(space, length=1.0, angle=0.0, seed=True)
aj.simulate(arm, {"A": (400, 200, 300)}, poses=True)
aj.simulate(arm, {"A": (400, 200, 300)}, poses=2, seed=True)
aj.simulate(arm, {"A": (400, 200, 300)}, poses=2, lengths=5)
aj.simulate(arm, {"A": masked(np.array([400.0, 200.0, 300.0]))}, poses=2)
aj.simulate(arm, 5, poses=2)
aj.simulate(arm, {"A": (400, 200, 300)}, poses=2, noise={"seating": 0.1})
aj.simulate(put_nan(arm, lambda x: x.d), {"A": (400, 200, 300)}, poses=2)
aj.fix_scale(5, capture)
aj.fix_scale(arm, 5)
aj.fix_scale(arm, capture, sigma="x")
aj.fix_scale(arm, capture, sigma=np.nan)
aj.fix_scale(arm, capture, sigma=-1.0)
aj.fix_scale(arm, capture, sigma=[1.0, 2.0])
aj.fix_scale(put_nan(arm, lambda x: x.d), capture)
aj.fix_scale(batch(arm), capture)
aj.scale_from_lengths(masked(np.array([200.0, 999.0])), 200.0)
aj.scale_from_lengths([200.0], 200.0, u=-1.0)
aj.scale_from_lengths([200.0], 200.0, u="x")
aj.identify(5, capture, bounds)
aj.identify(arm, 5, bounds)
aj.identify(arm, capture, None)
aj.identify(arm, put_nan(capture, lambda x: x.q), bounds)
aj.identify(arm, put_nan(capture, lambda x: x.lengths[0].value), bounds)
aj.identify(arm, capture, put_nan(bounds, lambda x: x.lower))
aj.identify(arm, capture, bounds, noise=put_nan(aj.Noise(seating=0.1), lambda x: x.seating))
aj.identify(arm, capture, bounds, start=masked(np.asarray(space.vector())))
aj.identify(arm, capture, bounds, max_steps=2.5)
aj.identify(arm, capture, bounds, max_steps=None)
aj.calibrate(arm, put_nan(capture, lambda x: x.q), bounds)
aj.calibrate(put_nan(arm, lambda x: x.d), capture, bounds)
aj.evaluate(5, capture)
aj.evaluate(arm, None)
aj.uncertainty_of(capture)
aj.monte_carlo(5, capture)
aj.monte_carlo(result, 5)
aj.monte_carlo(result, capture, level="x")
aj.monte_carlo(result, capture, level=np.nan)
aj.monte_carlo(result, capture, most=np.nan)
aj.monte_carlo(result, capture, digits=1.5)
aj.monte_carlo(result, capture, seed=1.5)
aj.monte_carlo(result, capture, seed=-1)
aj.monte_carlo(result, capture, lengths=5)
aj.bootstrap(5, capture)
aj.bootstrap(result, capture, trials=100.5)
aj.bootstrap(result, capture, level=2.0)
aj.bootstrap(result, capture, seed=-1)
aj.cross_validate(arm, capture, 5)
aj.observability(arm, 5)
aj.observability(put_nan(arm, lambda x: x.d), capture)
aj.observability(arm, capture, sigma="x")
aj.volumetric_uncertainty(result)
aj.volumetric_uncertainty(aj.uncertainty_of(result), points=2.5)
aj.volumetric_uncertainty(aj.uncertainty_of(result), seed=1.5)
aj.calibration.record_of(result, 5)
aj.model.repeatability(5, (1,))
aj.model.repeatability(np.zeros((0, 3)), ())
aj.model.repeatability(np.zeros((3, 3)), (1, 1))
aj.model.repeatability(np.zeros((3, 3)), (2.5, 0.5))
aj.model.repeatability(np.zeros((3, 3)), (4, -1))
aj.model.repeatability(np.zeros((3, 2)), (3,))
aj.model.repeatability(masked(np.zeros((3, 3))), (3,))
jax.jit(aj.model.repeatability)(jnp.zeros((3, 3)), (2, 1))
jax.vmap(aj.model.repeatability)(jnp.zeros((2, 3, 3)), (jnp.asarray([2, 2]), jnp.asarray([1, 1])))
aj.least_squares(lambda y, _: jnp.zeros(0), jnp.ones(2))
aj.least_squares(lambda y, _: y + 1j, jnp.ones(2))
aj.least_squares(lambda y, _: y, "x")
aj.least_squares(lambda y, _: y, jnp.zeros(0))
aj.least_squares(lambda y, _: y, masked(np.ones(2)))
aj.least_squares(lambda y, _: y, jnp.ones(2), max_steps=2.5)
aj.identify_many(5, capture, bounds, start=start)
aj.identify_many(arm, capture, bounds, start=start, slots=2.5)
aj.identify_many(arm, capture, bounds, start=start, devices=5)
aj.identify_many(arm, capture, bounds, start=start, devices=[])
aj.identify_many(arm, capture, bounds, start=start, noise=5)
jax.jit(lambda x: aj.identify_many(arm, capture, bounds, start=x).de)(start)
jax.vmap(lambda x: aj.calibrate_many(arm, capture, bounds, start=x).de)(start[None])
batch(result).active_names()
batch(result.stage1).implausible_residual
aj.study.read_study(2.5)
aj.load_arm(np.ones((9, 9)))
aj.Parameters.free_of(arm, held=np.ones((2, 2, 2)))
aj.calibrate(arm, capture, bounds, method=np.array(["1", "2"]))
aj.fix_scale(arm, capture, sigma=np.inf)
aj.files.load_capture(0)
aj.files.save_arm(arm, 1)
arm.jacobian(q, 1e300)
aj.calibrate(arm, capture, bounds, hold=np.ones(0))
aj.Capture({"A": q}, np.ones((2, 2, 2)))
aj.simulate(arm, {"A": (400, 200, 300)}, lengths=np.ones((2, 2, 2)))
aj.simulate(arm, {"A": (400, 200, 300), "B": (300, 200, 300)}, lengths=[("A", "B", "2")])
aj.simulate(arm, {"A": (400, 200, 300), "B": (300, 200, 300)}, lengths=[(["A"], "B")])
aj.simulate(arm, {"A": (400, 200, 300)}, poses=10**30)
""".strip().splitlines()

# Lengths that overflow, or no arm can have: data, and never called converged.
NOT_CONVERGED = """
aj.calibrate(arm, length(1e300), bounds)
aj.calibrate(arm, length(1e-300), bounds)
aj.calibrate(arm, length(1e7), bounds)
aj.calibrate(arm, length(100.0, 1e300), bounds)
aj.calibrate(arm, length(1e7), bounds, method="joint")
""".strip().splitlines()


@pytest.mark.slow
def test_what_has_another_type():
    """In one process without that checker."""
    program = """
import json, sys
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import aacmm_jax as aj

def masked(values):
    return np.ma.masked_array(values, mask=np.arange(values.size).reshape(values.shape) == 0)

def put_nan(tree, where):
    return eqx.tree_at(where, tree, jnp.full_like(where(tree), jnp.nan))

def batch(tree):
    return jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), tree)

def length(*values):
    return aj.Capture({"A": q, "B": q[:1]}, [aj.ReferenceLength("A", "B", *values)])

q = np.random.default_rng(0).uniform(-1, 1, (10, 6))
arm = aj.load_arm("cheng2018-simulation")
space = aj.Parameters.free_of(arm)
bounds = aj.Bounds.around(arm, space)
capture = length(100.0)
start = space.vector()[None]
result = aj.calibrate(arm, capture, bounds, undetermined="ignore")
said = []
for call in json.load(sys.stdin):
    try:
        found = eval(call)
        said.append(f"returned, converged: {getattr(found, 'converged', None)}")
    except aj.InputError as error:
        said.append(f"InputError: {error}")
    except Exception as error:
        said.append(repr(error))
print(json.dumps(said))
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        input=json.dumps([*WRONG_TYPES, *REFUSED, *NOT_CONVERGED]),
        capture_output=True,
        text=True,
        check=True,
    )
    said = dict(zip([*WRONG_TYPES, *REFUSED, *NOT_CONVERGED], json.loads(done.stdout), strict=True))
    expected = WRONG_TYPES | dict.fromkeys(REFUSED, "InputError: ")
    expected |= dict.fromkeys(NOT_CONVERGED, "returned, converged: False")
    wrong = {call: said[call] for call, part in expected.items() if part not in said[call] or "\n" in said[call]}
    assert not wrong
