"""Calibrations from observations of every kind: what they recover, with what uncertainty, and how they agree."""

import equinox as eqx
import jax
import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data import observations as kinds
from aacmm_jax.summaries.calibration import calibration_summary

NOISE = aj.Noise(encoder_arcsec=2, seating=0.005)
BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 0.3, 1000.0, 2000.0, -300.0)
SLOW = pytest.mark.slow
BAR = {"a": (0, 0, 0), "b": (300, 0, 0)}
PLATE = {f"{i}{j}": (150.0 * i, 150.0 * j, 0.0) for i in range(3) for j in range(3)}
PLACEMENTS = [(0, 0, 0, 300, 0, 200), (0, 0, 1.5, 300, -200, 250), (0, 1.5, 0, 400, 100, 500)]
CENTRES = [(300, 0, 300), (500, 200, 200), (300, -300, 150)]
SIMULATED = {
    "points": [kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01)],
    "spheres": [kinds.SimulatedSphere(f"s{i}", centre, 50.0, 25, u=0.001) for i, centre in enumerate(CENTRES)],
    "cylinders": [
        kinds.SimulatedCylinder("ring", [(300, 0, 300), (330, 40, 330)], 80.0, 30, u=0.001, stylus=6.0, inside=True),
        kinds.SimulatedCylinder("pin", [(500, 200, 150), (500, 200, 250)], 40.0, 30, u=0.001, stylus=6.0),
        kinds.SimulatedCylinder("bar", [(250, -300, 200), (400, -300, 220)], 50.0, 30, certified=False),
    ],
    "planes": [
        kinds.SimulatedPlanes("pair", (200, -200, 100), [(300, 0, 0), (0, 400, 0)], 30, distance=150.0, u=0.001),
        kinds.SimulatedPlanes("wall", (300, -200, 100), [(0, 300, 0), (0, 0, 400)], 30),
    ],
    "bars": [
        kinds.SimulatedArtefact(f"bar{i}", BAR, 10, frame, u=0.001, artefact="bar")
        for i, frame in enumerate(PLACEMENTS)
    ],
    "plate": [kinds.SimulatedArtefact("plate", PLATE, 8, (0, 0, 0.3, 250, -150, 200), u=0.001)],
    "distances": [
        kinds.SimulatedDistances("d", BOX, 60, (900, 300, 100), u=0.003),
        kinds.SimulatedDistances("e", BOX, 60, (100, 700, 100), u=0.003),
    ],
}


@pytest.fixture(scope="module")
def space(paper_arm):
    return aj.Parameters.independent(paper_arm)


@pytest.fixture(scope="module")
def bounds(paper_arm, space):
    return aj.Bounds.around(paper_arm, space)


@pytest.fixture(scope="module")
def true(space):
    return aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=1)


@pytest.fixture(scope="module")
def sockets(true):
    points = {"A": (400, 200, 300), "B": (500, 300, 100), "C": (300, -300, 300)}
    return aj.simulate(true, points, poses=30, lengths=[("A", "B", 0.001)], noise=NOISE)


def u_of(result):
    return np.sqrt(np.diag(result.covariance))


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("kind", "noise"),
    [
        *(pytest.param(kind, NOISE, id=f"{kind}-given") for kind in SIMULATED),
        *(
            pytest.param(kind, None, id=f"{kind}-estimated", marks=() if kind in ("points", "planes") else SLOW)
            for kind in SIMULATED
        ),
    ],
)
def test_recovers_the_truth(paper_arm, true, space, bounds, kind, noise):
    """From a nominal arm 1 mm and 0.1 degrees off, and without a word of where anything stands."""
    capture = aj.simulate(true, {}, observations=SIMULATED[kind], noise=NOISE, seed=3)
    result = aj.calibrate(paper_arm, capture, bounds, noise=noise)
    assert result.converged
    assert result.method == "joint"
    assert np.all(result.determined)
    assert not result.active_names()
    normalised = (np.asarray(result.parameters) - np.asarray(space.vector(true))) / u_of(result)
    assert np.abs(normalised).max() < 4.5
    assert 0.3 < np.mean(normalised**2) < 2.5
    assert float(result.observed.reduced_chi_of_all) == pytest.approx(1.0, abs=0.12)
    if noise is None:
        scatter = float(result.noise.encoder_arcsec) / 2, float(result.noise.seating) / 0.005
        assert 0 <= min(scatter) <= max(scatter) < 2


