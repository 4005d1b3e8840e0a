"""The order of poses: never longer than the given one, group after group, and nearly the best."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import aacmm_jax as aj
from aacmm_jax.planning import motion
from aacmm_jax.planning.motion import joint_weights, short_order, travel
from tests.example_counts import example_count

WEIGHTS = np.array([1.0, 0.5, 0.1])


def problem(seed: int, count: int, groups: int):
    random = np.random.default_rng(seed)
    return random.uniform(-2, 2, (count, 3)), random.integers(groups, size=count)


def contiguous(groups) -> bool:
    return len([key for key, _ in itertools.groupby(groups)]) == len(set(groups.tolist()))


@settings(max_examples=example_count(20))
@given(st.integers(0, 10**6), st.integers(1, 14), st.integers(1, 4))
def test_an_order_is_a_permutation_group_after_group_and_never_longer(seed, count, groups):
    q, owner = problem(seed, count, groups)
    order = short_order(q, owner, WEIGHTS)
    assert sorted(order) == list(range(count))
    assert contiguous(owner[order])
    assert travel(q[order], WEIGHTS) <= travel(q[np.argsort(owner, kind="stable")], WEIGHTS) + 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_nearly_the_best_of_all_orders(seed):
    q, owner = problem(seed, 7, 3)
    orders = (list(order) for order in itertools.permutations(range(7)))
    best = min(travel(q[order], WEIGHTS) for order in orders if contiguous(owner[order]))
    assert travel(q[short_order(q, owner, WEIGHTS)], WEIGHTS) <= 1.05 * best


def test_a_blocked_move_is_avoided_where_there_is_another_way():
    q = np.linspace(0, 1, 6)[:, None] * np.ones(3)
    order = short_order(q, np.zeros(6, dtype=int), WEIGHTS, blocked=[(2, 3)])
    assert {2, 3} not in [set(pair) for pair in itertools.pairwise(order)]
    alone = short_order(q[:2], np.zeros(2, dtype=int), WEIGHTS, blocked=[(0, 1)])
    assert sorted(alone) == [0, 1]


def test_many_poses_are_ordered_from_one_start(monkeypatch):
    monkeypatch.setattr(motion, "_MANY", 20)
    q, owner = problem(0, 60, 3)
    order = short_order(q, owner, WEIGHTS)
    assert sorted(order) == list(range(60))
    assert contiguous(owner[order])
    assert travel(q[order], WEIGHTS) < travel(q[np.argsort(owner, kind="stable")], WEIGHTS)


def test_a_joint_counts_by_what_it_carries():
    """Lengths of 100 and 50 and a probe of 30 mm: 180, 80 and 30 mm beyond the joints; an offset along the axis not."""
    arm = aj.Arm(alpha=[0, 0, 0], a=[100, 50, 0], d=[400, 0, 0], probe=(0, 0, 30))
    np.testing.assert_allclose(joint_weights(arm), [1.0, 80 / 180, 30 / 180])
