"""Rest is told from motion and from creep, whatever the hand's tremor is."""

import numpy as np
import pytest

from aacmm_jax.live.samples import Sample
from aacmm_jax.live.stillness import Rest, Stillness

RATE, JOINTS, ENCODER = 100, 6, 1e-5


def smooth(count: int) -> np.ndarray:
    s = np.linspace(0, 1, count)[:, None]
    return 10 * s**3 - 15 * s**4 + 6 * s**5


def rests(readings: np.ndarray, rate: float = RATE) -> list[tuple[int, Rest]]:
    """The sample at which each rest was found, and the rest then."""
    stillness, found, before = Stillness(readings.shape[1]), [], None
    for i, q in enumerate(readings):
        stillness.add(Sample(i / rate, q))
        if before is None and stillness.rest is not None:
            found.append((i, stillness.rest))
        before = stillness.rest
    return found


def visits(
    tremor: float, creep: float, poses: int = 4, seed: int = 0
) -> tuple[np.ndarray, list[tuple[int, np.ndarray]]]:
    """Readings of an arm that goes to poses, creeps there for a second (radians a second), and rests; and the first
    sample of every rest, with the true readings."""
    random, parts, begins, q = np.random.default_rng(seed), [], [], np.zeros(JOINTS)
    for number in range(poses):
        goal = random.uniform(-0.5, 0.5, JOINTS)
        parts.append(q + smooth(80) * (goal - q))
        q = goal
        if creep and number > 1:
            parts.append(q + np.arange(1, 101)[:, None] / RATE * creep * random.choice([-1, 1], JOINTS))
            q = parts[-1][-1]
        begins.append((sum(map(len, parts)), q))
        parts.append(np.tile(q, (150, 1)))
    path = np.concatenate(parts)
    times, phase = np.arange(len(path))[:, None] / RATE, random.uniform(0, 6, JOINTS)
    shaken = tremor * ENCODER * np.sqrt(2) * np.sin(2 * np.pi * random.uniform(8, 12, JOINTS) * times + phase)
    return path + shaken + ENCODER * random.normal(size=path.shape), begins


@pytest.mark.first_rows(1)
@pytest.mark.parametrize(
    "tremor", [3.0, pytest.param(10.0, marks=pytest.mark.slow), pytest.param(30.0, marks=pytest.mark.slow)]
)
def test_every_rest_is_found_soon_and_no_creep_is(tremor: float) -> None:
    for creep in (0.0, 10 * tremor * ENCODER):
        readings, begins = visits(tremor, creep)
        found = rests(readings)
        assert len(found) == len(begins)
        for number, ((at, rest), (begin, q)) in enumerate(zip(found, begins, strict=True)):
            late = (at - begin) / RATE
            assert 0.1 < late < (1.2 if number < 1 else 0.75 if creep else 0.4)
            np.testing.assert_allclose(rest.q, q, atol=1.5 * tremor * ENCODER)


@pytest.mark.parametrize("creep", [4.0, pytest.param(8.0, marks=pytest.mark.slow)])
def test_a_slow_creep_is_refused_or_does_not_matter(creep: float) -> None:
    """Drift in 0.3 s, in standard deviations of the tremor; a take states where the arm is within one of these."""
    tremor = 10.0
    readings, begins = visits(tremor, creep * tremor * ENCODER / 0.3)
    for at, rest in rests(readings):
        following = next(q for begin, q in begins if at < begin + 150)
        away = rest.q - following
        assert np.sqrt(np.mean(away**2)) < tremor * ENCODER
        np.testing.assert_allclose(rest.u, tremor * ENCODER, rtol=0.5)


def test_a_thousand_samples_a_second_are_the_same_rests() -> None:
    readings, begins = visits(10.0, 0.0, poses=2)
    often = np.repeat(readings, 10, axis=0) + ENCODER * np.random.default_rng(1).normal(size=(10 * len(readings), 6))
    found = rests(often, 1000.0)
    assert len(found) == len(begins)
    assert all(0.1 < at / 1000 - begin / RATE < 1.2 for (at, _), (begin, _) in zip(found, begins, strict=True))


def test_a_counter_without_noise() -> None:
    step = 2 * np.pi / 4096
    path = np.concatenate([smooth(100) * np.array([[0.7, -0.4]]), np.tile([0.7, -0.4], (120, 1))])
    found = rests(np.round(path / step) * step, 50.0)
    assert len(found) == 1
    assert found[0][0] > 95
    # A slow creep, one step in 0.1 s.
    creep = np.arange(300)[:, None] / 50 * 10 * step * np.ones(2)
    assert not rests(np.round(creep / step) * step, 50.0)


def test_gaps_and_late_samples_begin_anew() -> None:
    stillness, random = Stillness(2), np.random.default_rng(0)
    for time in np.arange(0, 2, 0.01):
        stillness.add(Sample(time, 1e-5 * random.normal(size=2)))
    assert stillness.rest is not None
    stillness.add(Sample(1.0, np.ones(2)))  # earlier: left out
    assert stillness.rest is not None
    stillness.add(Sample(9.0, np.zeros(2)))
    assert stillness.rest is None
