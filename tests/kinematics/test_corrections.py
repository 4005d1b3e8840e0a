"""Joint corrections: their derivatives, what they mean, and calibrations that find them."""

import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.calibration.redrawn import truth_of
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.diagnostics.missing_terms import FoundTerm, MissingTerm, wider_model
from aacmm_jax.kinematics import parameter_names, with_corrections
from aacmm_jax.kinematics.arm import correction_names
from aacmm_jax.kinematics.beside import Readings
from aacmm_jax.kinematics.chain import KnownFunctions, forward_pass, joint_motion, joints_first
from aacmm_jax.kinematics.corrected_arm import function_values
from aacmm_jax.kinematics.corrections import terms_of
from aacmm_jax.kinematics.jacobian import reading_columns, rotation_columns

MODEL = "gravity,harmonics,gear,coupled,torque"


@pytest.fixture(scope="module")
def elbow() -> aj.Arm:
    """Three axes with Hayati's angles and coefficients of all kinds."""
    arm = aj.Arm(alpha=[1.5, 0.1, 0.4], a=[50.0, 300.0, 40.0], d=[200.0, 10.0, 250.0], beta=[0.0, 0.1, 0.2])
    arm = with_corrections(arm.replace(probe=(10, 20, 100)), MODEL)
    random = np.random.default_rng(1)
    return arm.replace(coefficients=1e-2 * random.normal(size=len(arm.coefficients)), gravity=(0.1, -0.2, -1.0))


@pytest.fixture(scope="module")
def scara() -> aj.Arm:
    """Two parallel axes and a prismatic joint, which corrections move along its axis."""
    arm = aj.Arm(alpha=[0.1, 0.2, 0.3], a=[300.0, 250.0, 20.0], d=[10.0, 0.0, 0.0], probe=(5, 6, 7), prismatic=(3,))
    names = ["cos1_1", "sin3_2", "gear_3", "coupled1_3", "compliance3_2", "compliance3_3", "cos1_3"]
    return with_corrections(arm, names).replace(
        coefficients=[0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07], gravity=(0.1, -0.9, 0.3)
    )


def warmed(arm: aj.Arm) -> aj.Arm:
    """With thermal expansion besides, ten times too large to be real."""
    names = [name for name in correction_names(arm) if not name.startswith("gravity_")]
    values = dict(coefficients=[*np.asarray(arm.coefficients), 2e-4], gravity=arm.gravity)
    return with_corrections(arm, [*names, "expansion"]).replace(**values)


