"""Every kind of observation: derivatives of its residuals, its start, and what it refuses."""

import doctest

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data import observations as kinds
from aacmm_jax.data.cameras.camera import camera_models
from aacmm_jax.data.observations.geometry import distances_from_axis, fitted_cylinder, placed
from aacmm_jax.data.observations.held import platform_frames
from aacmm_jax.data.observations.observation import (
    AbstractObservation,
    Tips,
    certified_quantities,
    stated_quantities,
)
from aacmm_jax.data.observations.simulated import AbstractSimulated
from aacmm_jax.data.observations.simulated import kinds as known_kinds

RANDOM = np.random.default_rng(1)
POSES = 12
Q = RANDOM.normal(size=(POSES, 6))
AXES = Rotation.random(POSES, random_state=1).as_matrix()
TIPS = Tips(RANDOM.normal(size=(3, POSES)) * 300, tuple(AXES[:, :, i].T for i in range(3)))
STATION, ORIGIN = Rotation.from_rotvec([0.3, -1.0, 2.0]), np.array([100.0, 200.0, -50.0])
POINTS = STATION.inv().apply(TIPS.position.T - ORIGIN) + RANDOM.normal(size=(POSES, 3))
TURNED = STATION.inv() * Rotation.from_matrix(AXES) * Rotation.from_rotvec([0.5, 0.2, -0.7])
MEASURED = (TURNED * Rotation.from_rotvec(0.01 * RANDOM.normal(size=(POSES, 3)))).as_matrix()
CORNERS = {"a": [0, 0, 0], "b": [100, 0, 0], "c": [3, 4, 100]}
IN_CORNERS = {"a": Q[:4], "b": Q[4:8], "c": Q[8:]}

# Points before the cameras, which the target has elsewhere in every pose; a camera with focal lengths of about 1 px.
BEFORE = RANDOM.uniform([-200, -200, 400], [200, 200, 900], (POSES, 6, 3))
MOUNT = AXES @ Rotation.from_rotvec([0.5, 0.2, -0.7]).as_matrix()
IN_SPACE = {
    True: STATION.inv().apply((TIPS.position.T[:, None] + BEFORE @ MOUNT.swapaxes(1, 2) - ORIGIN).reshape(-1, 3)),
    False: ((STATION.apply(BEFORE.reshape(-1, 3)) + ORIGIN).reshape(-1, 6, 3) - TIPS.position.T[:, None]) @ MOUNT,
}
IDS = np.where(np.arange(6 * POSES).reshape(POSES, 6) % 17 == 16, -1, np.arange(6))
LENS = [1.1, 1.2, 0.4, 0.3, -0.1, 0.05, 0.001, 0.002, 0.02, 0.01, 0.02, 0.003]


def picture(model, count, on_arm=True, **options):
    """Corners as a camera has them that is nearly where `MOUNT` or `STATION` say."""
    lens, points = np.array(LENS[:count]), IN_SPACE[on_arm].reshape(POSES, 6, 3)
    values = camera_models()[model].project(np.moveaxis(BEFORE, -1, 0), lens[:, None, None]).values
    corners, names = np.moveaxis(values, 0, -1) + 1e-3, ("eye", "board")
    options = dict(on_arm=on_arm, model=model, intrinsics=lens) | options
    return kinds.Pixels("v", Q, corners, points, IDS, 1e-3, *names, **options)


