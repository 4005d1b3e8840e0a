"""What a terminal of any width shows, and what is refused before any work: in this process, which starts no other."""

import io
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from typer.main import get_command
from typer.testing import CliRunner

import aacmm_jax as aj
from aacmm_jax.cli import _FAMILIES, views
from aacmm_jax.cli.app import app, examples
from aacmm_jax.cli.display import display, new_console, print_table
from aacmm_jax.cli.options import length_option
from aacmm_jax.summaries.calibration import calibration_summary
from aacmm_jax.summaries.result_tables import base_table
from aacmm_jax.summaries.tables import formatted, listed, observed_words
from tests.example_counts import example_count
from tests.refusals import assert_refused

for family in _FAMILIES:
    import_module(f"aacmm_jax.cli.{family}")
COMMANDS = get_command(app).commands


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("columns", [60, 80, 120])
@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_every_option_whole(monkeypatch, capsys, command, columns):
    """The names of options carry their units, so none may be cut; only examples are not wrapped, so as to be copied."""
    monkeypatch.setenv("COLUMNS", str(columns))
    get_command(app).main([command, "--help"], "aacmm", standalone_mode=False)
    shown = capsys.readouterr().out
    head, _, tail = shown.partition("\n  Example")
    assert f"aacmm {command} " in tail
    words = head.replace(",", " ").split()
    for parameter in COMMANDS[command].params:
        for name in (*parameter.opts, *parameter.secondary_opts) if parameter.param_type_name == "option" else ():
            assert any(name in word.split("/") for word in words), name
    assert max(map(len, head.splitlines())) <= columns


