"""Contacts of a tip with a surface that another chain of a robot carries."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data.observations.observation import Tips
from aacmm_jax.model.observed import Observed
from aacmm_jax.model.rows import rows_at

kinds = aj.data.observations
LIMITS = [[-2.5, 2.5]] * 6
ARM = aj.Arm(
    alpha=[1.57, 0.05, 1.5, -1.4, 1.3, 0.2], a=[30, 300, 250, 20, 10, 5], d=[90, 10, 20, 60, 80, 40],
    probe=(20, 0, 80), limits=LIMITS,
)  # fmt: skip
BASE = np.diag([-1.0, -1.0, 1.0, 1.0]) + np.array([[0, 0, 0, 500.0]] + 3 * [[0] * 4])
TWO = aj.kinematics.together({"left": ARM, "right": ARM}, bases={"right": BASE})
BOX = [[200, -100, 200], [300, 100, 400]]
BALL = kinds.SimulatedSphereContact("ball", BOX, (10, 0, 60), 30.0, 14, "left", "right", stylus=6.0)
INNER = kinds.SimulatedSphereContact(
    "inner", [[300, -200, 100], [600, 200, 700]], (10, 0, 60), 30.0, 14, "left", "right", link=3
)
PLATE = kinds.SimulatedPlaneContact("plate", BOX, (20, -40, 30), [[60, 0, 10], [0, 80, 0]], 14, "left", "right")


def observed(capture: aj.Capture, arm: aj.Arm) -> tuple[Observed, aj.Parameters]:
    """What the contacts of a capture say of all parameters of a robot."""
    return Observed.of(capture, arm), aj.Parameters.independent(arm)


@pytest.mark.slow
@pytest.mark.parametrize("simulated", [BALL, PLATE, INNER], ids=["sphere", "plane", "inner link"])
def test_exact_contacts_have_no_residual_and_exact_derivatives(simulated):
    capture = aj.simulate(TWO, {}, observations=[simulated], seed=1)
    assert len(capture.sockets) == simulated.poses
    assert {int(q[0, -1]) for q in capture.sockets.values()} == {0}
    (contact,) = capture.observations
    body = 1 if simulated.link is None else aj.kinematics.chain_of(TWO, "right").body(simulated.link)
    assert np.all(np.asarray(contact.q)[:, -1] == body)
    seen, space = observed(capture, TWO)
    vector = np.asarray(space.vector())
    geometry = np.asarray(seen.start(space, vector))
    rows = to_numpy(rows_at(space, seen, np.concatenate([vector, geometry])).rows)
    values = [np.asarray(part.values) for part in rows]
    assert max(np.abs(part).max() for part in values) < 1e-6

    # The derivatives of the contact itself: by its tips, its axes, and all its unknowns.
    tips = np.asarray(TWO.position(contact.q)).T
    axes = [np.asarray(TWO.pose(contact.q))[:, :3, k].T for k in range(3)]
    parts = seen.split(geometry)
    unknowns = {name: parts[name][:, None] + 0.3 for name in contact.unknowns}
    base = contact.residual(Tips(tips, (axes[0], axes[1], axes[2])), unknowns)
    assert base.by_rotation is not None

    def values_at(shift, turn, changed):
        turned = [axis + np.cross(np.broadcast_to(turn, axis.T.shape), axis.T).T for axis in axes]
        return np.asarray(
            contact.residual(Tips(tips + shift[:, None], (turned[0], turned[1], turned[2])), changed).values
        )

    step = 1e-5
    for i, unit in enumerate(np.eye(3)):
        by_tip = (values_at(step * unit, 0 * unit, unknowns) - values_at(-step * unit, 0 * unit, unknowns)) / (2 * step)
        np.testing.assert_allclose(base.by_tip[:, i], by_tip, atol=1e-6)
        turned = (values_at(0 * unit, step * unit, unknowns) - values_at(0 * unit, -step * unit, unknowns)) / (2 * step)
        np.testing.assert_allclose(base.by_rotation[:, i], turned, rtol=1e-5, atol=1e-4)
    still = np.zeros(3)
    for name, derivative in base.by_unknowns.items():
        for k, unit in enumerate(np.eye(len(unknowns[name]))):
            up, down = (unknowns | {name: unknowns[name] + sign * step * unit[:, None]} for sign in (1, -1))
            by_number = (values_at(still, still, up) - values_at(still, still, down)) / (2 * step)
            np.testing.assert_allclose(derivative[k], by_number, rtol=1e-5, atol=1e-4)


def on_torso(side: int) -> aj.Arm:
    """An arm after a torso of two joints, to the left (1) or right (-1) of it."""
    rows = {kind: np.asarray(getattr(ARM, kind)) for kind in ("alpha", "a", "d", "theta")}
    torso = {"alpha": (0.3, 0.5 * side), "a": (40.0, 150.0 * side), "d": (200.0, 60.0), "theta": (0.0, 0.0)}
    joined = {kind: np.concatenate([torso[kind], values]) for kind, values in rows.items()}
    return aj.Arm(**joined, probe=(20, 0, 80), limits=[[-1, 1]] * 2 + LIMITS)


NAMES = {side: ["first", "second", *(f"{side} {i}" for i in range(6))] for side in ("left", "right")}
TORSO = aj.kinematics.together({"left": on_torso(1), "right": on_torso(-1)}, joints=NAMES)
BESIDE = [[-200, -500, 200], [300, 100, 700]]
TORSO_LINK = kinds.SimulatedSphereContact("link", BESIDE, (10, 0, 60), 30.0, 10, "left", "right", link=4)


@pytest.mark.slow
def test_joints_that_carry_both_bodies_are_read_once():
    torso, link = TORSO, TORSO_LINK
    plate = kinds.SimulatedPlaneContact("plate", BESIDE, (20, -40, 30), [[60, 0, 10], [0, 80, 0]], 10, "left", "right")
    noise = aj.Noise(encoder_arcsec=10.0)
    capture = aj.simulate(torso, {"A": (100, 0, 500)}, poses=6, observations=[link, plate], noise=noise, seed=1)
    for contact in capture.observations:
        other = np.concatenate([capture.sockets[name] for name in contact.socket])
        np.testing.assert_array_equal(np.asarray(contact.q)[:, :2], other[:, :2])
    seen = Observed.of(capture, torso)
    contacts = np.arange(len(seen.q)) >= 6
    assert seen.counted is not None
    np.testing.assert_array_equal(seen.counted[0], ~contacts)
    np.testing.assert_array_equal(seen.counted[-1], 1)

    # An error of the torso's readings changes no contact: the place, which is unknown, moves along.
    space = aj.Parameters.independent(torso)
    vector = np.asarray(space.vector())

    def residuals(q: np.ndarray) -> np.ndarray:
        moved = seen.moved(torso, q)
        rows = rows_at(space, moved, np.concatenate([vector, moved.start(space, vector)])).rows
        return np.concatenate([np.asarray(part.values).ravel() for part in rows])

    turned = np.array(seen.q)
    turned[contacts, :2] += 0.01
    np.testing.assert_allclose(residuals(turned), residuals(np.array(seen.q)), atol=1e-7)
    # A torso that stood elsewhere in one of the two poses was read twice.
    apart = aj.Capture(
        dict(capture.sockets),
        observations=[
            capture.observations[0].changed(
                q=np.asarray(capture.observations[0].q) + 1e-9 * np.eye(len(torso.alpha) + 1)[0]
            )
        ],
    )
    assert Observed.of(apart, torso).counted is None


FAR = INNER.changed(region=np.array(BOX) + 5000.0)
SIDES = [[60, 0, 10], [0, 80, 0]]
REFUSED = {
    "name two chains": lambda: kinds.SimulatedPlaneContact("plate", BOX, (0, 0, 0), SIDES, 3, "left", "left"),
    "link 7 does not exist; give .* 1 to 6": lambda: aj.simulate(TWO, {}, observations=[INNER.changed(link=7)]),
    "almost never in its region": lambda: aj.simulate(TWO, {}, observations=[FAR]),
    "give the number of a chain, 0 to 1": lambda: TWO.position([[*np.zeros(TWO.joints), 3.0]]),
}


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("says", REFUSED)
def test_refused_in_one_sentence(says):
    with pytest.raises(aj.InputError, match=says):
        REFUSED[says]()


@pytest.mark.slow
def test_a_contact_without_its_other_pose_is_refused():
    capture = aj.simulate(TWO, {}, observations=[PLATE], seed=1)
    alone = aj.Capture({}, observations=capture.observations)
    seen, space = observed(alone, TWO)
    with pytest.raises(aj.InputError, match="socket 'plate/1', in which no tip was"):
        seen.start(space, np.asarray(space.vector()))
