"""Groups of poses against the others, on linear problems whose least squares can be solved in full."""

import numpy as np
import pytest

from aacmm_jax.diagnostics.equations import Block, contradicting_groups

PARAMETERS = 4


def problem(rng, sizes, error=()):
    """Fixtures of ``sizes`` poses with unknown positions; ``error``: a change of the parameters, by fixture."""
    fixtures = np.repeat(np.arange(len(sizes)), sizes)
    jacobian = rng.normal(size=(len(fixtures), 3, PARAMETERS))
    by_fixture = rng.normal(size=(len(fixtures), 3, 3))
    residual = rng.normal(size=(len(fixtures), 3)) + np.einsum(
        "nak,nk->na", by_fixture, 50.0 + fixtures[:, None] ** [[1, 2, 3]]
    )
    for fixture, size in dict(error).items():
        residual[fixtures == fixture] += size * jacobian[fixtures == fixture].sum(axis=2)
    return residual, jacobian, by_fixture, fixtures


def solved(residual, jacobian, by_fixture, fixtures):
    """Cost and degrees of freedom of the whole least squares, every unknown in one matrix."""
    columns = [jacobian] + [by_fixture * (fixtures == fixture)[:, None, None] for fixture in np.unique(fixtures)]
    matrix = np.concatenate(columns, axis=2).reshape(residual.size, -1)
    _, cost, rank, _ = np.linalg.lstsq(matrix, -residual.reshape(-1), rcond=None)
    return float(cost[0]), residual.size - rank


def found_in(blocks, **options):
    residual, jacobian, by_fixture, fixtures = blocks
    split = []
    for fixture in np.unique(fixtures):
        chosen = fixtures == fixture
        shared, own = (array[chosen].reshape(-1, array.shape[2]) for array in (jacobian, by_fixture))
        split.append(Block(fixture, fixture, residual[chosen].ravel(), shared, own))
    return contradicting_groups(split, **options)


def test_ratios_are_those_of_two_whole_least_squares():
    blocks = problem(np.random.default_rng(0), (6, 9, 8, 10), {1: 3.0})
    cost, degrees_of_freedom = solved(*blocks)
    (worst, *_), *_ = found_in(blocks)
    rest = blocks[3] != worst.group
    rest_cost, spare = solved(*(block[rest] for block in blocks))
    assert worst.group == 1
    assert worst.degrees_of_freedom == (degrees_of_freedom - spare, spare)
    assert worst.ratio == pytest.approx((cost - rest_cost) / (degrees_of_freedom - spare) / (rest_cost / spare))


@pytest.mark.slow
def test_level():
    rng = np.random.default_rng(1)
    found = sum(bool(found_in(problem(rng, (6, 2, 9, 1, 12)), level=0.05)) for _ in range(400))
    assert 5 <= found <= 35  # of 20, with a standard deviation of 4.4


@pytest.mark.parametrize(
    ("sizes", "errors", "expected"),
    [
        ((9,) * 6, {}, []),
        ((9,) * 6, {4: 5.0}, [{4}]),
        ((9,) * 8, {2: 5.0, 5: -4.0}, [{2}, {5}]),  # which hide each other
        ((9, 9), {1: 5.0}, [{0, 1}]),  # either may be wrong
        ((20, 1, 1), {1: 50.0}, []),  # one pose is no contradiction: it moves its own fixture alone
    ],
)
def test_groups_are_found(sizes, errors, expected):
    blocks = problem(np.random.default_rng(2), sizes, errors)
    found = found_in(blocks, least_ratio=3.0)
    assert [{test.group for test in tests} for tests in found] == expected


def test_a_group_without_which_nothing_fixes_the_scale_is_not_tested():
    blocks = problem(np.random.default_rng(0), (6, 9, 8, 10), {1: 3.0})
    assert found_in(blocks, scales=[frozenset({1, 2}), frozenset({2, 3})])[0][0].group == 1
    assert not any(test.group == 1 for tests in found_in(blocks, scales=[frozenset({1, 2})]) for test in tests)
