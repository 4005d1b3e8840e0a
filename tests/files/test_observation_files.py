"""Observations in HDF5: every kind comes back exactly, checked again, and xarray reads its table."""

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.data import observations as kinds
from aacmm_jax.data.observations.held import position_of
from aacmm_jax.data.observations.simulated import kinds as known_kinds
from aacmm_jax.files.hdf5_content import seal
from tests.example_counts import example_count

JOINTS = 3
ARM = aj.kinematics.ArmSpecification(aj.Arm(alpha=[1.5, 0.4, -1.0], a=[10, 400, 300], d=[300, 20, 10]), "small")


def readings(draw, most=5):
    return draw.normal(size=(int(draw.integers(1, most)), JOINTS))


def rotations(draw, count):
    matrices = np.linalg.qr(draw.normal(size=(count, 3, 3)))[0]
    return matrices * np.linalg.det(matrices)[:, None, None]


def make(kind, draw, some):
    """An observation of a kind, with ``some`` of what is optional."""
    q, target = readings(draw), "probe of session" if some else ""
    u = float(draw.uniform(0.001, 0.1)) if some else 0.0
    m = len(q)
    spread = draw.normal(size=(m, 3, 3))
    covariance = {"covariance": spread @ spread.swapaxes(1, 2)} if some else {"u": np.abs(draw.normal(size=(m, 3)))}
    station = "station ä/1" if some else None
    names = ["a", "b, c", "d/e"]
    held = names[1:] if some else names[::-1]
    return {
        "socket": lambda: kinds.Socket("x", q, target=target),
        "sphere": lambda: kinds.Sphere("x", q, diameter=25.4 if some else None, u=u, stylus=u / 3, target=target),
        "cylinder": lambda: kinds.Cylinder(
            "x", q, diameter=25.4 if some else None, u=u, stylus=u / 3, inside=some, form=u, target=target
        ),
        "points": lambda: kinds.MeasuredPoints(
            "x", q, draw.normal(size=(m, 3)), station=station, target=target, **covariance
        ),
        "transforms": lambda: kinds.MeasuredTransforms(
            "x", q, draw.normal(size=(m, 3)), rotations(draw, m), u_angle=0.001, station=station, **covariance
        ),
        "plane": lambda: kinds.Plane("x", q, form=u, target=target),
        "sphere contact": lambda: kinds.SphereContact(
            "x", q, [f"contact {i}" for i in range(m)], diameter=25.4 if some else None, u=u, stylus=u / 3
        ),
        "plane contact": lambda: kinds.PlaneContact("x", q, [f"contact {i}" for i in range(m)], form=u),
        "parallel planes": lambda: kinds.ParallelPlanes(
            "x", q, readings(draw), 100 / 3, u=u, stylus=u / 3, inside=some, form=u, target=target
        ),
        "artefact": lambda: kinds.Artefact(
            "x",
            {name: draw.normal(size=3) for name in names},
            {name: readings(draw) for name in held},
            u=u,
            artefact="plate" if some else None,
            placement="left" if some else None,
            index="3" if some else None,
            target=target,
        ),
        "distances": lambda: kinds.Distances(
            "x", q, draw.uniform(1, 900, m), u=draw.uniform(0, 1, m) if some else 0.1, constant=some, target=target
        ),
        "pixels": lambda: pixels(draw, q, some, target),
    }[kind]()


def pixels(draw, q, some, target):
    """Corners of a flat board, of which some are absent."""
    points = np.tile([[0, 0, 0], [90, 0, 0], [90, 60, 0], [0, 60, 0], [30, 30, 0], [60, 30, 0.0]], (len(q), 1, 1))
    away = points + np.array([-40.0, -30.0, 400.0]) + draw.normal(size=(len(q), 1, 3))
    corners = 600 * away[..., :2] / away[..., 2:] + 300 + 0.1 * draw.normal(size=away[..., :2].shape)
    ids = np.tile(np.arange(6), (len(q), 1))
    ids[:, 5] = -1 if some else 5
    optional = {"u_intrinsics": [np.inf, np.inf, 1.0, 0.0], "u_scale": 1e-3, "image_size": (640, 480)} if some else {}
    optional |= {"images": [f"img_{i}.png" for i in range(len(q))], "on_arm": False} if some else {}
    return kinds.Pixels("x", q, corners, points, ids, 0.1, "eye", "board", intrinsics=[600, 600, 300, 300], **optional)


