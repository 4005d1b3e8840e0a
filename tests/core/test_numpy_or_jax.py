"""One code for two libraries: a single calibration by NumPy compiles nothing, and equals what JAX computes."""

import equinox as eqx
import jax
import numpy as np
import pytest

import aacmm_jax as aj

SOCKETS = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (450, -150, 260)}


@pytest.fixture(scope="module")
def arm():
    return aj.load_arm("cheng2018-simulation")


def capture_of(arm, poses, seed=1):
    lengths = [("A", "B", 0.002), ("B", "C", 0.002)]
    sockets = {name: SOCKETS[name] for name in poses}
    lengths = [length for length in lengths if length[0] in poses and length[1] in poses]
    return aj.simulate(arm, sockets, poses=poses, lengths=lengths, encoder_arcsec=2.0, seating=0.005, seed=seed)


NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)
CALLS = {
    "identify": lambda arm, capture, bounds: aj.identify(arm, capture, bounds),
    "identify, noise": lambda arm, capture, bounds: aj.identify(arm, capture, bounds, noise=NOISE),
    "two-stage": lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds),
    "joint": lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds, method="joint"),
    "joint, noise": lambda arm, capture, bounds: aj.calibrate(arm, capture, bounds, method="joint", noise=NOISE),
    "evaluate": lambda arm, capture, bounds: aj.evaluate(arm, capture),
    "fix_scale": lambda arm, capture, bounds: aj.fix_scale(arm, capture),
    "position": lambda arm, capture, bounds: arm.position(capture.q),
    "jacobian": lambda arm, capture, bounds: arm.jacobian(capture.q),
    "pose": lambda arm, capture, bounds: arm.pose(capture.q),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("call", "width"),
    [
        pytest.param("two-stage", 10.0, marks=pytest.mark.exhaustive),
        pytest.param("two-stage", 0.2, marks=pytest.mark.exhaustive),  # on bounds
        pytest.param("joint, noise", 0.2, marks=pytest.mark.slow),
        pytest.param("joint, noise", 10.0, marks=pytest.mark.exhaustive),
        ("evaluate", 10.0),
        ("fix_scale", 10.0),
        ("jacobian", 10.0),
        ("pose", 10.0),
    ],
)
def test_numpy_equals_jax(arm, call, width):
    space = aj.Parameters.free_of(arm)
    start = aj.perturbed_arm(space, length=0.3, angle=1e-3, seed=2)
    capture, bounds = capture_of(arm, {"A": 40, "B": 12}), aj.Bounds.around(start, space, length=width)
    known = CALLS[call](start, capture, bounds)
    traced = eqx.filter_jit(lambda traced: CALLS[call](start, traced, bounds))(capture)
    for (path, one), other in zip(
        jax.tree_util.tree_leaves_with_path(eqx.filter(known, eqx.is_array)),
        jax.tree.leaves(eqx.filter(traced, eqx.is_array)),
        strict=True,
    ):
        name = jax.tree_util.keystr(path)
        assert isinstance(one, jax.Array), name
        assert (one.shape, one.dtype) == (other.shape, other.dtype), name
        if "optimality" not in name and "steps" not in name:  # rounding, and what follows it
            values = np.asarray(other, dtype=float)
            scale = np.max(np.abs(values), initial=1e-12, where=np.isfinite(values))
            np.testing.assert_allclose(np.asarray(one) / scale, np.asarray(other) / scale, atol=1e-9, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_a_new_shape_compiles_nothing(arm, call):
    """A user's capture always has a new number of poses: nobody should wait for a compiler."""
    space = aj.Parameters.free_of(arm)
    bounds = aj.Bounds.around(arm, space)
    poses = {"A": 31 + list(CALLS).index(call), "B": 11, "C": 3}  # shapes that no other test has
    capture = capture_of(arm, poses)
    compiled = []

    def listener(event: str, _: float, **__: object) -> None:
        if "compile" in event:
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        CALLS[call](arm, capture, bounds)
    finally:
        jax.monitoring.clear_event_listeners()
    assert not compiled
