"""Arms with prismatic joints that tests share: a SCARA, a gantry with a wrist, a six-axis arm on a linear axis."""

import math

import numpy as np

import aacmm_jax as aj

QUARTER = math.pi / 2

SCARA = aj.Arm(  # two parallel links, a quill that points down, and its rotation
    alpha=[0.0, math.pi, 0.0, 0.0],
    a=[350.0, 300.0, 0.0, 0.0],
    d=[400.0, 0.0, 0.0, 0.0],
    probe=(20.0, 0.0, 60.0),
    prismatic=(3,),
    limits=[(-2.3, 2.3), (-2.5, 2.5), (50.0, 350.0), (-3.0, 3.0)],
)

PLATE_FOR_SCARA = """
[[artefact]]
name = "plate"
points = { a = [0, 0, 0], b = [200, 0, 0], c = [0, 150, 0], d = [200, 150, 40] }
frame = [0, 0, 0.3, 350, -50, 120]
poses = 6
u = 0.002
"""

GANTRY = aj.Arm(  # slides along z, y and x, and a wrist whose axes meet
    alpha=[-QUARTER, -QUARTER, 0.0, QUARTER, -QUARTER, 0.0],
    a=np.zeros(6),
    d=[0.0, 0.0, 0.0, 150.0, 0.0, 0.0],
    theta=[0.0, -QUARTER, 0.0, 0.0, 0.0, 0.0],
    probe=(30.0, 0.0, 150.0),
    prismatic=(1, 2, 3),
    limits=[(0.0, 1000.0), (0.0, 800.0), (0.0, 500.0), (-3.0, 3.0), (-2.0, 2.0), (-3.0, 3.0)],
)

LINEAR_AXIS = aj.Arm(  # a six-axis arm whose first axis stands across a linear axis
    alpha=[QUARTER, QUARTER, 0.0, QUARTER, -QUARTER, QUARTER, 0.0],
    a=[0.0, 25.0, 420.0, 35.0, 0.0, 0.0, 0.0],
    d=[0.0, 300.0, 0.0, 0.0, 420.0, 0.0, 80.0],
    theta=[0.0, QUARTER, QUARTER, 0.0, 0.0, 0.0, 0.0],
    probe=(40.0, 0.0, 100.0),
    prismatic=(1,),
    limits=[(-500.0, 1500.0), *[(-2.8, 2.8)] * 6],
)

ARMS = {"scara": SCARA, "gantry": GANTRY, "linear axis": LINEAR_AXIS}
