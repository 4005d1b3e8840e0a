"""The day by which the next calibration is due."""

import datetime

import pytest

import aacmm_jax as aj

YEARS = [datetime.datetime(2024 + i, 1, 1, tzinfo=datetime.UTC) for i in range(3)]


@pytest.mark.parametrize(
    ("changes", "limit", "after", "capped"),
    [
        ([0.010, 0.020], 0.005, 182.6, False),  # half a year at 10 um a year
        ([0.010, 0.020], 0.1, 731, True),  # no farther than the arm was observed
        ([0.0, 0.0], 0.005, 731, True),
        ([float("nan"), 0.020], 0.005, 182.6, False),
    ],
)
def test_it_is_when_lengths_have_changed_by_the_limit(changes, limit, after, capped):
    due = aj.drift.next_due(YEARS, changes, limit)
    assert due is not None
    assert (due.date - YEARS[-1]).total_seconds() / 86400 == pytest.approx(after, abs=0.5)
    assert due.capped is capped


@pytest.mark.parametrize(
    ("dates", "changes", "limit"),
    [(YEARS[:1] * 3, [0.01, 0.02], 0.005), (YEARS, [float("nan")] * 2, 0.005), (YEARS, [0.01, 0.02], 0.0)],
)
def test_nothing_is_said_where_nothing_shows_it(dates, changes, limit):
    assert aj.drift.next_due(dates, changes, limit) is None