@pytest.mark.slow
def test_help_lists_every_command_whole(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    get_command(app).main(["--help"], "aacmm", standalone_mode=False)
    shown = capsys.readouterr().out
    assert all(f"\n  {command} " in shown for command in COMMANDS)
    assert "..." not in shown.partition("Commands:")[2]


def test_examples_are_printed_a_line_each():
    assert examples("aacmm a \\\n  --b", "aacmm c") == "\b\nExamples:\n  aacmm a \\\n    --b\n  aacmm c"


cells = st.text("abcxyz0189.-", min_size=1, max_size=8)
texts = st.lists(cells, min_size=1, max_size=6).map(" ".join)


@given(st.integers(30, 200), st.data())
@settings(max_examples=example_count(20))
def test_nothing_in_a_table_is_cut(columns, data):
    """Each word of each cell is printed whole, in lines that are not wider than the console."""
    count = data.draw(st.integers(2, 8))
    rows = data.draw(st.lists(st.lists(texts, min_size=count, max_size=count), min_size=1, max_size=4))
    stream = io.StringIO()
    print_table(Console(file=stream, width=columns, highlight=False), listed("", rows[1:], rows[0]))
    lines = stream.getvalue().splitlines()
    printed = [word for line in lines for word in line.split()]
    assert all(word in printed for row in rows for cell in row for word in cell.split())
    assert max(map(len, lines)) <= columns


@pytest.mark.parametrize(("given_columns", "width"), [("72", 72), ("200", 200), (None, 110), ("0", 110)])
def test_what_is_piped_is_as_wide_as_asked(monkeypatch, given_columns, width):
    monkeypatch.delenv("COLUMNS", raising=False)
    if given_columns:
        monkeypatch.setenv("COLUMNS", given_columns)
    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert new_console().width == width


POINTS = {"points": 9, "sockets": 2, "lengths": 1, "spheres": 0, "warnings": [], "u_test_mm": 0.0, "influences": {}}
TEST = {
    "called": "ISO 10360-12:2016",
    "title": "articulated arms",
    "missing": [],
    "rule": "ISO 14253-1",
    "decision": None,
}
NAMES = ("Volumetric performance, 2 RMS", "Volumetric performance, largest", "E_Uni", "L_Dia.5x5:Art:Tact.AArm")


def test_acceptance_at_80_columns(monkeypatch, capsys):
    """Every result by its whole name, with every number."""
    monkeypatch.setenv("COLUMNS", "80")
    numbers = {"value_mm": 0.0312, "nominal_mm": 12.3456, "expanded_mm": 0.0021, "limit_mm": 0.0415}
    parts = {"failing": 2, "parts": [None] * 7, "decision": "undecided", "where": "500 mm bar at position 3, repeat 2"}
    parts |= {"nominal_decision": "fails", "what": "error"}
    test = TEST | {"missing": ["5 lengths"], "figures": [{"symbol": name} | numbers | parts for name in NAMES]}
    display(views.points(POINTS | {"acceptance": [test]}))
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    words = shown.split()
    for text in (*NAMES, "12.3456 0.0312 0.0021 0.0415 undecided (2 of 7) position 3, repeat"):
        assert all(word in words for word in text.split()), text
    assert "..." not in shown
    assert "…" not in shown


@pytest.mark.parametrize(("limit", "decision", "said"), [(0.0415, "conforms", True), (None, None, False)])
def test_a_decision_rule_is_named_only_where_there_is_a_limit(monkeypatch, capsys, limit, decision, said):
    monkeypatch.setenv("COLUMNS", "200")
    metric = {
        "symbol": "E_Uni",
        "what": "error",
        "value_mm": 0.03,
        "nominal_mm": None,
        "expanded_mm": 0.002,
        "limit_mm": limit,
    }
    metric |= {"decision": decision, "failing": 0, "parts": [], "where": ""}
    test = TEST | {"decision": decision, "figures": [metric]}
    display(views.points(POINTS | {"acceptance": [test]}))
    assert ("ISO 14253-1" in capsys.readouterr().out) == said


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::aacmm_jax.core.errors.IdentifiabilityWarning")
def test_a_residual_that_no_arm_has_is_not_called_converged():
    """Positions and quaternions read as joint readings: every solve ends, and nothing was calibrated."""
    rng = np.random.default_rng(0)
    nominal = aj.files.load_specification("cheng2018-simulation")
    q = [rng.uniform(-1, 1, (40, 6)) for _ in range(2)]
    capture = aj.Capture({"A": q[0], "B": q[1]}, [aj.ReferenceLength("A", "B", 200.0, 0.01)])
    result = aj.calibrate(nominal.arm, capture, nominal.bounds())
    record = aj.calibration.record_of(result, aj.Recording(capture, nominal))
    assert record.implausible_residual
    summary = calibration_summary(record)
    assert any("mm is plausible for this arm" in warning for warning in summary["warnings"])
    assert not summary["residual_plausible"]
    assert not any("determine" in warning for warning in summary["warnings"])


@pytest.mark.parametrize(
    ("converged", "plausible", "scale", "said", "unsaid"),
    [
        (True, True, True, ": converged in 3 steps", "no arm has"),
        (True, False, True, "ended with residuals that are too large for this arm, in 3 steps", "converged"),
        (False, False, True, "did not converge in 3 steps", "no arm has"),
        (False, True, False, "ended with a scale that is not plausible in 3 steps", "converge"),
    ],
)
def test_verdict(capsys, converged, plausible, scale, said, unsaid):
    summary = {"arm": "arm", "method": "joint", "steps": 3, "poses": 9, "sockets_used": ["A"], "observations": []}
    summary |= {"converged": converged, "residual_plausible": plausible, "scale_plausible": scale}
    display([views.solve(summary)])
    shown = " ".join(capsys.readouterr().out.split())
    assert said in shown
    assert unsaid not in shown


@pytest.mark.parametrize(
    ("counts", "words"),
    [
        ((2, 0, 1), "2 sockets, 1 reference length"),
        ((1, 0, 0), "1 socket, 0 reference lengths"),
        ((1, 4, 0), "1 socket, 4 other observations"),
        ((0, 1, 0), "1 observation"),
        ((18, 0), "18 sockets"),
        ((0, 3), "3 observations"),
    ],
)
def test_what_was_observed_in_words(counts, words):
    assert observed_words(*counts) == words


def test_base_has_its_units_and_the_digits_of_its_uncertainty(capsys):
    row = {"in": "tracker", "position_mm": [507.922315, 1.0, 2.0], "position_u_mm": [0.08, 0.0031, None]}
    row |= {"rotation_rad": [0.1, 0.0, 0.0], "rotation_u_rad": [1e-3, 1e-3, 1e-3]}
    display([base_table([row], 2.0)])
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["tracker", "position", "[mm]", "507.92", "1.0000", "2.0000"] in shown
    assert ["U", "0.16", "0.0062", "-"] in shown
    assert ["rotation", "vector", "[deg]", "5.73", "0.00", "0.00"] in shown


EXISTING = ("there.h5", "there.toml", "there.csv", "there.html")
MISSING = [
    ("import", "no.toml", "-o", "there.h5"),
    ("simulate", "no.toml", "-o", "there.h5", "--socket", "A=1,2,3"),
    ("simulate", "panda", "--true-arm", "no.toml", "-o", "there.h5", "--socket", "A=1,2,3"),
    ("calibrate", "no.h5", "-o", "there.h5"),
    ("evaluate", "no.h5", "there.h5", "-o", "new.h5"),
    ("evaluate", "no.h5", "no.h5", "-o", "there.h5"),
    ("evaluate", "no.toml", "-o", "there.h5"),
    ("report", "no.h5", "-o", "there.html"),
    ("report", "there.h5", "--about", "no.toml", "-o", "there.html"),
    ("export", "no.h5", "-o", "there.toml"),
    ("export", "no.h5", "--format", "dcc", "--about", "there.toml", "-o", "new.xml"),
    ("study", "no.toml", "-o", "new.h5"),
    ("study", "no.toml", "-o", "there.h5"),
    ("study", "--resume", "-o", "no.h5"),
    ("plan", "no.toml", "-o", "there.csv"),
    ("plan", "no.toml", "--acceptance", "iso", "-o", "there.csv", "--manifest", "there.toml"),
    ("compare", "no.h5", "there.h5", "--csv", "there.csv"),
    ("compare", "no.h5", "no2.h5", "--figure", "there.png"),
    ("show", "no.h5"),
    ("show", "no.toml"),
]


@pytest.mark.parametrize("arguments", MISSING, ids=" ".join)
def test_a_missing_input_is_named_whether_or_not_the_output_exists(run, tmp_path, arguments):
    for name in EXISTING:
        (tmp_path / name).touch()
    error = run(*arguments).exception
    assert isinstance(error, aj.InputError), error  # exit code 2 and one sentence, by `aacmm_jax.cli.main`
    assert "does not exist" in str(error)
    assert "no" in str(error).split(" ")[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(EXISTING)
    assert all((tmp_path / name).stat().st_size == 0 for name in EXISTING)


SAME = [
    ("import", "there.toml", "-o", "there.toml"),
    ("simulate", "there.toml", "-o", "there.toml", "--socket", "A=1,2,3"),
    ("calibrate", "there.h5", "-o", "there.h5"),
    ("calibrate", "there.h5", "-o", "new.h5", "--figure", "there.h5"),
    ("evaluate", "there.h5", "no.h5", "-o", "there.h5"),
    ("evaluate", "there.toml", "-o", "there.toml"),
    ("report", "there.h5", "-o", "there.h5"),
    ("export", "there.h5", "-o", "there.h5"),
    ("plan", "there.toml", "-o", "there.toml"),
    ("compare", "there.h5", "no.h5", "--csv", "there.h5"),
]


REFUSED = [
    (("calibrate", "there.h5", "-o", "x.h5", "--figure", "x.txt"), "a figure cannot be written as x.txt"),
    (("export", "there.h5", "--format", "csv", "--arm", "true"), "--arm applies to --format toml"),
    (
        ("evaluate", "there.h5", "there.h5", "--mpe", "zzz=1"),
        "names the unknown metric 'zzz'; choose one of " + ", ".join(aj.acceptance.METRICS),
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "said"), REFUSED, ids=lambda value: value[-1])
def test_options_are_refused_before_any_work(run, tmp_path, arguments, said):
    (tmp_path / "there.h5").touch()
    error = run(*arguments).exception
    assert isinstance(error, aj.InputError), error
    assert said in str(error)


def test_a_bound_given_twice(run):
    run("simulate", "panda", "-o", "c.h5", "--socket", "A=400,0,300", "--poses", 2)
    error = run("calibrate", "c.h5", "-o", "x.h5", "--bound", "d_3=1", "--bound", "d_3=2").exception
    assert "--bound is given twice for 'd_3'" in str(error)


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (1e-12, "0.0000"), (0.25, "0.2500"), (1e-5, "1.0e-05"), (1e300, "1e+300"), (-2.5e9, "-2.5e+09")],
)
def test_numbers_of_any_size(value, text):
    assert formatted(value) == text


@pytest.mark.parametrize("arguments", SAME, ids=" ".join)
def test_an_input_is_never_overwritten(run, tmp_path, arguments):
    for name in EXISTING:
        (tmp_path / name).touch()
    error = run(*arguments).exception
    assert isinstance(error, aj.InputError), error
    assert "choose another output" in str(error)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("A,B", ("A", "B")), ("A,B,0.002", ("A", "B", 0.002)), ('"plate, left",B,0.1', ("plate, left", "B", 0.1))],
)
def test_a_length_between_any_two_names(text, expected):
    assert length_option(text) == expected


@pytest.mark.parametrize("text", ["A", "", "A,B,u", "A,B,1,2", ",B"])
def test_what_is_no_length(text):
    assert_refused(lambda: length_option(text), f"--length '{text}' is not of the form")
