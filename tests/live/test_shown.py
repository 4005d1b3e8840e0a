"""What the page says first."""

import pytest

from aacmm_jax.live.shown import headline, not_answering

PLACE = {"name": "A", "position": [0, 0, 0], "poses": 2, "wanted": 5}
POSES = [{"number": n, "place": "A", "outlier": False, "excluded": False} for n in (1, 2)]
STATE = {
    "poses": POSES, "paths": [], "written": [], "stop": False, "next": {"place": "A"}, "places": [PLACE],
    "progress": {"u_target_mm": None},
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({}, "Go to A and hold still"),
        ({"places": [PLACE | {"poses": 5}]}, "Every place has its poses: finish, or take more"),
        ({"stop": True}, "The target is met: finish, or take more poses"),
        ({"paths": ["capture.h5"], "written": [1], "written_until": 2}, "Finished with 1 pose"),
        ({"paths": ["capture.h5"], "written": [1], "written_until": 1}, "Go to A and hold still"),
        ({"poses": [POSES[0], POSES[1] | {"outlier": True}]}, "Pose 2 does not fit: take it again in A"),
        ({"next": None}, "Take a pose"),
    ],
)
def test_the_headline_says_what_to_do_now(changed, says):
    assert headline(None, [], STATE | changed) == says
    assert headline("Calibrating", ["Not connected: tcp:a:1"], STATE | changed) == "Calibrating ..."
    assert headline(None, ["Not connected: tcp:a:1"], STATE | changed) == "Not connected: tcp:a:1"


def test_a_device_that_does_not_answer_is_named_once_until_it_has_answered():
    told, camera = set(), {"name": "camera:0", "connected": False, "message": "no image; trying again"}
    assert not_answering([camera | {"message": ""}], told) == []
    (text,) = not_answering([camera, {"name": "servos", "connected": True, "message": ""}], told)
    assert text.startswith("camera:0 does not answer: no image")
    assert not_answering([camera], told) == not_answering([camera | {"connected": True}], told) == []
    assert len(not_answering([camera], told)) == 1
