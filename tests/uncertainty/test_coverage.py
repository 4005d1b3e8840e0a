"""The coverage of every U is stated in one place, and numbers and words follow it."""

import json
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from aacmm_jax.uncertainty.coverage import in_percent

PACKAGE = Path(__file__).resolve().parents[2] / "aacmm_jax"

# What is 0.95 or 95 % in the package and is not the coverage probability of U: module -> how often. After another level
# has been written in its one place, such a literal elsewhere would still be what this table says.
OTHERS = {
    "acceptance/judgement.py": 4,  # the probability of conformity of ISO 14253-1:2017
    "cli/result_commands.py": 1,  # ISO 14253-1:2017
    "drift/statistics.py": 3,  # power of the test of a change
    "study/finding.py": 1,  # percentile of a study
    "data/targets.py": 2,  # size of a marker, of that of its square
    "diagnostics/joint_travel.py": 2,  # of poses that are as near to another one
    "diagnostics/corrections.py": 1,  # least improvement by another reading of a file
    "drift/results.py": 1,  # a number that rounds to 1
    "model/robust.py": 4,  # the efficiency of a loss, and a point of chi-square
    "planning/problem.py": 1,  # part of the reach
    "planning/usual.py": 1,  # the same
    "plot/study.py": 2,  # percentiles of trials
    "study/tables.py": 1,  # the same
    "summaries/calibration.py": 1,  # a correlation
    "summaries/drift.py": 1,  # a percentile of lengths
    "uncertainty/variance_components.py": 1,  # a point of chi-square
    "uncertainty/volume.py": 1,  # a percentile of positions
}

# The package as it is where another level is written in its one place, and some commands of that package.
EDITED = r"""
import importlib.util, json, re, sys

name = "aacmm_jax.uncertainty.coverage"
specification = importlib.util.find_spec(name)
with open(specification.origin) as file:
    source = file.read()
source, count = re.subn(r"^LEVEL = .*$", "LEVEL = 0.99", source, flags=re.MULTILINE)
assert count == 1
module = importlib.util.module_from_spec(specification)
exec(source, vars(module))
sys.modules[name] = module

from aacmm_jax.cli import main

for arguments in json.loads(sys.argv[1]):
    sys.argv = ["aacmm", *arguments]
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, (arguments, ended.code)
"""


@pytest.mark.parametrize(("level", "words"), [(0.95, "95 %"), (0.99, "99 %"), (0.9545, "95.45 %"), (0.5, "50 %")])
def test_a_level_in_words(level, words):
    assert in_percent(level) == words


def test_no_other_place_states_the_coverage():
    pattern, stated = re.compile(r"(?<![\d.])(?:95(?: |\\u00a0|\\xa0|&nbsp;|\u00a0)?%|0\.95(?!\d))"), Counter()
    for path in PACKAGE.rglob("*"):
        if path.suffix in (".py", ".html", ".js") and path != PACKAGE / "uncertainty/coverage.py":
            stated[path.relative_to(PACKAGE).as_posix()] += len(pattern.findall(path.read_text()))
            assert not re.search(r"k = 2\b|coverage factor 2\b", path.read_text()), path
    assert {name: count for name, count in stated.items() if count} == OTHERS


@pytest.mark.slow
def test_where_another_level_is_stated_numbers_and_words_follow(tmp_path, cache):
    known = ("--encoder-arcsec", "2", "--seating-mm", "0.005")
    sockets = ("--socket", "A=400,200,300", "--socket", "B=600,200,300", "--socket", "C=500,400,400")
    lengths = ("--length", "A,B,0.002", "--length", "A,C,0.002")
    commands = [
        ("simulate", "cheng2018-simulation", "-o", "capture.h5", *sockets, "--poses", "20", *lengths, *known),
        ("calibrate", "capture.h5", "-o", "c.h5", *known, "--without", "C", "--method", "joint"),
        ("evaluate", "c.h5", "capture.h5"),
        ("compare", "c.h5", "c.h5"),
        ("compare", "--help"),
        ("report", "c.h5", "-o", "report.html"),
    ]
    command = [sys.executable, "-c", EDITED, json.dumps(commands)]
    environment = os.environ | {"XDG_CACHE_HOME": str(cache), "COLUMNS": "200"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert not done.returncode, done.stdout + done.stderr
    printed, page = done.stdout, (tmp_path / "report.html").read_text()
    for text in (
        "U (99 %) of a measured length",
        "Expanded uncertainty U over all joint limits (99 %, coverage factor 2.58)",
        "Reference lengths [mm]; U: 99 %",
        "changed by more than their expanded uncertainty (99 %; ",
        "[default: 0.99]",
    ):
        assert text in printed, text
    for text in ("for a coverage of 99 % (coverage factor 2.58)", "U (99 %)", "with U (99 %)", "(99\u00a0%)"):
        assert text in page, text
    assert re.findall(r".{40}(?<![\d.])95(?: |\u00a0|&nbsp;)%", printed + page) == []
