"""What counts of a stream: what instruments saw while the arm was at rest."""

import numpy as np

import aacmm_jax as aj
from aacmm_jax.live import readings
from aacmm_jax.live.readings import Readings


def test_what_a_camera_saw_before_the_rest_is_not_of_the_pose(monkeypatch):
    now, random = [100.0], np.random.default_rng(0)
    monkeypatch.setattr(readings.time, "monotonic", lambda: now[0])
    stream, q = Readings(aj.load_arm("panda")), np.zeros(7)

    def joints(seconds, speed):
        nonlocal q
        for _ in range(int(seconds * 100)):
            now[0] += 0.01
            q = q + 0.01 * speed
            stream.add(aj.live.Sample(now[0], q + 1e-6 * random.normal(size=7)))

    def corners(value, delay):
        stream.add(aj.live.Sample(now[0], None, {}, {"corners": np.full((4, 2), value)}, delay))

    for _ in range(3):
        joints(1.0, 0.3)
        joints(1.5, 0.0)
    joints(1.0, 0.3)
    corners(1.0, 0.0)  # on the way
    joints(1.0, 0.0)
    assert stream.rest is not None
    assert stream.measured == []
    corners(2.0, 1.2)  # found now, in an image of the way
    assert stream.measured == []
    corners(3.0, 0.3)
    assert [seen["corners"][0, 0] for seen in stream.measured] == [3.0]