@pytest.mark.slow
def test_a_target_and_its_station_are_found(paper_arm, true, bounds):
    """Both frames are unknown: the tracker's, and the reflector's place in the last frame."""
    arm = paper_arm
    names = tuple(n for n in bounds.space.names if n not in ("probe_z", "alpha_6", "theta_6", "a_6", "d_6"))
    space = aj.Parameters(arm, names)
    simulated = [
        kinds.SimulatedPoints("T", BOX, 60, FRAME, u=0.01, target="smr", place=(60, 20, 80)),
        kinds.SimulatedTransforms("T6", BOX, 40, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u=0.01, u_angle=1e-4),
    ]
    other = aj.perturbed_arm(space, length=1.0, angle=np.deg2rad(0.1), seed=2)
    capture = aj.simulate(other, {}, observations=simulated, noise=NOISE, seed=3)
    result = aj.calibrate(arm, capture, aj.Bounds.around(arm, space), noise=NOISE)
    assert result.converged
    geometry = result.observed.geometry
    np.testing.assert_allclose(geometry["offset of smr"], (60, 20, 80), atol=1.5)
    np.testing.assert_allclose(geometry["offset of T6"], (10, 20, 80), atol=1.5)
    np.testing.assert_allclose(geometry["orientation of T6"], (0.1, 0.2, 0.3), atol=1e-3)
    np.testing.assert_allclose(geometry["frame of T"], FRAME, atol=0.5)
    assert float(result.observed.reduced_chi_of_all) == pytest.approx(1.0, abs=0.12)


def test_a_socket_is_a_socket_however_it_is_written(paper_arm, bounds, sockets):
    """As an artefact of one point, points of one unknown frame; and with its position eliminated,
    which is code of its own."""
    q = sockets.sockets["C"]
    others = {name: sockets.sockets[name] for name in ("A", "B")}
    written = {
        "socket": kinds.Socket("C", q),
        "artefact": kinds.Artefact("C", {"point": (0, 0, 0)}, {"point": q}),
        "points": kinds.MeasuredPoints("C", q, np.zeros((len(q), 3))),
    }
    eliminated = aj.calibrate(paper_arm, sockets, bounds, method="joint", noise=NOISE)
    scale = np.asarray(bounds.space.scale)
    for what, observation in written.items():
        result = aj.calibrate(paper_arm, aj.Capture(others, sockets.lengths, [observation]), bounds, noise=NOISE)
        assert np.abs((result.parameters - eliminated.parameters) / scale).max() < 1e-7, what
        np.testing.assert_allclose(u_of(result), u_of(eliminated), rtol=1e-6)
        if what == "socket":
            first = result
        assert np.abs((result.parameters - first.parameters) / scale).max() < 1e-9, what


@pytest.mark.slow
def test_estimated_noise_agrees_with_the_eliminated_sockets(paper_arm, bounds, sockets):
    classic = aj.calibrate(paper_arm, sockets, bounds, method="joint")
    others = {name: sockets.sockets[name] for name in ("A", "B")}
    written = aj.Capture(others, sockets.lengths, [kinds.Socket("C", sockets.sockets["C"])])
    explicit = aj.calibrate(paper_arm, written, bounds)
    np.testing.assert_allclose(explicit.noise.encoder_arcsec, classic.noise.encoder_arcsec, rtol=1e-3)
    np.testing.assert_allclose(explicit.noise.seating, classic.noise.seating, rtol=1e-3)
    np.testing.assert_allclose(u_of(explicit), u_of(classic), rtol=1e-3)


@pytest.mark.slow
def test_a_bar_may_have_its_points_on_one_line(paper_arm, true, space, bounds):
    """A ball step turned about its line is the same: what is open there is of no consequence for the arm."""
    step = {name: (x, 0.0, 0.0) for name, x in {"a": 0.0, "b": 120.0, "c": 300.0}.items()}
    simulated = [kinds.SimulatedArtefact(f"s{i}", step, 8, frame) for i, frame in enumerate(PLACEMENTS)]
    capture = aj.simulate(true, {}, observations=simulated, noise=NOISE, seed=5)
    result = aj.calibrate(paper_arm, capture, bounds, noise=NOISE)
    assert result.converged
    assert np.all(result.determined)
    normalised = (np.asarray(result.parameters) - np.asarray(space.vector(true))) / u_of(result)
    assert np.abs(normalised).max() < 4.5
    assert 0.3 < np.mean(normalised**2) < 2.5