ALL = {
    "socket": kinds.Socket("A", Q),
    "points": kinds.MeasuredPoints("p", Q, POINTS, u=[0.1, 0.2, 0.3]),
    "target": kinds.MeasuredPoints("p", Q, POINTS, covariance=np.diag([1.0, 2.0, 3.0]), target="smr"),
    "transforms": kinds.MeasuredTransforms("x", Q, POINTS, MEASURED, u_angle=1e-3, u=0.1),
    "sphere": kinds.Sphere("s", Q),
    "certified sphere": kinds.Sphere("s", Q, diameter=100, u=0.1, stylus=4),
    "exact sphere": kinds.Sphere("s", Q, diameter=100),
    "cylinder": kinds.Cylinder("c", Q, form=0.01),
    "certified cylinder": kinds.Cylinder("c", Q, diameter=100, u=0.1, stylus=4, inside=True),
    "exact cylinder": kinds.Cylinder("c", Q, diameter=100),
    "plane": kinds.Plane("f", Q, form=0.01),
    "planes": kinds.ParallelPlanes("f", Q[:6], Q[6:], 50.0, u=0.1, stylus=3.0),
    "exact planes": kinds.ParallelPlanes("f", Q[:6], Q[6:], 50.0, inside=True, stylus=3.0),
    "artefact": kinds.Artefact("t", CORNERS, IN_CORNERS),
    "indexed artefact": kinds.Artefact("t", CORNERS, IN_CORNERS, u=0.1, index="1"),
    "distances": kinds.Distances("d", Q, np.linalg.norm(TIPS.position, axis=0), u=0.1),
    "distances with a constant": kinds.Distances("d", Q, np.linalg.norm(TIPS.position, axis=0), constant=True),
    "camera on the arm": picture("pinhole", 9, u_intrinsics=[0, *[0.1] * 4, *[np.inf] * 4], u_scale=1e-4),
    "fixed camera": picture("pinhole", 12, on_arm=False, u_intrinsics=0.1),
    "fisheye": picture("fisheye", 8, u_intrinsics=np.inf),
    "fixed fisheye": picture("fisheye", 8, on_arm=False, u_scale=1e-4),
    "stereo rig": picture("points", 0, u_scale=1e-4),
}


def test_every_kind_and_its_simulation_are_public():
    public = {getattr(kinds, name) for name in dir(kinds)}
    for base in (AbstractObservation, AbstractSimulated):
        for kind in subclasses(base):
            if kind.__module__.startswith("aacmm_jax") and not kind.__name__.startswith("Abstract"):
                assert kind in public, f"add {kind.__name__} to data/observations/__init__.pyi"


def subclasses(base):
    return [inner for kind in base.__subclasses__() for inner in (kind, *subclasses(kind))]


def unknowns_of(observation):
    found = observation.start(TIPS, np.zeros(3))
    random = np.random.default_rng(2)
    return columns({name: value + 1e-2 * random.normal(size=np.shape(value)) for name, value in found.items()})


def columns(unknowns):
    return {name: np.asarray(value)[:, None] for name, value in unknowns.items()}


CONTACTS = {"sphere contact", "plane contact"}  # they need a robot: `test_contacts`


def test_every_kind_is_here():
    """A new kind needs a row, in the tables of this module and in those of the files."""
    assert {one.kind for one in ALL.values()} == known_kinds().keys() - CONTACTS


@pytest.mark.first_rows(7)
@pytest.mark.parametrize("name", ALL)
def test_shapes_and_derivatives(name):
    observation = to_numpy(ALL[name])
    check_derivatives(observation, unknowns_of(observation))


