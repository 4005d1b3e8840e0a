"""The rows of cameras in a summary; against an independent reader of URDF in tests/cli/test_camera_frames.py."""

import numpy as np
import pytest

from aacmm_jax.kinematics.parameters import UrdfSource
from aacmm_jax.summaries.cameras import camera_rows

FIRST = np.array([[0.0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]])
LINK = (1.0, 2.0, 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("follows", [True, False])
def test_of_an_arm_from_a_urdf_mounts_are_in_its_tip_link_and_places_in_its_base_link(camera_record, follows):
    [before] = camera_rows(camera_record)
    nominal = camera_record.recording.nominal
    source = UrdfSource("", "base_link", ("tool0",), tuple(map(tuple, FIRST.tolist())), LINK, follows)
    recording = camera_record.recording._replace(nominal=nominal._replace(urdf=source))
    [row] = camera_rows(camera_record._replace(recording=recording))
    moved = np.asarray(camera_record.calibrated.arm.probe) - np.asarray(nominal.arm.probe)
    expected = np.array(before["mount"]["position_mm"]) - LINK - (moved if follows else 0)
    assert (before["mount"]["in"], before["place"]["in"]) == ("last frame", "base")
    assert (row["mount"]["in"], row["place"]["in"]) == ("tool0", "base_link")
    np.testing.assert_allclose(row["mount"]["position_mm"], expected)
    np.testing.assert_allclose(row["mount"]["roll_pitch_yaw_rad"], before["mount"]["roll_pitch_yaw_rad"])
    np.testing.assert_allclose(row["place"]["matrix_mm"], FIRST @ before["place"]["matrix_mm"], atol=1e-9)
    for part, key in (("mount", "position_u_mm"), ("mount", "rotation_u_rad"), ("place", "position_u_mm")):
        assert row[part][key] == pytest.approx(before[part][key])