@pytest.mark.slow
def test_a_platform_shares_its_frames(paper_arm, true, bounds):
    """One bar in two placements on a platform with three indices has five unknown frames, up to that of the platform
    itself, where six placements alone have six: its uncertainty is smaller."""
    indices = [(0, 0, 0, 300, 0, 200), (0, 0, 1.2, 350, 100, 200), (0, 0, 2.4, 250, -100, 200)]
    simulated = []
    for i, outer in enumerate(indices):
        for k, inner in enumerate([(0.3, 0, 0, 0, 0, 0), (0, 0.8, 0, 60, 20, 150)]):
            frame = _composed(outer, inner)
            simulated.append((f"{i}{k}", frame, f"on platform {k}", str(i)))
    u = []
    for indexed in (True, False):
        observations = [
            kinds.SimulatedArtefact(
                name, BAR, 10, frame, placement=place if indexed else None, index=index if indexed else None
            )
            for name, frame, place, index in simulated
        ]
        capture = aj.simulate(true, {}, observations=observations, noise=NOISE, seed=4)
        result = aj.calibrate(paper_arm, capture, bounds, noise=NOISE)
        assert result.converged
        assert float(result.observed.reduced_chi_of_all) == pytest.approx(1.0, abs=0.15)
        u.append(u_of(result))
    assert np.all(u[0] <= u[1] * (1 + 1e-6))
    assert np.max(u[1] / u[0]) > 1.02


def _composed(outer, inner):
    from aacmm_jax.core.rotations import rotation_matrix, rotation_vector

    outer, inner = np.asarray(outer, float), np.asarray(inner, float)
    first = rotation_matrix(outer[:3])
    return (*rotation_vector(first @ rotation_matrix(inner[:3])), *(first @ inner[3:] + outer[3:]))


@pytest.mark.slow
@pytest.mark.parametrize("robust", [*(pytest.param(x, marks=pytest.mark.slow) for x in ("huber", "cauchy")), "tukey"])
def test_a_robust_loss_withstands_bad_poses(paper_arm, true, space, bounds, sockets, robust):
    """One pose in ten is 1 degree off in one joint: least squares is far off, a robust loss is not."""
    bad = np.random.default_rng(0).random(sockets.q.shape[0]) < 0.1
    shifted = eqx.tree_at(lambda c: c.q, sockets, np.asarray(sockets.q) + np.deg2rad(1.0) * np.outer(bad, np.eye(6)[2]))
    truth, u = np.asarray(space.vector(true)), u_of(aj.calibrate(paper_arm, sockets, bounds, method="joint"))
    plain = aj.calibrate(paper_arm, shifted, bounds, method="joint")
    result = aj.calibrate(paper_arm, shifted, bounds, robust=robust)
    assert result.converged
    error, before = (np.abs(np.asarray(r.parameters) - truth) / u for r in (result, plain))
    assert np.sqrt(np.mean(error**2)) < 3 < np.sqrt(np.mean(before**2)) / 3
    weights = np.concatenate([np.asarray(weight) for weight in result.observed.weights])
    assert weights[bad].max() < 0.2 < np.median(weights[~bad])


