"""A new kind of observation is one class: this one, with two rows a pose, goes the whole way without being known."""

import numpy as np
import pytest
from jaxtyping import Float

import aacmm_jax as aj
from aacmm_jax.core.linear_algebra import products_by_column, semidefinite_eigen
from aacmm_jax.core.numpy_or_jax import AnyArray, namespace, to_numpy
from aacmm_jax.core.rotations import cross, rotation_and_derivative, rotation_matrix
from aacmm_jax.data.observations.declared import Part, declared
from aacmm_jax.data.observations.geometry import turned_z, variances
from aacmm_jax.data.observations.observation import AbstractObservation, Rows
from aacmm_jax.data.observations.simulated import OTHER_KINDS, AbstractSimulated, kinds
from aacmm_jax.summaries.observations import capture_observations

from .test_observations import TIPS, Q, check_derivatives, columns

NOISE = aj.Noise(encoder_arcsec=2.0, seating=0.005)


class Wire(AbstractObservation):
    """Poses with the tip on a taut wire: across it, in two directions, its distance is 0."""

    kind, table, noun, row_units = "wire", "wire", "wire", ("mm", "mm")
    sag: Float[AnyArray, ""] = declared("standard deviation of the wire about its line", "mm", default=0.0)
    # As the axis of a cylinder: the turn of z to its direction, and where it meets the plane across it.
    line = Part("line of {name}", "rad", "rad", "mm", "mm")

    def start(self, tips, offset):
        xp = namespace(tips)
        middle = xp.mean(tips.position, axis=1, keepdims=True)
        centred = tips.position - middle
        _, axes = semidefinite_eigen(centred @ centred.T)
        direction = axes[:, 0] / xp.sqrt(xp.sum(axes[:, 0] ** 2))
        turn = turned_z(xp.where(direction[2] < 0, -direction, direction))
        across = rotation_matrix(xp.concatenate([turn, xp.zeros(1)]))[:, :2]
        return {self.line: xp.concatenate([turn, (across.T @ middle)[:, 0]])}

    def residual(self, tips, unknowns):
        xp, line, m = namespace(tips, unknowns), unknowns[self.line], self.q.shape[0]
        rotation, axes = rotation_and_derivative(xp.concatenate([line[:2], xp.zeros_like(line[:1])]))
        across = rotation[:, :2].swapaxes(0, 1)  # (2, 3, p)
        # A small rotation v turns the direction e by v x e, so that e.t changes by v.(e x t).
        moments = [cross(xp.broadcast_to(e, (3, m)), tips.position) for e in across]
        by_turn = [xp.stack([xp.sum(axes[:, k] * moment, axis=0) for moment in moments]) for k in range(2)]
        by_place = -xp.broadcast_to(xp.asarray(np.eye(2))[:, :, None], (2, 2, m))
        return Rows(
            values=products_by_column(across, tips.position) - line[2:],
            by_tip=xp.broadcast_to(across, (2, 3, m)),
            by_unknowns={self.line: xp.concatenate([xp.stack(by_turn), by_place])},
            measured=variances(self.sag, m) * xp.asarray(np.eye(2)),
        )


class SimulatedWire(AbstractSimulated):
    """Poses at random places of a wire between two ends."""

    table = "wire"
    ends: Float[np.ndarray, "2 3"] = declared("both ends in the base frame", "mm", moves="point")
    poses: int = declared("number of poses")

    def tips(self, random):
        return self.ends[0] + random.uniform(size=(self.poses, 1)) * (self.ends[1] - self.ends[0])

    def recorded(self, q, transforms, random):
        return Wire(self.name, q, sag=0.01)


@pytest.fixture(autouse=True)
def known():
    OTHER_KINDS.extend([Wire, SimulatedWire])
    yield
    del OTHER_KINDS[-2:]


WIRES = [
    SimulatedWire("first", [[300, -300, 100], [600, 300, 400]], 20),
    SimulatedWire("second", [[300, 300, 100], [700, 0, 600]], 20),
    SimulatedWire("third", [[-300, 400, 200], [300, 500, 300]], 20),
]


@pytest.fixture(scope="module")
def capture(paper_arm):
    places = {"A": (400, 200, 300), "B": (600, -200, 300), "C": (300, -300, 500)}
    return aj.simulate(paper_arm, places, poses=20, lengths=[("A", "B", 0.002)], observations=WIRES, noise=NOISE)


def test_its_declaration_makes_constructor_checks_and_names():
    assert str(Wire.__signature__) == "(name: 'str', q: 'Numbers', *, sag: 'Numbers' = 0.0, target: 'str' = '')"
    wire = Wire("w", Q)
    assert wire.unknowns == {"line of w": ("rad", "rad", "mm", "mm")}
    assert (wire.by_pose, wire.stated, wire.alike is not None) == (("q",), ("sag",), True)
    with pytest.raises(aj.InputError, match="sag of wire 'w' is -1; it must be zero or positive"):
        Wire("w", Q, sag=-1)
    with pytest.raises(TypeError, match="unexpected keyword argument 'sagg'"):
        Wire("w", Q, sagg=1)
    with pytest.raises(AttributeError, match="cannot assign to field 'sag'"):
        wire.sag = 1.0


def test_its_derivatives_are_exact():
    wire = to_numpy(Wire("w", Q, sag=0.1))
    check_derivatives(wire, columns(wire.start(TIPS, np.zeros(3))))


def test_a_calibration_finds_it(paper_arm, capture):
    """With the arm, from its start; the wire's line within four standard uncertainties of the true one."""
    bounds = aj.Bounds.around(paper_arm, aj.Parameters.free_of(paper_arm), length=5.0, angle=0.01)
    result = aj.calibrate(paper_arm, capture, bounds, method="joint", undetermined="ignore")
    assert bool(result.converged)
    observed, line = result.observed, "line of first"
    true = capture.observations[0].start(TIPS._replace(position=WIRES[0].ends.T), np.zeros(3))[line]
    u = np.sqrt(np.diag(observed.geometry_covariance[line]))
    assert np.all(np.abs(observed.geometry[line] - true) < 4 * u)
    assert float(result.observed.reduced_chi_of_all) < 1.5


def test_files_and_summaries_have_it(paper_arm, capture, tmp_path):
    assert "wire" in kinds()
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(capture, specification))
    again = aj.files.load_capture(tmp_path / "c.h5").capture.observations
    assert [type(one) for one in again] == [Wire] * 3
    np.testing.assert_array_equal(again[1].q, capture.observations[1].q)
    row = capture_observations(capture)[0]
    assert (row["kind"], row["poses"], row["unknowns"]) == ("wire", 20, ["line of first"])
    (stated,) = row["stated"]
    assert (stated["quantity"], stated["values"]) == ("standard deviation of the wire about its line", [0.01])


@pytest.mark.slow
def test_plans_place_it(paper_arm):
    turn = np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 50.0])
    moved = WIRES[0].placed("elsewhere", turn)
    np.testing.assert_allclose(moved.ends, [[300, 300, 150], [-300, 600, 450]], atol=1e-9)
    item = aj.planning.KitItem(WIRES[1], places=0)
    planned = aj.planning.plan_kit(
        paper_arm, [item, aj.data.observations.SimulatedSphere("ball", (400, 0, 300), 50.0, 9, u=0.001)],
        space=aj.Parameters(paper_arm, ("a_2", "d_4", "theta_3")), poses=14, candidates=120, seed=1,
    )  # fmt: skip
    assert [one.kind for one in planned.observations] == ["wire", "sphere"]
