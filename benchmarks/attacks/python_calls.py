"""Hostile arguments of Python functions: each call ends in a result of finite numbers or in `InputError`.

Of a call that works, one argument is replaced. Some values are never an argument of anything (NaN, masked arrays,
complex numbers, truth values, objects); a call that takes one is a silent difference.
"""

import inspect
import random
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

import aacmm_jax as aj

from .outcomes import DONE, REFUSED, SILENT, Attempt, ending
from .samples import simulated as all_kinds

SECONDS = 120
NEVER: list[Any] = [
    float("nan"), np.nan * np.ones(3), np.ma.masked_array([1.0, 2.0, 3.0], [0, 1, 0]), 1j, np.ones(3) * 1j, b"1", "1_0",
    np.array(["1", "2"]), np.array([True, False]), np.array([{}, None]), {1.0}, object(), [[1.0], [1.0, 2.0]],
]  # fmt: skip
RARELY: list[Any] = [
    None, True, float("inf"), -float("inf"), -1, 0, 1e300, -1e300, 1e-300, 10**30, 2.5, "", "abc", "\0", "\x1b[2J", [],
    {}, np.ones(0), np.zeros((3, 0)), np.ones((2, 2, 2)), np.full((4, 6), 1e200), np.ones(3), np.int8(3),
    np.float32(0.1), np.datetime64("2026-01-01"), range(3), lambda: 0, -7,
]  # fmt: skip


def good_calls() -> dict[str, tuple[Callable, dict[str, Any]]]:
    """Calls that work, by name: the function and its arguments."""
    nominal = aj.load_arm("cheng2018-simulation")
    sockets = {"A": (400, 200, 300), "B": (300, 350, 300), "C": (300, -350, 400)}
    capture = aj.simulate(nominal, sockets, poses=14, lengths=[("A", "B", 0.002)], encoder_arcsec=2.0, seed=1)
    space = aj.Parameters.free_of(nominal)
    bounds = aj.Bounds.around(nominal, space, length=2.0, angle=0.01)
    noise = aj.Noise(encoder_arcsec=2.0, seating=0.005)
    angles = {name: getattr(nominal, name) for name in ("alpha", "a", "d", "theta")}
    task = {"arm": nominal, "capture": capture, "bounds": bounds, "max_steps": 50}
    batch = {"lower": bounds.lower, "upper": bounds.upper, "start": np.asarray(space.vector())[None]}
    uncertainty = aj.uncertainty_of(aj.calibrate(nominal, capture, bounds))
    length = aj.ReferenceLength("A", "B", 200.0, 0.001)
    cloud = np.random.default_rng(0).normal(size=(25, 3))
    cloud = 12.5 * cloud / np.linalg.norm(cloud, axis=1)[:, None]
    return observed_calls(nominal, capture) | {
        "Arm": (aj.Arm, {**angles, "probe": nominal.probe, "limits": [(-3, 3)] * 6}),
        "Arm.position": (nominal.position, {"q": np.zeros((4, 6))}),
        "Arm.jacobian": (nominal.jacobian, {"q": np.zeros((4, 6)), "names": space.names}),
        "Arm.replace": (nominal.replace, {"d_2": 20.0, "alpha_1": 1.5}),
        "Parameters.free_of": (aj.Parameters.free_of, {"arm": nominal, "held": ("d_1",)}),
        "Bounds": (aj.Bounds, {"space": space, "lower": bounds.lower, "upper": bounds.upper}),
        "Bounds.around": (aj.Bounds.around, {"arm": nominal, "space": space, "length": 2.0, "angle": 0.01}),
        "Capture": (aj.Capture, {"sockets": dict(capture.sockets), "lengths": [length]}),
        "Capture of one array": (lambda q: aj.Capture({"A": q}), {"q": np.zeros((4, 6))}),
        "ReferenceLength": (aj.ReferenceLength, {"start": "A", "end": "B", "value": 200.0, "u": 0.001}),
        "Noise": (aj.Noise, {"encoder_arcsec": 2.0, "seating": 0.005}),
        "simulate": (
            aj.simulate,
            {"arm": nominal, "sockets": sockets, "poses": 4, "lengths": [("A", "B", 0.002)], "noise": noise, "seed": 1},
        ),
        "identify": (aj.identify, {**task, "hold": "longest", "noise": noise}),
        "calibrate": (aj.calibrate, {**task, "hold": "longest", "method": "two-stage"}),
        "identify_many": (aj.identify_many, {"arm": nominal, "capture": capture, **batch, "max_steps": 50}),
        "fix_scale": (aj.fix_scale, {"arm": nominal, "capture": capture, "sigma": 0.01}),
        "scale_from_lengths": (aj.scale_from_lengths, {"measured": [200.1, 200.2], "nominal": 200.0, "u": 0.001}),
        "observability": (aj.observability, {"arm": nominal, "capture": capture, "space": space}),
        "volumetric_uncertainty": (
            aj.volumetric_uncertainty,
            {"uncertainty": uncertainty, "points": 20, "length": 500.0, "seed": 0},
        ),
        "fit_sphere": (aj.acceptance.fit_sphere, {"points": cloud}),
        "enclosing_sphere": (aj.acceptance.enclosing_sphere, {"points": cloud}),
        "make_study": (
            aj.study.make_study,
            {"arm": "cheng2018-simulation", "trials": 4, "seed": 1, "capture": capture, "noise": {"seating_mm": 0.01}},
        ),
        "read_study": (aj.study.read_study, {"source": "noise"}),
        "load_arm": (aj.load_arm, {"source": "cheng2018-simulation"}),
    }  # fmt: skip