@pytest.mark.slow
def test_robust_without_outliers_is_nearly_least_squares(paper_arm, bounds, sockets):
    plain = aj.calibrate(paper_arm, sockets, bounds, method="joint", noise=NOISE)
    for robust in ("huber", "tukey"):
        result = aj.calibrate(paper_arm, sockets, bounds, robust=robust, noise=NOISE)
        assert np.abs((np.asarray(result.parameters) - np.asarray(plain.parameters)) / u_of(plain)).max() < 1.0
        np.testing.assert_allclose(u_of(result), u_of(plain), rtol=0.25)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robust", "seed"),
    [
        ("huber", 0),
        *(pytest.param("huber", seed, marks=SLOW) for seed in range(1, 5)),
        pytest.param("tukey", 0, marks=SLOW),
    ],
)
def test_noise_is_estimated_without_its_outliers(paper_arm, true, space, bounds, robust, seed):
    """Two of 200 tracker points are bad, one by far: the noise, u and the errors in units of u are as without them."""
    simulated = [kinds.SimulatedPoints("T", BOX, 200, FRAME, u=0.01)]
    noise = aj.Noise(encoder_arcsec=10, seating=0.005)
    good = aj.simulate(true, {}, observations=simulated, noise=noise, seed=seed)
    points = np.array(good.observations[0].points)
    points[[5, 100]] += [[3.0, -2.0, 1.0], [0.1, 0.0, -0.1]]
    bad = eqx.tree_at(lambda c: c.observations[0].points, good, points)
    plain, clean, shifted = (
        aj.calibrate(paper_arm, capture, bounds, robust=loss, undetermined="ignore")
        for capture, loss in ((good, None), (good, robust), (bad, robust))
    )
    assert float(shifted.noise.encoder_arcsec) == pytest.approx(float(clean.noise.encoder_arcsec), rel=0.15)
    assert float(clean.noise.encoder_arcsec) == pytest.approx(10, rel=0.15)
    np.testing.assert_allclose(u_of(shifted), u_of(clean), rtol=0.15)
    assert np.median(u_of(clean) / u_of(plain)) == pytest.approx(1.0, abs=0.05)
    errors = (np.asarray(shifted.parameters) - np.asarray(space.vector(true))) / u_of(shifted)
    assert 0.3 < np.mean(errors**2) < 2.5


@pytest.mark.slow
def test_sessions_with_a_remounted_probe(paper_arm, true, space, bounds, sockets):
    """Two sessions of one arm, the probe 0.3 mm elsewhere in the second: one probe for both does not fit."""
    remounted = true.replace(probe=np.asarray(true.probe) + np.array([0.3, -0.2, 0.1]))
    points = {"D": (350, 100, 400), "E": (500, -200, 200)}
    second = aj.simulate(remounted, points, poses=30, lengths=[("D", "E", 0.001)], noise=NOISE, seed=7)
    captures = {"first": sockets, "second": second}
    result = aj.calibrate(paper_arm, aj.join_sessions(captures), bounds, noise=NOISE)
    assert result.converged
    assert float(result.observed.reduced_chi_of_all) == pytest.approx(1.0, abs=0.1)
    moved = np.asarray(result.observed.geometry["offset of probe of second"])
    np.testing.assert_allclose(moved, remounted.probe, atol=0.02)
    together = aj.calibrate(paper_arm, aj.join_sessions(captures, own_probe=False), bounds, method="joint", noise=NOISE)
    assert float(together.stage1.reduced_chi) > 5


@pytest.mark.slow
def test_stage_1_of_spheres_of_unknown_size_keeps_an_anchor(paper_arm, true, space, bounds):
    simulated = [kinds.SimulatedSphere(f"s{i}", c, 50.0, 25, certified=False) for i, c in enumerate(CENTRES)]
    capture = aj.simulate(true, {}, observations=simulated, noise=NOISE, seed=3)
    with pytest.raises(aj.InputError, match="no reference length"):
        aj.calibrate(paper_arm, capture, bounds)
    found = aj.identify(paper_arm, capture, bounds, noise=NOISE)
    assert found.converged
    assert found.hold is not None
    anchor = space.names.index(found.hold)
    assert u_of(found)[anchor] == 0
    assert float(found.parameters[anchor]) == float(space.vector()[anchor])


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("observation", "message"),
    [
        (lambda q: kinds.MeasuredPoints("T", q, np.outer(np.arange(len(q)), [1.0, 2.0, 3.0])), "on one line"),
        (lambda q: kinds.MeasuredPoints("T", q[:2], np.eye(3)[:2]), "needs at least three"),
        (lambda q: kinds.Sphere("s", q[:3]), "4 unknowns"),
        (lambda q: kinds.Distances("d", q[:3], np.ones(3)), "needs at least four"),
        (lambda q: kinds.Sphere("s", q[:5], diameter=50), "give 5 equations"),
    ],
)
def test_what_cannot_be_determined_is_refused(paper_arm, bounds, observation, message):
    q = np.random.default_rng(0).uniform(-1, 1, (30, 6))
    fixing = kinds.SimulatedSphere("other", (400, 0, 300), 50.0, 4)
    observations = [observation(q), *aj.simulate(paper_arm, {}, observations=[fixing]).observations]
    with pytest.raises(aj.InputError, match=message):
        aj.calibrate(paper_arm, aj.Capture({}, [], observations[: 1 if "equations" in message else 2]), bounds)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("kind", "field"),
    [
        ("points", "points"),
        ("spheres", "diameter"),
        ("planes", "distance"),
        ("bars", "coordinates"),
        ("distances", "values"),
    ],
)
def test_derivatives_of_a_calibration(paper_arm, true, bounds, kind, field):
    """By readings and by what was measured, against central differences of whole calibrations whose weights come from
    the data."""
    capture = aj.simulate(true, {}, observations=SIMULATED[kind], noise=NOISE, seed=3)
    first, random = capture.observations[0], np.random.default_rng(0)
    shift = {"q": 1e-3 * random.normal(size=first.q.shape), field: random.normal(size=getattr(first, field).shape)}

    def run(size):
        changed = [getattr(first, leaf) + size * direction for leaf, direction in shift.items()]
        moved = eqx.tree_at(lambda o: [getattr(o, leaf) for leaf in shift], first, changed)
        return aj.calibrate(paper_arm, eqx.tree_at(lambda c: c.observations[0], capture, moved), bounds).parameters

    numerical = (np.asarray(run(1e-3)) - np.asarray(run(-1e-3))) / 2e-3
    exact = jax.jvp(run, (0.0,), (1.0,))[1]
    np.testing.assert_allclose(exact, numerical, atol=2e-5 * np.abs(numerical).max())