def check_derivatives(observation, unknowns):
    """Analytic derivatives by the tips, their orientation and every unknown agree with central differences."""
    rows = observation.residual(TIPS, unknowns)
    counted = observation.residual_with_errors(TIPS, unknowns)
    assert counted.values.shape == (observation.rows, POSES)
    assert counted.measured.shape == (POSES, observation.rows, observation.rows)
    assert set(rows.by_unknowns) == set(observation.unknowns)
    for part, units in observation.unknowns.items():
        assert unknowns[part].shape == (len(units), 1)
        for i in range(len(units)):
            step = 1e-6 * max(1.0, abs(unknowns[part][i, 0])) * np.eye(len(units))[:, i : i + 1]
            plus, minus = (
                observation.residual(TIPS, unknowns | {part: unknowns[part] + s * step}).values for s in (1, -1)
            )
            numerical = (plus - minus) / (2 * np.sum(step))
            tolerance = 1e-6 * max(1.0, np.abs(numerical).max())
            np.testing.assert_allclose(rows.by_unknowns[part][i], numerical, atol=tolerance)
    for c in range(3):
        shift = 1e-4 * np.eye(3)[c][:, None]
        plus, minus = (
            observation.residual(TIPS._replace(position=TIPS.position + s * shift), unknowns).values for s in (1, -1)
        )
        np.testing.assert_allclose(rows.by_tip[:, c], (plus - minus) / 2e-4, atol=1e-6)
        if rows.by_rotation is not None:
            turns = [Rotation.from_rotvec(s * 1e-5 * np.eye(3)[c]).as_matrix() for s in (1, -1)]
            plus, minus = (
                observation.residual(TIPS._replace(axes=tuple(turn @ axis for axis in TIPS.axes)), unknowns).values
                for turn in turns
            )
            np.testing.assert_allclose(rows.by_rotation[:, c], (plus - minus) / 2e-5, atol=1e-8)


BOX = [[200, -300, 100], [600, 300, 500]]
FRAME = (0.1, 0.2, 3.0, 1000.0, 2000.0, -300.0)
BAR = {"a": (0, 0, 0), "b": (300, 0, 0), "c": (0, 200, 0)}


def simulated_picture(name="v", board="board", **changed):
    points = [(30 * i, 30 * j, 0) for j in range(4) for i in range(6)]
    held, still = (10, 20, 80, 0.1, 0.2, 0.3), (0.1, -2.9, 0.2, 500, 50, -50)
    if not changed.get("on_arm", True):
        still = (0, 0.3, 0, 400, 0, -300)
    options = dict(intrinsics=(600, 610, 320, 240), image_size=(640, 480), mount=held, frame=still, u=1e-9, tilt=1.2)
    options |= {"distance": (150, 600)} | changed
    return kinds.SimulatedPixels(name, 8, f"camera {name}", board, points, **options)


SIMULATED = [
    kinds.SimulatedPoints("T", BOX, 12, FRAME, target="smr", place=(10, 20, 80)),
    kinds.SimulatedTransforms("T6", BOX, 12, (10, 20, 80, 0.1, 0.2, 0.3), FRAME, u_angle=1e-12),
    kinds.SimulatedSphere("s", (400, 0, 300), 50.0, 12, certified=False),
    kinds.SimulatedCylinder("c", [(400, 0, 300), (430, 60, 320)], 50.0, 8, certified=False),
    kinds.SimulatedCylinder("r", [(400, 0, 300), (400, 0, 320)], 50.0, 8, stylus=6.0, inside=True),
    kinds.SimulatedPlanes("f", (300, -100, 200), [(0, 200, 0), (150, 0, 60)], 6),
    kinds.SimulatedPlanes("p", (300, -100, 200), [(0, 200, 0), (150, 0, 60)], 6, distance=40.0),
    kinds.SimulatedArtefact("bar", BAR, 4, (0.3, 0, 1.5, 350, -100, 250)),
    kinds.SimulatedDistances("d", BOX, 12, (900, 300, 100)),
    simulated_picture(),
    simulated_picture("fixed", "gripper board", on_arm=False, model="fisheye", intrinsics=(200, 210, 320, 240)),
    simulated_picture("rig", "other board", model="points", intrinsics=()),
]


@pytest.mark.parametrize(("name", "part"), [("sphere", "centre of s"), ("distances", "pivot of d")])
def test_a_tip_in_the_centre_is_at_no_distance_in_no_direction(name, part):
    """A plan with a sphere of radius 0 begins there."""
    observation = to_numpy(ALL[name])
    unknowns = unknowns_of(observation) | {part: TIPS.position[:, :1]}
    with np.errstate(all="raise"):
        rows = observation.residual(TIPS, unknowns)
    assert np.isfinite(rows.values).all()
    np.testing.assert_array_equal(rows.by_tip[0, :, 0], 0)