def observed_calls(nominal: aj.Arm, sockets: aj.Capture) -> dict[str, tuple[Callable, dict[str, Any]]]:
    """Calls with observations: the constructor of every kind and of its simulation, and what takes them."""
    observations = aj.data.observations
    noise = aj.Noise(encoder_arcsec=2.0, seating=0.005)
    capture = aj.simulate(nominal, {"A": (400, 200, 300)}, poses=6, observations=all_kinds(), noise=noise)
    few = aj.Parameters(nominal, ("a_2", "d_4", "theta_2"))
    calls: dict[str, tuple[Callable, dict[str, Any]]] = {
        "join_sessions": (aj.join_sessions, {"captures": {"one": sockets, "other": capture}, "own_probe": True}),
        "stack_captures": (aj.data.stack_captures, {"captures": [capture, capture]}),
        "Capture of observations": (
            aj.Capture,
            {"sockets": dict(capture.sockets), "lengths": (), "observations": capture.observations},
        ),
        "simulate observations": (
            aj.simulate,
            {"arm": nominal, "sockets": {}, "observations": all_kinds()[2:4], "noise": noise, "seed": 1},
        ),
        "calibrate observations": (
            aj.calibrate,
            {
                "arm": nominal,
                "capture": capture,
                "bounds": aj.Bounds.around(nominal, few),
                "robust": "huber",
                "noise": noise,
                "max_steps": 20,
            },
        ),
        "Socket": (observations.Socket, {"name": "A", "q": np.zeros((3, 6)), "target": ""}),
    }
    for simulated in all_kinds():
        options = inspect.signature(type(simulated)).parameters
        fields = {name: value for name, value in vars(simulated).items() if name in options}
        calls[f"{type(simulated).__name__} '{simulated.name}'"] = (type(simulated), fields)
    for one in capture.observations:
        kind, stored = type(one), one.stored()
        if isinstance(one, observations.ParallelPlanes):
            first = one.side.count("one")
            sides = {"one": one.q[:first], "other": one.q[first:]}
            stored = sides | {key: value for key, value in stored.items() if key not in ("q", "side")}
        if isinstance(one, observations.Artefact):
            points = dict(zip(one.names, one.coordinates, strict=True))
            blocks = {name: one.q[5 * i : 5 * i + 5] for i, name in enumerate(one.names)}
            taken = ("q", "point", "names", "coordinates")
            stored = {"points": points, "q": blocks} | {k: v for k, v in stored.items() if k not in taken}
        calls[kind.__name__ + f" '{one.name}'"] = (kind, {"name": one.name, **stored})
    return calls


def not_finite(result: Any) -> bool:
    """Whether a result that claims to be one contains NaN; bounds and limits may be infinite."""
    converged = getattr(result, "converged", True)
    leaves = [leaf for leaf in jax.tree.leaves(result) if hasattr(leaf, "dtype") and leaf.dtype.kind == "f"]
    return bool(np.all(converged)) and any(np.isnan(np.asarray(leaf)).any() for leaf in leaves)


def attack(seed: int, count: int) -> Iterator[Attempt]:
    """So many calls, each with one hostile argument."""
    choose = random.Random(seed)
    calls = good_calls()
    for name, (function, arguments) in calls.items():
        outcome, found = ending(lambda: function(**arguments), SECONDS)  # noqa: B023
        assert outcome is None, f"{name} does not work unchanged: {outcome} {found}"
    for _ in range(count):
        name = choose.choice(list(calls))
        function, arguments = calls[name]
        replaced = choose.choice(list(arguments))
        never = choose.random() < 0.5
        value = choose.choice(NEVER if never else RARELY)
        never = never and not (isinstance(value, str) and isinstance(arguments[replaced], str))  # any text is a name
        outcome, found = ending(lambda: function(**(arguments | {replaced: value})), SECONDS)  # noqa: B023
        if outcome is None:
            outcome, found = (SILENT, str(found)[:200]) if never or not_finite(found) else (DONE, "")
        yield Attempt(f"aj.{name}", outcome, f"{replaced}={str(value)[:60]!r} {found if outcome != REFUSED else ''}")