def test_what_does_not_know_observations_says_so(paper_arm, bounds, sockets):
    """Nothing is left out without a word."""
    capture = aj.Capture(sockets.sockets, sockets.lengths, [kinds.Socket("D", sockets.sockets["C"] + 0.1)])
    for function in (lambda: aj.fix_scale(paper_arm, capture),):
        with pytest.raises(aj.InputError, match=r"other observations \(D\)"):
            function()


@pytest.mark.slow
def test_known_coordinates_register_the_base(paper_arm, true, bounds):
    """The base in the frame of a plant, with an uncertainty that holds; the plant's coordinates fix the scale."""
    plant = {"a": (0, 0, 0), "b": (400, 0, 0), "c": (0, 400, 50), "d": (300, 300, 200)}
    frame = np.array([0, 0, 0.3, 250, -150, 200])
    simulated = kinds.SimulatedArtefact("plant", plant, 15, frame, u=0.001)
    capture = aj.simulate(true, {}, observations=[simulated], noise=NOISE, seed=0)
    specification = aj.kinematics.ArmSpecification(paper_arm, "test")
    result = aj.calibrate(paper_arm, capture, bounds, undetermined="ignore")
    record = aj.calibration.record_of(result, aj.Recording(capture, specification))
    (base,) = calibration_summary(record)["base"]
    expected = -rotation_matrix(frame[:3]).T @ frame[3:]
    assert base["in"] == "placement plant"
    error = (np.array(base["position_mm"]) - expected) / base["position_u_mm"]
    assert np.abs(error).max() < 4
    assert np.abs((np.array(base["rotation_rad"]) + frame[:3]) / base["rotation_u_rad"]).max() < 4
    assert 1e-4 < max(base["position_u_mm"]) < 0.01


@pytest.mark.slow
def test_nothing_but_the_frames_of_a_target_is_free():
    """As by ``calibrate --arm-fixed``: the private and shared geometry is found, and the arm stays as it is."""
    arm = aj.load_arm("ur10")
    box, mount = [[-600, 300, 200], [600, 700, 600]], (10.0, 20.0, 80.0, 0.1, 0.2, 0.3)
    target = kinds.SimulatedTransforms("T6", box, 60, mount, (0, 0, 0.4, 900.0, -100.0, 300.0), u=0.01, u_angle=1e-4)
    capture = aj.simulate(arm, {}, observations=[target], noise=aj.Noise(encoder_arcsec=0.0, seating=0.0), seed=1)
    bounds = aj.Bounds(aj.Parameters(arm, ()), np.zeros(0), np.zeros(0))
    geometry = aj.calibrate(arm, capture, bounds).observed.geometry
    np.testing.assert_allclose(geometry["offset of T6"], mount[:3], atol=0.02)
