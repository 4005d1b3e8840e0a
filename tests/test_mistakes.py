"""The bench of mistakes: its tables are complete, its captures are exact but for the mistake, and a row of it runs."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))
from mistakes.cases import CASES  # noqa: E402
from mistakes.judge import applies, detection_limit, made, rank_of, run, shown  # noqa: E402
from mistakes.kinds import KINDS  # noqa: E402


def test_there_are_forty_mistakes_and_eight_cases():
    assert (len(KINDS), len(CASES)) == (40, 8)
    assert all(sum(applies(kind, case) for case in CASES) >= 3 for kind in KINDS)
    assert {kind.unit for kind in KINDS.values()} == {"angle", "length", "share", "times", ""}


@pytest.mark.slow
@pytest.mark.parametrize("case", ["arm6-sockets", "irb-bar"])
def test_every_mistake_changes_its_capture_and_names_its_culprit(case, tmp_path):
    """The patterns of right findings need the names that the mistake was made with."""
    unchanged = written(None, case, tmp_path / "sound")
    for number, (name, kind) in enumerate(KINDS.items()):
        if applies(name, case):
            trial, files = written(name, case, tmp_path / str(number))
            assert files != unchanged[1], name
            patterns = [pattern.format(**trial.culprit) for pattern in kind.right]
            assert patterns, name
            assert all(re.compile(pattern) for pattern in patterns)


def written(name, case, folder):
    folder.mkdir()
    trial, _ = made(name, case, 0.01, 0, False, folder)
    return trial, {path.name: path.read_text() for path in folder.iterdir()}


@pytest.mark.slow
def test_only_the_mistake_is_in_the_residuals_of_an_exact_capture():
    """Without a mistake there are none; with one, their squares grow as its size does, so that it has a limit."""
    assert shown(None, "arm6-sockets", 0.0)[0] < 1e-9
    (small, _), (large, _) = (shown("eccentric", "arm6-sockets", size) for size in (2e-5, 4e-5))
    assert large / small == pytest.approx(4.0, rel=0.02)
    limit = detection_limit("eccentric", "arm6-sockets")
    squares, degrees_of_freedom = shown("eccentric", "arm6-sockets", limit)
    # A chi-square test at 1 % needs about this non-centrality (normal approximation) to reject half of the time.
    assert squares == pytest.approx(2.33 * np.sqrt(2 * degrees_of_freedom), rel=0.1)
    assert np.isnan(detection_limit("wrong sign", "arm6-sockets"))


@pytest.mark.slow
def test_poses_are_named_as_findings_name_them():
    row = run("reading mistyped", "arm6-sockets", 2e-3)
    assert row["culprit"]["pose"] == "B pose 5"
    (finding,) = (text for text in row["findings"] if text.startswith("outlying-poses"))
    assert finding.endswith("[B pose 5]")
    assert rank_of(row | {"kind": "reading mistyped"}) is not None


@pytest.mark.slow
def test_a_row_runs_and_is_resumed(tmp_path):
    results = tmp_path / "rows.jsonl"
    command = [sys.executable, BENCHMARKS / "mistakes", "--case", "panda-plate", "--processes", "1"]
    command += ["--results", results, "--kind", "wrong sign", "--kind", "slipped zero"]
    printed = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    rows = [json.loads(line) for line in results.read_text().splitlines()]
    assert [row["kind"] for row in rows] == ["wrong sign", "slipped zero"]
    assert printed[0] == printed[1]
    assert rank_of(rows[0]) == 1
    assert rows[0]["severity"] == "unusable"