@pytest.mark.slow
def test_starts_are_exact_for_exact_data(paper_arm):
    """Without noise and by the true arm, the closed forms find the geometry, also of targets at an unknown place."""
    capture = aj.simulate(paper_arm, {}, observations=SIMULATED, seed=3)
    # A socket is simulated as one of the capture's own.
    assert {one.kind for one in capture.observations} == known_kinds().keys() - {"socket"} - CONTACTS
    for observation in to_numpy(capture.observations):
        arm = paper_arm
        probe = np.asarray(arm.probe)
        poses = np.asarray(arm.pose(observation.q))
        axes = tuple(poses[:, :3, i].T for i in range(3))
        tips = Tips(poses[:, :3, 3].T, axes)
        found = {name: np.asarray(value) for name, value in observation.start(tips, probe).items()}
        if observation.target:
            offset = found[f"offset of {observation.target}"]
            np.testing.assert_allclose(offset, (10, 20, 80), atol=1e-3)
            moved = tips.position + np.einsum("pcm,p->cm", np.stack(axes), offset - probe)
            tips = tips._replace(position=moved)
        assert np.abs(observation.residual(tips, columns(found)).values).max() < 1e-3, observation.kind


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_platform_frames_are_exact_for_exact_data(seed):
    """Of two bars, which leave a turn about their line open, on indices up to half a revolution and more apart; a plate
    stands beside the platform and on it, which tells the platform's frame, and errors are added to the residuals."""
    random = np.random.default_rng(seed)
    frames = np.concatenate([random.uniform(-1.7, 1.7, (5, 3)), random.uniform(-500, 500, (5, 3))], axis=1)
    bar = {"a": (0.0, 0.0, 0.0), "b": (300.0, 0.0, 0.0)}
    plate = {"p": (0.0, 0.0, 0.0), "q": (100.0, 0.0, 0.0), "r": (0.0, 100.0, 0.0)}
    placements = {"first": (bar, frames[0]), "second": (bar, frames[1]), "plate": (plate, frames[2])}
    indices = {None: np.zeros(6), "1": frames[3], "2": frames[4]}
    held = [("plate", None), ("second", "2"), ("first", "1"), ("second", "1"), ("plate", "1"), ("first", "2")]
    observations, tips = [], []
    for placement, index in held:
        points, inner = placements[placement]
        on_platform = placed(inner, np.array(list(points.values())).T)[0]
        position = placed(indices[index], on_platform)[0]
        q = {point: np.zeros((1, 6)) for point in points}
        artefact = kinds.Artefact(f"{placement} at {index}", points, q, placement=placement, index=index)
        observations.append(artefact.with_errors(artefact.q, np.zeros((3, len(q))), {}))
        tips.append(Tips(position, (position, position, position)))
    found = platform_frames(observations, tips)
    assert set(found) == {f"placement {name}" for name in placements} | {"index 1", "index 2"}
    for observation, own in zip(observations, tips, strict=True):
        assert np.abs(observation.residual(own, columns(found)).values).max() < 1e-4, observation.name
    expected = rotation_matrix(frames[3][:3])
    np.testing.assert_allclose(rotation_matrix(found["index 1"][:3]), expected, atol=1e-6)
    assert platform_frames(observations[:1], tips[:1]) == {}