def same(one, other):
    fields = vars(one).keys()
    assert fields == vars(other).keys()
    for field in fields:
        a, b = getattr(one, field), getattr(other, field)
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) or hasattr(a, "dtype") else a == b, field


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("kind", known_kinds())
@given(seed=st.integers(0, 10**6), some=st.booleans())
@settings(max_examples=example_count(3), suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_gives_back_what_was_saved(tmp_path, kind, seed, some):
    draw = np.random.default_rng(seed)
    one = make(kind, draw, some)
    capture = aj.Capture({"A": draw.normal(size=(2, JOINTS))} if some else {}, observations=[one])
    aj.files.save_capture(tmp_path / "capture.h5", aj.Recording(capture, ARM))
    loaded = aj.files.load_capture(tmp_path / "capture.h5").capture
    assert loaded.names == capture.names
    same(loaded.observations[0], one)
    assert loaded.observations[0].kind == kind


@pytest.mark.parametrize("kind", known_kinds())
def test_some_poses_of_an_observation(kind):
    one = make(kind, np.random.default_rng(3), True)
    some = one.select(np.arange(one.q.shape[0])[::2])
    assert np.array_equal(some.q, one.q[::2])
    left_out = {position_of(name) for name in set(getattr(one, "socket", ())) - set(getattr(some, "socket", ()))}
    assert some.unknowns.keys() == one.unknowns.keys() - left_out  # of contacts, sockets of poses that are left out


@pytest.mark.slow
def test_xarray_reads_the_table(tmp_path):
    xarray = pytest.importorskip("xarray")
    draw = np.random.default_rng(0)
    observations = [make("points", draw, True), kinds.Sphere("s", readings(draw), diameter=25.0, u=0.001)]
    aj.files.save_capture(tmp_path / "c.h5", aj.Recording(aj.Capture({}, observations=observations), ARM))
    with xarray.open_dataset(tmp_path / "c.h5", group="observation_1", engine="h5netcdf") as table:
        assert table.attrs["kind"] == "points"
        assert table.points.dims == ("pose", "axis")
        assert table.points.attrs["units"] == "mm"
        assert np.array_equal(table.points.sel(axis="y"), observations[0].points[:, 1])
    with xarray.open_dataset(tmp_path / "c.h5", group="observation_2", engine="h5netcdf") as table:
        assert table.attrs["diameter_mm"] == 25.0


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda group: group.attrs.modify("kind", "rope"), ["unknown kind 'rope'", "update"]),
        (lambda group: group.attrs.modify("u_mm", -1.0), ["u of sphere 's'", "zero or positive"]),
        (lambda group: group.pop("q"), ["has no entry 'q'"]),
        (lambda group: group.attrs.pop("name"), ["has no attribute 'name'"]),
    ],
)
def test_a_damaged_table(tmp_path, change, parts):
    sphere = kinds.Sphere("s", np.zeros((4, JOINTS)), diameter=25.0, u=0.001)
    path = tmp_path / "c.h5"
    aj.files.save_capture(path, aj.Recording(aj.Capture({}, observations=[sphere]), ARM))
    with h5py.File(path, "r+") as file:
        change(file["observation_1"])
    with open(path, "rb+") as stream:
        seal(stream)
    with pytest.raises(aj.InputError) as error:
        aj.files.load_capture(path)
    assert all(part in str(error.value) for part in [str(path), *parts]), error.value
