"""What a manifest need not state: conventions of rotations, deviations of points, and joints that turn with another."""

import numpy as np
import pytest
import tomlkit
from scipy.spatial.transform import Rotation

import aacmm_jax as aj
from aacmm_jax.diagnostics.capture_check import check_capture
from aacmm_jax.diagnostics.rotation_check import check_rotations
from aacmm_jax.files.manifest import deviations_of_manifest, read_manifest, written_rotations
from aacmm_jax.files.reading_checks import angles_toml, rotation_rows
from aacmm_jax.files.reading_sets import deviations
from aacmm_jax.pipeline.reading_sets import compare_points, points_sentence

PROBE = np.array([20.0, -40.0, 120.0])
JOINTS = ",".join(f"J{i} [deg]" for i in range(1, 7))


@pytest.fixture(scope="module")
def seen():
    """The nominal arm, readings, and a target as an instrument saw it: positions and rotations."""
    random, nominal = np.random.default_rng(0), aj.load_arm("ur5e").replace(probe=PROBE)
    names = tuple(f"{kind}_{i}" for kind in ("a", "d", "theta", "alpha") for i in range(1, 7))
    true = aj.perturbed_arm(aj.Parameters(nominal, names), length=0.5, angle=0.003, seed=0)
    q = random.uniform(-2, 2, (40, 6))
    pose = np.array(true.pose(q))
    frame, mount = (Rotation.from_quat(random.normal(size=4)) for _ in "ab")
    turned = frame * Rotation.from_matrix(pose[:, :3, :3]) * mount
    return nominal, q, frame.apply(pose[:, :3, 3]) + np.array([500.0, 200.0, -100.0]), turned


def written(turned: Rotation, convention: str, unit: str) -> np.ndarray:
    plain = convention.removesuffix(" inverse")
    turned = turned if plain == convention else turned.inv()
    if plain == "matrix":
        return turned.as_matrix().reshape(-1, 9)
    if plain.startswith("quaternion"):
        return turned.as_quat(scalar_first=plain.endswith("wxyz"))
    angles = turned.as_rotvec() if plain == "vector" else turned.as_euler(plain)
    return np.degrees(angles) if unit == "deg" else angles


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    ("convention", "unit"),
    [
        *(("ZYX", "deg"), ("xyz", "rad"), ("ZYZ", "deg"), ("YXZ", "rad"), ("XYZ inverse", "deg"), ("vector", "rad")),
        *(("vector inverse", "deg"), ("quaternion wxyz", ""), ("quaternion xyzw inverse", ""), ("matrix inverse", "")),
    ],
)
def test_the_convention_is_found(seen, convention, unit):
    nominal, q, points, turned = seen
    rms, fits = check_rotations(nominal, q, points, written(turned, convention, unit))
    found = {(fit.convention, fit.unit) for fit in fits if fit.fits}
    assert (convention, unit) in found
    assert all(fit.equivalent for fit in fits if fit.fits)  # XYZ is zyx with the angles in the other order
    assert fits[0].rms < np.radians(0.5)
    assert rms < 5.0


def test_all_conventions_of_one_rotation_are_equivalent_where_the_target_does_not_turn(seen):
    """Angles that are all zero say nothing, and that is said."""
    nominal, q, points, _ = seen
    still = np.tile(q[0], (len(q), 1))
    still[:, :3] = q[:, :3]
    same = np.zeros((len(q), 3))
    fits = check_rotations(nominal, still, points, same)[1]
    assert len({round(fit.rms, 9) for fit in fits}) == 1


def manifest(folder, table, header, columns, more=""):
    np.savetxt(folder / "t.csv", table, delimiter=",", header=header, comments="")
    path = folder / "t.toml"
    probe = ", ".join(map(str, PROBE))
    path.write_text(f'arm = "ur5e"\nprobe = [{probe}]\n{more}[[transforms]]\nfile = "t.csv"\nu = 0.05\n{columns}\n')
    return path


@pytest.mark.slow
@pytest.mark.parametrize(("convention", "unit"), [("ZYX", "deg"), ("vector inverse", "rad")])
def test_the_proposed_lines_make_the_import(seen, tmp_path, convention, unit):
    nominal, q, points, turned = seen
    numbers = written(turned, convention, unit)
    header = f"{JOINTS},x,y,z,{','.join(f'e{i}' for i in range(numbers.shape[1]))}"
    columns = 'u_angle = 0.001\ncolumns = { points = ["x", "y", "z"], rotations = "e[0-9]" }\nunits = { points = "mm" }'
    path = manifest(tmp_path, np.hstack([np.degrees(q), points, numbers]), header, columns)
    with pytest.raises(aj.InputError, match="aacmm import --check finds it"):
        read_manifest(path)
    recording, parts = written_rotations(path)
    rows = rotation_rows(path, parts, check_capture(recording.nominal.arm, recording.capture), nominal)
    assert [row["fits"] for row in rows].count(False) == 2
    document = tomlkit.parse(path.read_text())
    document["transforms"][0].update(tomlkit.parse("\n".join(rows[0]["lines"])))
    path.write_text(tomlkit.dumps(document))
    (observation,) = read_manifest(path).capture.observations
    assert isinstance(observation, aj.data.observations.MeasuredTransforms)
    np.testing.assert_allclose(observation.rotations, turned.as_matrix(), atol=1e-9)
    assert rotation_rows(path, written_rotations(path)[1], check_capture(nominal, recording.capture), nominal)[0][
        "taken"
    ]


