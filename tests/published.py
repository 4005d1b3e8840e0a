"""Numbers printed by Cheng et al. 2018 (doi 10.1155/2018/1760190) that the tests need. Lengths mm, angles rad."""

import numpy as np

ORDER = (
    *(f"alpha_{i}" for i in range(1, 6)),
    *(f"a_{i}" for i in range(1, 6)),
    *(f"d_{i}" for i in range(2, 7)),
    *(f"theta_{i}" for i in range(2, 7)),
    "probe_z",
)
_ANGLE_LOWER, _ANGLE_UPPER = [-1.5883] * 5, [-1.5533] * 5
# Section 3; two of the printed vectors lost elements in print and are repaired here.
BOXES = {
    1: (
        [*_ANGLE_LOWER, -10, 52, -10, 52, -10, -10, 740, -10, 490, 1.5, *[-0.0175] * 5, 92],
        [*_ANGLE_UPPER, 10, 72, 10, 72, 10, 10, 760, 10, 510, 21.5, *[0.0175] * 5, 112],
    ),
    2: (
        [*_ANGLE_LOWER, -5, 57, -5, 57, -5, -5, 745, -5, 495, 6.5, *[-0.0175] * 5, 97],
        [*_ANGLE_UPPER, 15, 77, 15, 77, 15, 15, 765, 15, 515, 26.5, *[0.0175] * 5, 117],
    ),
}
EQUATION_18 = np.array(
    [
        -1.570742,
        -1.570856,
        1.57087,
        -1.570865,
        1.571311,
        -0.022551,
        61.883904,
        -0.006059,
        61.870128,
        0.0049,
        -0.052339,
        747.933132,
        0.059462,
        498.683691,
        15.013116,
        -0.00016,
        9e-06,
        0.000104,
        0.000172,
        -6.9e-05,
        97.44502,
    ]
)
GAUGE_NOMINAL, GAUGE_MEASURED, GAUGE_MEAN = 201.513, [200.761, 200.759, 200.755, 200.759], 200.759
# Table 2 in the same order; angles in degrees.
TABLE_2_LENGTHS = np.array([-0.0226, 62.1163, -0.0061, 62.1025, 0.0049, -0.0525, 750.7422, 0.0597, 500.5566, 15.0695, 97.8110])
TABLE_2_ANGLES_DEG = np.array([-89.9683, -90.0312, 90.0071, -90.0338, 90.0373, 0.0040, 0.0466, -0.0374, 0.0127, -0.0060])
