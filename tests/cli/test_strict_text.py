"""Numbers and names on the command line and on the terminal: nothing but plain numbers, nothing that acts on it."""

import pytest

import aacmm_jax as aj
from aacmm_jax.core.text import is_number, number, printable
from aacmm_jax.data.recording import Recording
from aacmm_jax.files.toml import validated
from aacmm_jax.study.specification import Specification
from tests.refusals import assert_refused

SIMULATE = ("simulate", "cheng2018-simulation", "-o", "c.h5", "--socket", "A=400,200,300")


@pytest.mark.parametrize("text", ["1", "-1.5", "+.5", "3.", "1e3", "2.5E-07", "007"])
def test_numbers(text):
    assert number(text) == float(text)


@pytest.mark.parametrize(
    "text", ["1_0", "\u0663", "\uff13", " 1", "1\n", "", ".", "1e", "0x1", "1,5", "--1", "True", "1.0f"]
)
def test_what_is_no_number(text):
    assert not is_number(text)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plate/hole 3 µm 位", "plate/hole 3 µm 位"),
        ("\x1b[2Jhole\x9b", "\\x1b[2Jhole\\x9b"),
        ("a\x00b\x7f", "a\\x00b\\x7f"),
        ("\u202ecsv\u2066", "\\u202ecsv\\u2066"),
        ("two\nlines\tand more\r", "two\nlines\tand more\\r"),
    ],
)
def test_what_is_printed(text, shown):
    assert printable(text) == shown


@pytest.mark.first_rows(2)
@pytest.mark.parametrize(
    ("options", "part"),
    [
        (("--seed", "1_0"), "--seed '1_0' is not a finite number; give a number in decimal digits."),
        (("--seed=\u0663",), "--seed '\u0663' is not a finite number"),
        (("--seating-mm", "nan"), "--seating-mm 'nan' is not a finite number"),
        (("--encoder-arcsec", "inf"), "--encoder-arcsec 'inf' is not a finite number"),
        (("--seed", "12345678901234567890"), "should be less than or equal to"),
        (("--poses", "99999999"), "number of poses of socket 'A' is 1e+08; it must be at least 1 and at most 100000."),
        (("--poses", "9" * 5001), "is not of the form N"),
        (("--poses", "\u0663"), "--poses '\u0663' is not of the form N"),
        (("--socket", "B=1_0,2,3"), "is not of the form NAME=X,Y,Z"),
        (("--socket", "\x1b[2JB=1,2,3"), "--socket '\\x1b[2JB=1,2,3' has a control character in its name"),
        (("--length", "A,B,\u0663"), "is not of the form A,B or A,B,U"),
    ],
)
def test_options(aacmm, tmp_path, options, part):
    assert part in " ".join(aacmm(*SIMULATE, *options, expect=2).stderr.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "part"),
    [
        (("plan", "cheng2018-simulation", "-o", "p.csv", "--poses", "99999999"), "should be less than or equal to"),
        (("plan", "cheng2018-simulation", "-o", "p.csv", "--region", "z=0:8_0"), "is not of the form AXIS=LOW:HIGH"),
        (("show", "x" * 300), "is neither a file nor an arm"),
        (("evaluate", "x.toml", "--max-rms-mm", "nan"), "--max-rms-mm 'nan' is not a finite number"),
        (("study", "noise", "-o", "s.h5", "--seed", "12345678901234567890"), "'seed' must be less than"),
        (("study", "noise", "-o", "s.h5", "--trials", "32000", "--chunk", "1"), "more than 10,000 blocks"),
    ],
)
def test_other_commands(aacmm, tmp_path, command, part):
    assert part in " ".join(aacmm(*command, expect=2).stderr.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.first_rows(2)
@pytest.mark.parametrize("text", [10_000 * "n", 5_000 * "n ", "\x1b[2J"])
@pytest.mark.parametrize(
    "command",
    [
        ("{}",),
        ("show", "{}"),
        ("show", "c.h5", "{}"),
        ("import", "{}", "-o", "c.h5"),
        (*SIMULATE, "--acceptance", "{}"),
        (*SIMULATE, "--true-arm", "{}"),
        (*SIMULATE, "--length", "{}"),
        (*SIMULATE, "--{}"),
    ],
)
def test_long_arguments(aacmm, command, text):
    said = aacmm(*(word.format(text) for word in command), expect=2).stderr
    assert len(said) < 1300  # with the usage
    assert "\x1b" not in said


@pytest.mark.slow
def test_names_from_a_file_do_not_reach_the_terminal_raw(aacmm, tmp_path, paper_capture):
    """ESC in the name of an arm, which only Python can put into a file."""
    arm = aj.files.load_specification("cheng2018-simulation")._replace(name="\x1b]0;owned\x07arm")
    aj.files.save_capture(tmp_path / "c.h5", Recording(paper_capture, arm))
    for options in ((), ("--json",)):
        shown = aacmm("show", "c.h5", *options).stdout
        assert "\x1b" not in shown
        assert "\x07" not in shown
        assert "owned" in shown
    (tmp_path / "m.toml").write_text('arm = "\x7fx"\n')
    assert "\x7f" not in aacmm("import", "m.toml", "-o", "d.h5", expect=2).stderr


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"trials": True}, "'trials' must be a valid integer, not True"),
        ({"trials": "10"}, "'trials' must be a valid integer, not '10'"),
        ({"seed": 12345678901234567890}, "'seed' must be less than 9223372036854775808"),
        ({"deviation": {"length_mm": "1"}}, "'deviation.length_mm' must be"),
        ({"capture": {"positions_mm": [["400", 200, 300]]}}, "must be a valid number, not '400'"),
        ({"bounds": {"override": {"d_1": "3"}}}, "must be a valid number, not '3'"),
    ],
)
def test_studies(change, part):
    tables = {"trials": 1, "capture": {"positions_mm": [[400, 200, 300]]}, "identification": {"method": "stage1"}}
    assert_refused(lambda: validated(Specification, tables | change, "study.toml"), "study.toml: ", part)
