"""The page of the engine's equations: its links name functions, and its residuals have the signs of the code."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import aacmm_jax as aj
from aacmm_jax.core.rotations import rotation_matrix
from aacmm_jax.data.observations.observation import Tips

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.insert(0, str(DOCS / "extensions"))
import source_links  # noqa: E402

PAGE = (DOCS / "explanation/theory.md").read_text()
KINDS = aj.data.observations
POINTS = np.array([[310.0, -120.0, 450.0], [-40.0, 260.0, 380.0], [120.0, 75.0, 510.0]])  # also measured, certified
TIPS = POINTS.T + np.array([[3.0], [-2.0], [5.0]])
FRAME = np.array([0.3, -0.2, 0.1, 12.0, -7.0, 4.0])
Q, CENTRE, TURN = np.zeros((3, 6)), np.array([100.0, 50.0, -20.0]), rotation_matrix(FRAME[:3])
FRAMED = TIPS - (TURN @ POINTS.T + FRAME[3:, None])
FROM_CENTRE = np.linalg.norm(TIPS - CENTRE[:, None], axis=0)


@pytest.mark.parametrize("target", sorted(set(re.findall(r"\{source\}`([^`]+)`", PAGE))))
def test_a_link_to_the_source_names_a_function(target):
    assert callable(source_links.function_of(target))


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("formula", "observation", "unknowns", "expected"),
    [
        (r"\mathbf{x} - \mathbf{s}", KINDS.Socket("o", Q), [CENTRE], TIPS - CENTRE[:, None]),
        (r"\mathbf{x} - (R\,\mathbf{m} + \mathbf{t})", KINDS.MeasuredPoints("o", Q, POINTS, u=0.1), [FRAME], FRAMED),
        (
            r"\mathbf{x} - (R\,\mathbf{a} + \mathbf{t})",
            KINDS.Artefact("o", dict(zip("abc", POINTS, strict=True)), {point: Q[:1] for point in "abc"}),
            [FRAME],
            FRAMED,
        ),
        (
            r"\lVert \mathbf{x} - \mathbf{c} \rVert - (R + r)",
            KINDS.Sphere("o", Q, diameter=25.0, stylus=6.0),
            [CENTRE],
            FROM_CENTRE - 15.5,
        ),
        (
            r"\mathbf{n} \cdot \mathbf{x} - h",
            KINDS.Plane("o", Q),
            [[0.3, -0.2, 40.0]],
            rotation_matrix(np.array([0.3, -0.2, 0.0]))[:, 2] @ TIPS - 40.0,
        ),
        (
            r"\lVert \mathbf{x} - \mathbf{v} \rVert - (D + c)",
            KINDS.Distances("o", Q, [310.0, 300.0, 290.0], constant=True),
            [CENTRE, [2.0]],
            FROM_CENTRE - np.array([312.0, 302.0, 292.0]),
        ),
        (
            r"\log(R_n O\, (R M)^{\mathsf T})",
            KINDS.MeasuredTransforms("o", Q[:1], POINTS[:1], TURN[None], u=0.1, u_angle=1e-3),
            [np.zeros(6), [0.0, 0.0, 0.0]],
            np.concatenate([TIPS[:, :1] - POINTS[:1].T, -FRAME[:3, None]]),  # the last frame is that of the base
        ),
    ],
)
def test_a_residual_of_the_page_is_that_of_the_code(formula, observation, unknowns, expected):
    assert f"| ${formula}$ |" in PAGE
    poses = observation.q.shape[0]
    x, y, z = (np.repeat(axis[:, None], poses, axis=1) for axis in np.eye(3))
    parts = {name: np.asarray(value)[:, None] for name, value in zip(observation.unknowns, unknowns, strict=True)}
    rows = observation.residual(Tips(TIPS[:, :poses], (x, y, z)), parts)
    np.testing.assert_allclose(rows.values, np.atleast_2d(expected), rtol=1e-12, atol=1e-12)