@pytest.mark.parametrize(
    ("name", "certified", "stated"),
    [
        ("socket", {}, {}),
        ("transforms", {}, {"standard uncertainty of an orientation about each axis": ([1e-3], "rad")}),
        ("sphere", {}, {}),
        ("certified sphere", {"certified diameter": ([100.0], 0.1)}, {"diameter of the tip's ball": ([4.0], "mm")}),
        ("exact sphere", {"certified diameter": ([100.0], 0.0)}, {}),
        ("plane", {}, {"standard deviation of the surface from an ideal plane": ([0.01], "mm")}),
        (
            "exact planes",
            {"certified distance between the planes": ([50.0], 0.0)},
            {"diameter of the tip's ball": ([3.0], "mm")},
        ),
        (
            "indexed artefact",
            {f"certified coordinates of {name}": (values, 0.1) for name, values in CORNERS.items()},
            {},
        ),
        ("distances", {}, {}),
    ],
)
def test_what_is_certified_is_that_of_the_artefact(name, certified, stated):
    """As on its certificate: without the stylus, which the distance of the tip's centre contains."""
    observation = to_numpy(ALL[name])
    found = {one.says: (one.values.tolist(), one.u) for one in certified_quantities(observation)}
    assert found == certified
    assert {one.says: (one.values.tolist(), one.unit) for one in stated_quantities(observation)} == stated
    assert {one.says for one in certified_quantities(observation) if one.unit != "mm"} == set()


@pytest.mark.first_rows(9)
@pytest.mark.parametrize("name", ALL)
def test_every_number_of_a_geometry_can_be_read(name):
    observation = to_numpy(ALL[name])
    for part, values in unknowns_of(observation).items():
        if part in observation.unknowns:
            quantities = observation.quantities(part, values[:, 0])
            assert {quantity.unit for quantity in quantities} <= {"mm", "rad", "px", "1"}
            assert len({quantity.says for quantity in quantities}) == len(quantities)
            count = sum(len(quantity.values) for quantity in quantities)
            # three numbers for two unknown ones
            directions = sum(quantity.says in ("normal", "direction of the axis") for quantity in quantities)
            points = sum(quantity.says == "point of the axis" for quantity in quantities)
            assert count == len(values) + directions + points


@pytest.mark.parametrize(
    ("name", "part", "certified"),
    [
        ("certified sphere", "radius of s", 50.0),
        ("certified cylinder", "radius of c", 50.0),
        ("planes", "distance of f", 50.0),
    ],
)
def test_the_size_found_is_that_of_the_artefact(name, part, certified):
    """Its number in the solve is that of the tip's centre, which the tip's ball makes larger, or smaller inside."""
    observation = to_numpy(ALL[name])
    (found,) = observation.quantities(part, np.asarray(observation.certified[part][0]))
    assert (found.says, found.values.tolist(), found.unit) == ("without the tip's ball", [certified], "mm")