@pytest.mark.parametrize(
    ("header", "found"),
    [
        (["x_t", "y_t", "z_t", "x_dif", "y_dif", "z_dif"], [["x_dif", "y_dif", "z_dif"]]),
        (["x", "y", "z", "dx [mm]", "dy [mm]", "dz [mm]"], [["dx [mm]", "dy [mm]", "dz [mm]"]]),
        (["x", "y", "z", "error x", "error y"], []),
        (["x", "y", "z", "vx", "vy", "vz"], []),
        ([], []),
    ],
)
def test_deviations_by_name(header, found):
    assert deviations(header) == found


@pytest.mark.slow
def test_measured_points_are_told_from_computed_ones(seen, tmp_path):
    """A controller's positions, and what a tracker saw less these."""
    nominal, q, points, _ = seen
    computed = np.asarray(nominal.position(q))
    frame = aj.units.DEG * np.array([1.0, -2.0, 0.5])
    seen_there = (points - points.mean(axis=0)) @ Rotation.from_rotvec(frame).as_matrix()
    seen_there += np.random.default_rng(1).normal(0, 0.03, seen_there.shape)
    table = np.hstack([np.degrees(q), computed, seen_there - computed])
    columns = 'columns = { q = "J*", points = ["x", "y", "z"] }\ntarget = "ball"'
    path = manifest(tmp_path, table, f"{JOINTS},x,y,z,dx,dy,dz", columns)
    path.write_text(path.read_text().replace("[[transforms]]", "[[points]]"))
    recording = read_manifest(path)
    rows = compare_points(recording, deviations_of_manifest(path))
    assert [row["computed"] for row in rows] == [False, False, True]
    assert [row["fits"] for row in rows] == [True, False, False]
    says = points_sentence(rows)
    assert "computed from the readings, not measured" in says
    (line,) = rows[0]["lines"]
    assert says.endswith(f"Write in the table of the points: {line}.")
    path.write_text(f"{path.read_text()}{line}\n")
    (observation,) = read_manifest(path).capture.observations
    assert isinstance(observation, aj.data.observations.MeasuredPoints)
    np.testing.assert_allclose(observation.points, seen_there, atol=1e-9)


@pytest.mark.slow
def test_a_joint_that_turns_with_another_is_found_and_stated(seen, tmp_path):
    nominal, q, points, _ = seen
    recorded = q.copy()
    recorded[:, 2] += recorded[:, 1]  # the column of joint 3 is its angle and that of joint 2
    columns = 'columns = { q = "J*", points = ["x", "y", "z"] }\ntarget = "ball"'
    path = manifest(tmp_path, np.hstack([np.degrees(recorded), points]), f"{JOINTS},x,y,z", columns)
    path.write_text(path.read_text().replace("[[transforms]]", "[[points]]"))
    check = check_capture(nominal, read_manifest(path).capture)
    lines = angles_toml(check.given, None, path, check.couplings)
    document, stated = tomlkit.parse(path.read_text()), tomlkit.parse(lines)
    assert stated["angles"]["coupled"] == {"3": -2}
    document["angles"] = stated["angles"]
    path.write_text(tomlkit.dumps(document))
    (observation,) = read_manifest(path).capture.observations
    np.testing.assert_allclose(observation.q, q, atol=1e-9)


def test_bad_keys_are_one_sentence(seen, tmp_path):
    _, q, points, _ = seen
    table, header = np.hstack([np.degrees(q), points]), f"{JOINTS},x,y,z"
    picked = 'columns = { q = "J*", points = ["x", "y", "z"] }\ntarget = "ball"\n'

    def refused(sentence, columns, more=""):
        path = manifest(tmp_path, table, header, columns, more)
        path.write_text(path.read_text().replace("[[transforms]]", "[[points]]"))
        with pytest.raises(aj.InputError, match=sentence):
            read_manifest(path)

    refused("plus and minus do not apply to 'station'", f'{picked}plus = {{ station = ["x"] }}')
    refused("angles.coupled has 7 = 2", picked, 'angles = { unit = "deg", coupled = { 7 = 2 } }\n')
    refused("angles.coupled has 3 = 3", picked, 'angles = { unit = "deg", coupled = { 3 = 3 } }\n')
    refused("'xxy' is not a convention", f'{picked}rotation = "xxy"')