def readings(arm: aj.Arm) -> np.ndarray:
    """Some, the last column a temperature where the arm has a thermometer."""
    random = np.random.default_rng(0)
    q = random.uniform(-2, 2, (4, arm.joints))
    return np.concatenate([q, random.uniform(10, 30, (4, arm.columns - arm.joints))], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("warm elbow", "warm scara")),
        *(pytest.param(name, marks=pytest.mark.exhaustive) for name in ("elbow", "scara")),
    ],
)
def test_derivatives_are_exact(name, request):
    arm = request.getfixturevalue(name.removeprefix("warm "))
    arm = warmed(arm) if name.startswith("warm") else arm
    q, names = readings(arm), parameter_names(arm)
    space = aj.Parameters(arm, names)
    analytic = np.asarray(arm.jacobian(q, (*names, *(f"q_{i}" for i in range(1, arm.joints + 1)))))
    vector = np.asarray(space.vector())
    poses = jax.jit(lambda values: space.arm(values).pose(q))  # two of each parameter
    for i in range(len(names)):
        step = 1e-5 * np.eye(len(names))[i]
        central = (poses(vector + step) - poses(vector - step))[:, :3, 3] / 2e-5
        np.testing.assert_allclose(analytic[..., i], central, atol=2e-6)
    for i in range(arm.joints):
        step = 1e-6 * np.eye(arm.columns)[i]
        central = (np.asarray(arm.position(q + step)) - arm.position(q - step)) / 2e-6
        np.testing.assert_allclose(analytic[..., len(names) + i], central, atol=1e-5)
    along = np.ones_like(q) * (np.arange(arm.columns) < arm.joints)
    moved = jax.jvp(lambda v, q: space.arm(v).position(q), (vector, q), (np.ones_like(vector), along))[1]
    np.testing.assert_allclose(moved, analytic.sum(-1), rtol=1e-10, atol=1e-9)
    turned = rotation_columns(forward_pass(*to_numpy((arm.geometry, joint_motion(arm.geometry, q)))), space.indices())
    for i, name in enumerate(names):
        if name in correction_names(arm):
            step = 1e-6 * np.eye(len(names))[i]
            pairs = [np.asarray(poses(vector + sign * step))[:, :3, :3] for sign in (1, -1)]
            spin = pairs[0] @ pairs[1].swapaxes(-1, -2) / 4e-6
            central = np.stack(
                [spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1]]
            )
            np.testing.assert_allclose(turned[i], central, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elbow", pytest.param("scara", marks=pytest.mark.slow)])
def test_all_lengths_grow_with_the_temperature(name, request):
    """2e-4 / K: at 25 C everything is 1.001 times as large, at 20 C and without a thermometer as it was."""
    warm = warmed(request.getfixturevalue(name))
    q = readings(warm)[:, : warm.joints]
    cold = np.asarray(warm.position(q))
    at_25 = np.concatenate([q, np.full((len(q), 1), 25.0)], axis=1)
    np.testing.assert_allclose(warm.position(at_25), 1.001 * cold, rtol=1e-12)
    np.testing.assert_allclose(np.asarray(warm.pose(at_25))[:, :3, :3], np.asarray(warm.pose(q))[:, :3, :3])
    at_20 = np.concatenate([q, np.full((len(q), 1), 20.0)], axis=1)
    np.testing.assert_array_equal(warm.position(at_20), cold)
    by_columns = jax.jacfwd(warm.position)(jax.numpy.asarray(at_25[0]))
    np.testing.assert_allclose(by_columns[:, -1], 2e-4 * cold[0], rtol=1e-9)


def test_an_arm_that_is_wider_than_the_readings():
    arm = with_corrections(aj.load_arm("panda"), "expansion")
    assert (arm.joints, arm.columns, arm.beside.possible) == (7, 8, ("thermometer",))
    assert not arm.replace(corrections=None, coefficients=None, gravity=None).beside.possible
    with pytest.raises(aj.InputError, match="the arm has 7 joints, and a thermometer"):
        arm.position(np.zeros(9))
    with pytest.raises(aj.InputError, match="an arm with thermometer=True"):
        aj.evaluate(aj.load_arm("panda"), aj.Capture({"A": np.zeros((2, 8)) + np.eye(2, 8)}))


def test_moment_of_gravity():
    """A pendulum: a weight of 2 kg, 300 mm from a horizontal axis, at 30 degrees from the horizontal."""
    arm = aj.Arm(alpha=[np.pi / 2, 0.0], a=[0.0, 400.0], d=[500.0, 0.0], limits=[(-3, 3)] * 2)
    q = np.array([[0.7, np.radians(30)]])
    moment = -2e-3 * 9.80665 * 0.3 * np.cos(np.radians(30))
    for gravity, expected in (((0, 0, -1), moment), ((0, 0, -3), moment)):
        loaded = with_corrections(arm, "gravity=masses", mass=[0, 2], centre=[(0, 0, 0), (-100, 0, 0)], gravity=gravity)
        assert correction_names(loaded)[:-3] == ("compliance_2",)  # the first axis is vertical
        (found,) = function_values(loaded, loaded.corrections.functions.terms, q)
        np.testing.assert_allclose(found, [expected], rtol=1e-12)
        yielded = loaded.replace(compliance_2=0.1)
        np.testing.assert_allclose(yielded.position(q), arm.position(q + np.array([0, 0.1 * expected])), rtol=1e-12)
    # Without this option masses count for nothing, and with it they are needed.
    unknown = with_corrections(arm, "gravity", mass=[0, 2], centre=[(0, 0, 0), (-100, 0, 0)])
    assert parameter_names(unknown) == parameter_names(with_corrections(arm, "gravity"))
    for model in ("gravity=masses", ["compliance_2"]):
        with pytest.raises(aj.InputError, match="needs the masses of the links"):
            with_corrections(arm, model)
    (found,) = function_values(unknown, unknown.corrections.functions.terms, q)
    np.testing.assert_allclose(found, -0.4 * np.cos(np.radians(30)), rtol=1e-12)


def test_no_poses_have_no_tips():
    # As the sockets of a capture that a tracker measured, in its report.
    arm = with_corrections(aj.load_arm("ur10"), "gravity,gear,harmonics=1")
    assert arm.position(np.zeros((0, 6))).shape == (0, 3)


def test_functions_of_the_readings():
    arm = aj.Arm(alpha=[0.3, 0.2, 0.1], a=[100.0, 200.0, 50.0], d=[10.0, 20.0, 30.0])
    q = readings(arm)
    for name, function in {
        "cos1_2": np.cos(q[:, 1]),
        "sin3_1": np.sin(3 * q[:, 0]),
        "gear_3": q[:, 2],
        "coupled2_3": q[:, 1],
    }.items():
        corrected = with_corrections(arm, [name]).replace(**{name: 1e-3})
        moved = q + 1e-3 * function[:, None] * (np.arange(1, 4) == int(name[-1]))
        np.testing.assert_allclose(corrected.position(q), arm.position(moved), atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [-1.0, 1.0])
def test_a_full_coupling_moves_the_frames_of_gravity_and_the_reading(elbow, factor):
    """Joint 3 of parallel links: its moments are those at the angle that it has, and moving joint 2 moves both."""
    plain = elbow.replace(corrections=None, coefficients=None, gravity=None, torques=False)
    names = ["coupled2_3", "compliance3_2", "compliance3_3"]
    coupled = with_corrections(plain, names).replace(coupled2_3=factor + 1e-3)
    q = readings(plain)
    angles = q + factor * q[:, 1:2] * (np.arange(3) == 2)
    rows = joint_motion(coupled.geometry, q).functions[1:]  # the first is the reading itself
    uncoupled = coupled.replace(coupled2_3=0.0)
    np.testing.assert_allclose(rows, joint_motion(uncoupled.geometry, angles).functions[1:], atol=1e-12)
    forward = forward_pass(coupled.geometry, joint_motion(coupled.geometry, q))
    columns = np.moveaxis(np.asarray(reading_columns(forward)), -1, 0)
    exact = np.swapaxes(coupled.jacobian(q, ["q_1", "q_2", "q_3"]), 1, 2)
    np.testing.assert_allclose(columns, exact, atol=1e-3 * 600)  # but for the small part
    np.testing.assert_allclose(
        np.asarray(forward.tip).T, plain.position(angles + 1e-3 * q[:, 1:2] * (np.arange(3) == 2)), atol=1e-9
    )


def test_ranges_of_orders():
    found = [term.name for term in terms_of("harmonics=2-3+1+3", 1)]
    assert found == ["cos1_1", "sin1_1", "cos2_1", "sin2_1", "cos3_1", "sin3_1"]
    assert terms_of("gear,functions", 2) == terms_of("gear,harmonics=1-31", 2)


@pytest.mark.slow
def test_the_nominal_arm_decides_the_functions(elbow):
    """A calibrated length changes no moment: what was calibrated is what is evaluated."""
    q, longer = readings(elbow), elbow.replace(d_3=400.0)
    before, after = (joint_motion(arm.geometry, q).functions for arm in (elbow, longer))
    np.testing.assert_array_equal(before, after)


@pytest.mark.first_rows(11)
@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        ("harmonic", "unknown model 'harmonic'; did you mean 'harmonics'"),
        ("gear,gear", "the model names 'gear' twice"),
        ("harmonics=0", "does not name orders from 1 to 99"),
        ("harmonics=3-1", "does not name orders from 1 to 99"),
        ("harmonics=1-100", "does not name orders from 1 to 99"),
        ("functions,harmonics=1", "the model names 'harmonics' twice"),
        ("gear=2", "gear takes no option"),
        ("expansion=2", "expansion takes no option"),
        (["expansion_1"], "applies to the whole arm, so its name must have no number"),
        (["cos1"], "must name a joint from 1 to 7"),
        ("gravity=mass", "gravity=mass is unknown; write gravity, or gravity=masses"),
        ("coupled=2", "does not name pairs of joints"),
        ("coupled=2-9", "must name a joint from 1 to 7"),
        (["cos1_9"], "must name a joint from 1 to 7"),
        (["compliance1_2"], "must name a link from 2 to 7"),
        (["d_3"], "'d_3' is not the name of a coefficient"),
    ],
)
def test_refused(model, sentence):
    with pytest.raises(aj.InputError, match=sentence):
        with_corrections(aj.load_arm("panda"), model)