def test_a_plane_is_read_by_its_normal():
    """The rotation vector (0, 30 deg, 0) turns z to (sin 30, 0, cos 30)."""
    normal, distance = ALL["plane"].quantities("plane f", np.array([0.0, np.pi / 6, 12.5]))
    np.testing.assert_allclose(normal.values, [0.5, 0, np.sqrt(0.75)], atol=1e-12)
    assert (normal.unit, distance.values.tolist(), distance.unit) == ("1", [12.5], "mm")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: kinds.MeasuredPoints("p", Q, POINTS[:5]), "shape (5, 3)"),
        (lambda: kinds.MeasuredPoints("p", Q, POINTS, u=-1), "negative"),
        (lambda: kinds.MeasuredPoints("p", Q, POINTS, u=1, covariance=np.eye(3)), "both given"),
        (lambda: kinds.MeasuredPoints("p", Q, POINTS, covariance=-np.eye(3)), "not symmetric and positive"),
        (lambda: kinds.MeasuredPoints("", Q, POINTS), "text of one line"),
        (lambda: kinds.MeasuredTransforms("p", Q, POINTS, 2 * MEASURED, u_angle=1e-3), "not a rotation"),
        (lambda: kinds.MeasuredTransforms("p", Q, POINTS, MEASURED, u_angle=0.0), "must be positive"),
        (lambda: kinds.Sphere("s", Q, diameter=0), "must be positive"),
        (lambda: kinds.Cylinder("c", Q, diameter=0), "must be positive"),
        (
            lambda: kinds.Cylinder("c", Q, diameter=5, stylus=6, inside=True),
            "a stylus of 6 mm does not fit into a diameter of 5",
        ),
        (lambda: kinds.ParallelPlanes("f", Q, Q[:, :5], 10.0), "6 and 5 columns"),
        (lambda: kinds.ParallelPlanes("f", Q, Q, 0.0), "must be positive"),
        (lambda: kinds.Artefact("t", CORNERS, {"d": Q}), "has no coordinates"),
        (lambda: kinds.Artefact("t", CORNERS, {}), "two dictionaries"),
        (lambda: kinds.Distances("d", Q, np.ones(3)), "shape (3,)"),
        (lambda: aj.Capture({}, [], [kinds.Sphere("s", Q), kinds.Sphere("s", Q)]), "two observations have the name"),
        (lambda: aj.Capture({"A": Q[:, :5]}, [], [kinds.Sphere("s", Q)]), "6 columns"),
        (lambda: aj.Capture({}), "at least one socket"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(aj.InputError) as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def touches(cylinder, arc, heights, count=12):
    """Touches of a cylinder of radius 20, tilted and away from the origin, to 0.04 mm."""
    random = np.random.default_rng(cylinder)
    angle, height = np.linspace(0, np.deg2rad(arc), count), np.resize(heights, count)
    local = np.stack([20 * np.cos(angle), 20 * np.sin(angle), height]) + 0.04 * random.normal(size=(3, count))
    return Rotation.random(random_state=cylinder).as_matrix() @ local + 400 * random.normal(size=(3, 1))


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("shape", [(330, [0, 20]), (330, [0, 7, 14]), (100, [0, 30]), (330, [0, 130, 260, 400])])
def test_cylinders_are_found_in_any_direction(shape, known):
    """Two rings, a spiral, an arc and a long pin: no touch is further from the cylinder than its scatter says."""
    for cylinder in range(5):
        tips, radius = touches(cylinder, *shape), np.array(20.0) if known else None
        axis, found = fitted_cylinder(tips, radius)
        assert abs(found - 20) < (1e-12 if known else 1.0)
        assert np.abs(distances_from_axis(tips, axis)[0] - found).max() < 0.12


@pytest.mark.slow
def test_a_cylinder_is_fitted_under_jit_too():
    tips = touches(0, 330, [0, 20])
    axis, radius = fitted_cylinder(tips, None)
    compiled = jax.jit(lambda tips: fitted_cylinder(tips, None))(tips)
    np.testing.assert_allclose(np.concatenate([compiled[0], compiled[1][None]]), [*axis, radius], rtol=1e-7)


@pytest.mark.parametrize(
    ("observation", "tips", "message"),
    [
        (kinds.Cylinder("c", Q), touches(0, 330, [0, 20], 4), "4 touches, but there are 5 unknowns"),
        (kinds.Cylinder("c", Q, diameter=40), touches(0, 330, [0, 20], 3), "3 touches, but there are 4 unknowns"),
        (kinds.Cylinder("c", Q), touches(0, 330, [0]), "do not determine the geometry"),
        (kinds.Cylinder("c", Q), touches(0, 20, [0, 10, 20, 30, 40], 25), "do not determine the geometry"),
        (kinds.Cylinder("c", Q, diameter=40), touches(0, 0.1, [0, 20]), "do not determine the geometry"),
    ],
)
def test_touches_that_leave_a_geometry_open(observation, tips, message):
    with pytest.raises(aj.InputError, match=message) as caught:
        observation.check_determined(tips)
    assert "touches" in str(caught.value)


def test_the_example_of_the_package_runs():
    found = doctest.testmod(kinds)
    assert found.attempted > 2
    assert found.failed == 0
