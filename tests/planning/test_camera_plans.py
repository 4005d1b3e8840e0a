"""Plans with a camera: every planned image shows the whole target, and the manifest takes what is recorded."""

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data.observations import SimulatedPixels
from aacmm_jax.files.manifest_tables import PosesManifest
from aacmm_jax.files.plans import plan_csv, plan_manifest
from aacmm_jax.files.toml import read_toml
from aacmm_jax.kinematics.arm import joint_limits
from aacmm_jax.planning.kit_placement import KitItem, Thing, set_up
from aacmm_jax.planning.problem import DesignProblem
from tests.refusals import assert_refused

BOARD = [(30 * column, 30 * row, 0) for row in range(4) for column in range(6)]
ARM = aj.load_arm("ur10e")
SPACE = aj.Parameters(ARM, ("theta_2", "theta_3", "theta_4", "a_2", "a_3"))
FRAMES = {
    True: {"mount": (60, 0, 20, 0, 0, 0.3), "frame": (np.pi, 0, 0, -700, -100, 0), "distance": (200, 450)},
    False: {"mount": (20, 0, 40, 0, 0.2, 0.3), "frame": (-1.2, 1.2, -1.2, -1300, -200, 400), "distance": (300, 700)},
}


def camera(on_arm, **changed):
    stated = {"u_intrinsics": (0.0, *(np.inf,) * 3), "u": 0.4, "tilt": 0.8} | FRAMES[on_arm] | changed
    return SimulatedPixels(
        "images", 20, "webcam", "board", BOARD, (600, 600, 320, 240), (640, 480), on_arm=on_arm, **stated
    )


def rotation(vector):
    return np.asarray(rotation_matrix(np.asarray(vector, dtype=float)))


@pytest.fixture(scope="module", params=[True, False], ids=["camera on the arm", "camera fixed"])
def planned(request):
    item = camera(request.param)
    return aj.planning.plan_kit(ARM, [item], poses=8, space=SPACE, candidates=400, above=20.0, seed=1)


@pytest.mark.slow
def test_every_image_shows_the_whole_target(planned):
    """Within the image, at a distance and tilt that were stated, above the table and within the limits of joints."""
    [item], [seen] = planned.kit, planned.observations
    q = np.asarray(seen.q)
    held = np.asarray(ARM.replace(probe=item.mount[:3]).pose(q))
    turn = held[:, :3, :3] @ rotation(item.mount[3:])
    still = np.broadcast_to(rotation(item.frame[:3]), turn.shape)
    moving, fixed = (held[:, :3, 3], turn), (np.broadcast_to(item.frame[3:], (len(q), 3)), still)
    (centre, view), (origin, board) = (moving, fixed) if item.on_arm else (fixed, moving)
    points = np.einsum("mji,mkj->mki", view, np.array(BOARD) @ board.swapaxes(1, 2) + (origin - centre)[:, None])
    pixels = 600 * points[..., :2] / points[..., 2:] + [320, 240]
    assert np.asarray(seen.corners) == pytest.approx(pixels, abs=1e-6)
    assert np.all((pixels > 0) & (pixels < [639, 479]))
    middle = points.mean(axis=1)
    size = np.linalg.norm(middle, axis=1)
    assert np.all((size >= item.distance[0]) & (size <= item.distance[1]))
    normal = np.einsum("mji,mj->mi", view, board[:, :, 2])
    assert np.all(np.sum(normal * middle, axis=1) >= np.cos(item.tilt) * size)
    assert np.all(held[:, 2, 3] >= 20.0)
    low, high = np.asarray(joint_limits(ARM, None)).T
    assert np.all((q > low) & (q < high))


@pytest.mark.slow
def test_chosen_poses_determine_more_than_random_ones(planned):
    assert planned.predicted.median < planned.random.median
    assert planned.more.median < planned.predicted.median


@pytest.mark.slow
def test_the_manifest_of_a_plan_names_camera_and_target(planned, tmp_path):
    target = {"name": "board", "kind": "checkerboard", "squares": [7, 5], "size": 30.0}
    (tmp_path / "m.toml").write_text(plan_manifest(planned, "ur10e", targets=[target]))
    content = read_toml(tmp_path / "m.toml", PosesManifest)
    [pixels], [stated] = content.pixels, content.camera
    assert (pixels.camera, pixels.target, pixels.images) == ("webcam", "board", "images/*.png")
    assert pixels.on_arm == ("camera" if planned.kit[0].on_arm else "target")
    assert (stated.image_size, stated.u) == ([640, 480], "free")
    assert content.target[0].keys["squares"] == [7, 5]
    assert len(plan_csv(planned, "deg").splitlines()) == 1 + 8


def test_a_target_that_is_hardly_ever_seen_is_refused():
    item = camera(True, distance=(4000, 4100))
    problem = DesignProblem.of(ARM, aj.planning.PlanOptions(space=SPACE))
    assert_refused(lambda: set_up(problem.region, Thing(KitItem(item, 0), item), 200), "'images'", "move the target")


@pytest.mark.slow
def test_poses_from_both_sides(planned):
    """Every pose twice: each joint comes from one side and then from the other, as its columns say."""
    rows = [line.split(",") for line in plan_csv(planned, "rad", both_sides=True).splitlines()]
    assert rows[0][1] == "move"
    assert rows[0][-6:] == [f"direction_{i}" for i in range(1, 7)]
    assert len(rows) == 1 + 4 * 8
    first = rows[0].index("q_1_rad")
    for start, pose, back, again in zip(*(rows[1 + i :: 4] for i in range(4)), strict=True):
        assert [row[1] for row in (start, pose, back, again)] == ["approach", "pose"] * 2
        assert pose[first : first + 6] == again[first : first + 6]
        for before, there, sign in ((start, pose, 1), (back, again, -1)):
            moved = np.array(there[first : first + 6], float) - np.array(before[first : first + 6], float)
            np.testing.assert_allclose(moved, np.radians(2) * np.array(there[-6:], float), atol=2e-6)
            np.testing.assert_array_equal(np.array(there[-6:], float), sign * np.array(pose[-6:], float))


@pytest.mark.slow
def test_both_sides_need_a_tip_that_nothing_holds(planned):
    held = planned._replace(observations=(aj.data.observations.Socket("seat", np.zeros((1, 6))),))
    with pytest.raises(aj.InputError, match="'seat' is touched; plan for an instrument or camera"):
        plan_csv(held, both_sides=True)