def warm_capture(low: float, high: float) -> tuple[aj.Capture, aj.Bounds]:
    """120 poses of the paper's arm, which expands by 15 um/(m K), with the noise of its encoders."""
    nominal = with_corrections(aj.load_arm("cheng2018-simulation"), "expansion")
    sockets = {"A": (400, 200, 300), "B": (600, 200, 300), "C": (300, -400, 300)}
    options = dict(poses=40, lengths=[("A", "B", 0.001), ("B", "C", 0.001)], encoder_arcsec=2, temperature=(low, high))
    capture = aj.simulate(nominal.replace(expansion=15e-6), sockets, **options, seed=1)
    return capture, aj.Bounds.around(nominal, aj.Parameters.free_of(nominal))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"method": "joint"},
        {"method": "two-stage"},
        pytest.param({"prior": aj.Prior({"expansion": 1e-3})}, marks=pytest.mark.slow),
    ],
    ids=["joint", "two-stage", "least squares of everything"],
)
def test_expansion_is_found(options):
    capture, bounds = warm_capture(15, 25)
    result = aj.calibrate(bounds.space.base, capture, bounds, **options)
    i = bounds.space.index("expansion")
    u = np.sqrt(result.covariance[i, i])
    assert u < 5e-7
    assert abs(result.parameters[i] - 15e-6) < 3 * u


