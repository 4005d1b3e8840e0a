"""Observations of one kind evaluated together: each pose with a column of unknowns and stated numbers of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from aacmm_jax.core.numpy_or_jax import to_numpy
from aacmm_jax.data import observations as kinds
from aacmm_jax.data.observations.observation import Tips

from .test_observations import ALL, POSES, TIPS, unknowns_of

COUNTS = (4, 1, 6)  # poses of each observation
ENDS = np.cumsum(COUNTS)
SLICES = [slice(end - m, end) for end, m in zip(ENDS, COUNTS, strict=True)]
RANDOM = np.random.default_rng(5)
SHIFT = RANDOM.normal(size=(1, POSES))
TRANSFORMS = ALL["transforms"]
COVARIANCES = RANDOM.normal(size=(3, 3, 3))


def several(make):
    """Three observations, by the number of each and its readings."""
    return to_numpy([make(i, f"x{i}", RANDOM.normal(size=(m, 6))) for i, m in enumerate(COUNTS)])


def transforms(i, name, q):
    covariance = COVARIANCES[i] @ COVARIANCES[i].T
    points, rotations = TRANSFORMS.points[SLICES[i]], TRANSFORMS.rotations[SLICES[i]]
    return kinds.MeasuredTransforms(name, q, points, rotations, u_angle=1e-3 * (1 + i), covariance=covariance)


def points(i, name, q):
    return kinds.MeasuredPoints(name, q, 300 * RANDOM.normal(size=(len(q), 3)), covariance=np.diag([1, 2, 3 + i]))


def distances(i, name, q):
    return kinds.Distances(name, q, RANDOM.uniform(100, 900, len(q)), u=0.1 * (1 + i), constant=True)


def cylinder(i, name, q):
    return kinds.Cylinder(name, q, diameter=40 + i, stylus=i, inside=True, form=0.01 * (1 + i))


def shifted(i, name, q):
    sphere = kinds.Sphere(name, q, diameter=50 + i)
    return sphere.with_errors(q, RANDOM.normal(size=(1, len(q))), {})


STACKS = {
    "socket": several(lambda i, name, q: kinds.Socket(name, q)),
    "sphere": several(lambda i, name, q: kinds.Sphere(name, q)),
    "exact sphere": several(lambda i, name, q: kinds.Sphere(name, q, diameter=50 + i, stylus=2 * i)),
    "certified sphere": several(lambda i, name, q: kinds.Sphere(name, q, diameter=50 + i, u=0.1 + i)),
    "plane": several(lambda i, name, q: kinds.Plane(name, q, form=0.01 * (1 + i))),
    "cylinder": several(lambda i, name, q: kinds.Cylinder(name, q)),
    "exact cylinder": several(cylinder),
    "distances": several(distances),
    "points": several(points),
    "transforms": several(transforms),
    "shifted": several(shifted),
}
SPHERES = [ALL[name] for name in ("sphere", "certified sphere", "exact sphere")]
SEEN = unknowns_of(to_numpy(TRANSFORMS))


def test_every_kind_that_stacks_is_here():
    """A new kind that is alike others needs a row."""
    assert {one.kind for one in ALL.values() if one.alike is not None} == {row[0].kind for row in STACKS.values()}


def tips_of(poses):
    return Tips(TIPS.position[:, poses], tuple(axis[:, poses] for axis in TIPS.axes))


def some_unknowns(observation, seed):
    """A column each; orientations near those that were measured, so that what is left is less than a right angle."""
    random = np.random.default_rng(seed)
    middle = (
        [SEEN[name] for name in TRANSFORMS.unknowns] if observation.rows == 6 else [0.0] * len(observation.unknowns)
    )
    found = {}
    for (name, units), mean in zip(observation.unknowns.items(), middle, strict=True):
        sizes = np.array([[0.2] if unit == "rad" else [50.0] for unit in units])
        found[name] = mean + sizes * random.normal(size=(len(units), 1))
    return found


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("library", [np, jnp], ids=["numpy", "jax"])
@pytest.mark.parametrize("name", STACKS)
def test_a_stack_is_what_its_observations_are(name, library):
    """Residuals, derivatives and covariances, though unknowns and stated numbers differ."""
    observations = STACKS[name]
    assert len({one.alike for one in observations}) == 1
    assert observations[0].alike is not None
    stack = type(observations[0]).stacked(observations)
    unknowns = [some_unknowns(one, seed) for seed, one in enumerate(observations)]
    # By the names of the first, in the order of the unknowns.
    repeated = [[np.repeat(v, m, axis=1) for v in own.values()] for own, m in zip(unknowns, COUNTS, strict=True)]
    columns = [np.concatenate(values, axis=1) for values in zip(*repeated, strict=True)]
    columns = dict(zip(stack.unknowns, columns, strict=True))
    tips = tips_of(slice(0, ENDS[-1]))
    evaluate = type(stack).residual_with_errors
    residual = evaluate if library is np else jax.jit(evaluate)
    rows = residual(*jax.tree.map(library.asarray, (stack, tips, columns)))
    parts = [
        one.residual_with_errors(tips_of(poses), own)
        for one, poses, own in zip(observations, SLICES, unknowns, strict=True)
    ]
    for field in ("values", "by_tip", "by_rotation"):
        if getattr(parts[0], field) is not None:
            expected = np.concatenate([getattr(part, field) for part in parts], axis=-1)
            np.testing.assert_allclose(getattr(rows, field), expected, atol=1e-9, err_msg=field)
    np.testing.assert_allclose(rows.measured, np.concatenate([part.measured for part in parts]), atol=1e-12)
    for names in zip(*(one.unknowns for one in observations), strict=True):
        expected = [part.by_unknowns[name] for part, name in zip(parts, names, strict=True)]
        np.testing.assert_allclose(rows.by_unknowns[names[0]], np.concatenate(expected, axis=-1), atol=1e-9)


@pytest.mark.first_rows(1)
@pytest.mark.parametrize("name", [*ALL, "shifted"])
def test_derivatives_are_those_of_jax(name):
    """By unknowns that all poses share and by those of each pose, which are equal here; also under vmap."""
    known = to_numpy(ALL[name] if name in ALL else ALL["plane"].with_errors(ALL["plane"].q, SHIFT, {}))
    observation, tips = jax.tree.map(jnp.asarray, (known, TIPS))
    shared = {part: unknowns_of(known)[part] for part in known.unknowns}
    # What is reduced has derivatives of its squares only: `test_reduced_rows`.
    method = "residual" if known.reduces else "residual_with_errors"
    rows = getattr(known, method)(TIPS, shared)

    def values(unknowns):
        return getattr(observation, method)(tips, unknowns).values

    of_each = {part: np.repeat(value, POSES, axis=1) for part, value in shared.items()}
    alone = jax.jit(jax.jacfwd(values))(jax.tree.map(jnp.asarray, shared))
    own = jax.jit(jax.jacfwd(values))(jax.tree.map(jnp.asarray, of_each))
    one = jax.jit(jax.vmap(getattr(observation, method), (None, 0)))(
        tips, jax.tree.map(lambda v: jnp.stack([v, v]), of_each)
    )
    for part, expected in rows.by_unknowns.items():
        tolerance = 1e-9 * np.abs(expected).max()
        np.testing.assert_allclose(np.moveaxis(alone[part][..., 0], -1, 0), expected, atol=tolerance)
        diagonal = np.einsum("rmkm->krm", own[part])
        np.testing.assert_allclose(diagonal, expected, atol=tolerance)
        np.testing.assert_allclose(one.by_unknowns[part][1], expected, atol=tolerance)
    np.testing.assert_allclose(one.values[1], rows.values, atol=1e-9)
    np.testing.assert_allclose(one.measured[1], rows.measured, atol=1e-12)


@pytest.mark.first_rows(17)
@pytest.mark.parametrize("name", ALL)
def test_what_is_linear_has_derivatives_that_depend_on_nothing(name):
    observation = to_numpy(ALL[name])
    first = {part: unknowns_of(observation)[part] for part in observation.unknowns}
    moved = {part: value + 0.1 for part, value in first.items()}
    tips = TIPS._replace(position=1.1 * TIPS.position)
    both = observation.residual_with_errors(TIPS, first), observation.residual_with_errors(tips, moved)
    constant = all(np.array_equal(both[0].by_unknowns[part], both[1].by_unknowns[part]) for part in first)
    assert observation.linear == constant == (name == "socket")
    assert observation.with_errors(observation.q, 0 * both[0].values, {}).linear == constant


def test_only_those_are_alike_that_have_the_same_rows():
    """What decides by a mean over its poses, has points of its own, or many rows, is alone."""
    assert {name for name, one in ALL.items() if one.alike is None} == {
        "planes", "exact planes", "artefact", "indexed artefact",
        "camera on the arm", "fixed camera", "fisheye", "fixed fisheye", "stereo rig",
    }  # fmt: skip
    assert len({one.alike for one in SPHERES}) == len(SPHERES)
    inside = [kinds.Cylinder("c", ALL["plane"].q, diameter=50, inside=inside).alike for inside in (False, True)]
    assert inside[0] != inside[1]


@pytest.mark.parametrize("name", [name for name, one in ALL.items() if one.alike is not None])
def test_every_number_of_a_kind_that_stacks_is_stacked(name):
    """A field that is neither by pose nor stated would be that of the first observation."""
    observation = ALL[name]
    arrays = {field for field, value in vars(observation).items() if isinstance(value, (np.ndarray, jax.Array))}
    assert arrays <= {*observation.by_pose, *observation.stated}