@pytest.mark.slow
def test_expansion_at_one_temperature_is_a_scale():
    """All lengths of the arm may be wrong by as much: the observability names them, and what would help."""
    capture, bounds = warm_capture(23, 23)
    seen = aj.observability(bounds.space.base, capture, bounds.space)
    assert seen.null.shape[1] == 1
    assert set(bounds.space.names[i] for i in np.argsort(-np.abs(seen.null[:, 0]))[:3]) == {"d_3", "d_5", "expansion"}
    assert seen.remedy == "Poses in the same sockets at other temperatures would determine these parameters."


@pytest.mark.slow
def test_redrawn_readings_keep_their_temperature():
    capture, bounds = warm_capture(15, 25)
    result = aj.calibrate(bounds.space.base, capture, bounds)
    noise, random = aj.Noise(encoder_arcsec=2, seating=0.005), np.random.default_rng(0)
    drawn = np.asarray(truth_of(result, capture).drawn(2, noise, random)[0].q)
    np.testing.assert_array_equal(drawn[..., 6], np.broadcast_to(capture.q[:, 6], (2, 120)))
    assert np.all(np.ptp(drawn[..., :6], axis=0) > 0)


@pytest.mark.slow
def test_an_arm_that_expands_is_noticed():
    capture, bounds = warm_capture(15, 25)
    plain = with_corrections(bounds.space.base, "dh")
    result = aj.calibrate(plain, capture, aj.Bounds.around(plain, aj.Parameters.free_of(plain)))
    (sentence,) = [one for one in aj.warnings_of(result, capture) if "Residuals follow" in one]
    assert "Residuals follow temperature" in sentence
    assert "try --model dh,expansion" in sentence


def eccentric() -> tuple[aj.Capture, aj.Bounds, np.ndarray]:
    """280 poses without noise of a Panda with eccentric encoders and errors of its gears."""
    arm = with_corrections(aj.load_arm("panda"), "harmonics=1,gear")
    space = aj.Parameters.independent(arm)
    true = space.arm(space.vector() + 0.3 * space.scale * np.random.default_rng(0).normal(size=len(space.names)))
    sockets = {f"s{i}": p for i, p in enumerate([(450, 100, 200), (300, -350, 400), (500, 250, 500), (350, 0, 650)])}
    capture = aj.simulate(true, sockets, poses=70, lengths=[("s0", "s1"), ("s2", "s3")])
    return capture, aj.Bounds.around(arm, space), np.asarray(space.vector(true))


@pytest.mark.slow
def test_found_by_a_calibration():
    capture, bounds, true = eccentric()
    assert {"cos1_1", "sin1_4", "gear_2"} <= set(bounds.space.names)
    result = aj.calibrate(bounds.space.base, capture, bounds, method="joint")
    np.testing.assert_allclose(result.parameters, true, atol=1e-7)


@pytest.mark.slow
def test_batches_of_corrected_arms(paper_arm):
    """As results of many have them, the nominal arms of their functions batched too; under vmap as well."""
    names = ["cos1_2", "gear_3", "compliance4_3", "compliance3_2"]
    single = with_corrections(paper_arm, names)
    arms = [single.replace(cos1_2=1e-3 * i, compliance4_3=2e-3 * i, d_3=400.0 + i) for i in range(3)]
    batch = jax.tree.map(lambda *leaves: np.stack(leaves), *arms)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    expected = np.stack([arm.position(q) for arm in arms])
    np.testing.assert_allclose(np.moveaxis(batch.position(q[:, None, :]), 1, 0), expected, atol=1e-9)
    np.testing.assert_allclose(batch.position(q[:3]), expected[np.arange(3), np.arange(3)], atol=1e-9)
    np.testing.assert_allclose(jax.vmap(lambda arm: arm.position(q))(batch), expected, atol=1e-9)


@pytest.mark.exhaustive
def test_expansion_is_found_by_a_batch():
    capture, bounds = warm_capture(15, 25)
    one = aj.calibrate(bounds.space.base, capture, bounds, method="joint")
    many = aj.calibrate_many(bounds.space.base, aj.stack_captures([capture] * 2), bounds, method="joint")
    np.testing.assert_allclose(many.parameters, np.stack([one.parameters] * 2), atol=1e-6)


@pytest.mark.slow
def test_found_by_a_batch():
    capture, bounds, true = eccentric()
    many = aj.calibrate_many(bounds.space.base, aj.stack_captures([capture] * 2), bounds, method="joint")
    np.testing.assert_allclose(many.parameters, np.stack([true] * 2), atol=1e-5)


def test_functions_together_are_those_one_by_one():
    """Kinds are evaluated together, also where the names of a file mix them; harmonics by addition of angles."""
    arm = to_numpy(aj.load_arm("ur10"))
    names = ["cos1_1", "compliance3_2", "sin3_2", "gear_3", "sin99_5", "compliance2_2", "cos31_5", "coupled2_3"]
    q = np.random.default_rng(0).uniform(-6, 6, (50, 6))
    each = with_corrections(arm, names).corrections.functions.terms
    rows, forward = joints_first(q, 1), forward_pass(arm.geometry, joint_motion(arm.geometry, q))
    together, alone = KnownFunctions(each), [KnownFunctions((one,)) for one in each]
    assert together.names == tuple(names)
    values = together.values(Readings(rows), forward)
    np.testing.assert_array_equal(values, np.concatenate([one.values(Readings(rows), forward) for one in alone]))
    for term, row in (
        (0, np.cos(q[:, 0])),
        (2, np.sin(3 * q[:, 1])),
        (4, np.sin(99 * q[:, 4])),
        (6, np.cos(31 * q[:, 4])),
    ):
        np.testing.assert_allclose(values[together.first_row[term], 0], row, atol=1e-12)


@pytest.mark.parametrize(
    ("model", "found", "advised"),
    [
        ("dh", ("gear ratio", "gravity"), "dh,gear,gravity"),
        ("dh,gear", ("gravity",), "dh,gear,gravity"),
        ("dh,gear,gravity", ("gear ratio",), ""),
    ],
)
def test_a_model_that_the_arm_has_is_not_advised(model, found, advised):
    arm = with_corrections(aj.load_arm("panda"), model)
    term = MissingTerm("", 2, np.ones((1, 1)))
    terms = tuple(FoundTerm(kind, 2, *[None] * (len(FoundTerm._fields) - 3), term) for kind in found)
    assert set(wider_model(terms, arm).split(",")) == set(advised.split(","))
