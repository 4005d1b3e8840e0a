"""Text files of every kind are mutated and read again.

An edit (a digit, a line) is another valid text and may give another result; one that makes a new name (of a key, an
element, a column) may only where a warning says that name. A corruption (digits of another script, quotes, control
characters, another encoding, ...) never may: the result is the same, or the file is refused in one sentence.
"""

import random
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import aacmm_jax as aj

from .outcomes import OTHER, SILENT, Attempt, exact, read_again
from .samples import results

MADE = "2026-01-31T12:00:00+00:00"
MANIFEST = """date = 2026-01-31
arm = "arm.toml"

[angles]
unit = "deg"
sign = [1, 1, -1, 1, 1, 1]
offset = 0.5
columns = [2, 3, 4, 5, 6, 7]

[[socket]]
name = "plate/{hole}"
file = "hole_{hole}.csv"
exclude = ["*_old.csv"]

[[length]]
from = "plate/0"
to = "plate/1"
value = 200.125
u = 0.002
"""
OBSERVED = """arm = "arm.toml"

[[points]]
name = "T"
file = "o.csv"
preset = "leica"
columns = { q = "q[1-6]" }
target = "SMR"
station = "S1"

[[transforms]]
name = "T6"
file = "o.csv"
columns = { q = "q[1-6]", points = ["x", "y", "z"], rotations = ["q0", "q1q", "q2q", "q3q"] }
rotation = "quaternion wxyz"
u = 10.0
u_angle = 5.0
units = { u = "um", u_angle = "arcsec" }

[[touched_sphere]]
name = "sphere"
file = "o.csv"
columns = { q = "q[1-6]" }
diameter = 25.0004
u = 0.0005
stylus = 6.0

[[touched_cylinder]]
name = "ring"
file = "o.csv"
columns = { q = "q[1-6]" }
diameter = 50.01
stylus = 6.0
inside = true
form = 0.002

[[plane]]
name = "wall"
file = "o.csv"
columns = { q = "q[1-6]" }
group = "Group"

[[parallel_planes]]
name = "block"
file = "o.csv"
columns = { q = "q[1-6]", side = "Side" }
distance = 100.0

[[artefact]]
name = "bar"
file = "o.csv"
columns = { q = "q[1-6]", point = "Ball" }
u = 0.001
placement = "left"
coordinates = { a = [0.0, 0.0, 0.0], b = [300.5, 0.0, 0.0] }

[[distances]]
name = "wire"
file = "o.csv"
columns = { q = "q[1-6]", values = "d" }
u = 0.003
constant = true
"""
POINTS = """[points]
unit = "mm"
reach = 900.0
shoulder = [0.0, 0.0, 300.0]

[[socket]]
name = "A"
file = "points.csv"

[[sphere]]
name = "S"
test = "probing"
files = ["sphere.csv"]
diameter = 25.0004
u = 0.0005
stylus = 6.0
"""
URDF = """<robot name="two">
  <link name="base"/>
  <joint name="one" type="revolute">
    <parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.3" rpy="0 0 0.25"/>
    <axis xyz="0 0 1"/>
    <limit lower="-2.5" upper="2.75"/>
  </joint>
  <link name="upper"/>
  <joint name="two" type="continuous">
    <parent link="upper"/><child link="tip"/>
    <origin xyz="0.5 0 0.125" rpy="-1.5 0 0"/>
  </joint>
  <link name="tip"/>
</robot>
"""
MJCF = """<mujoco model="two arms">
  <compiler angle="degree" eulerseq="zyx"/>
  <default><joint axis="0 1 0" range="-120 120"/><default class="up"><joint axis="0 0 2"/></default></default>
  <worldbody>
    <body name="trunk" pos="0 0 0.3">
      <joint name="turn" class="up"/>
      <body name="left" pos="0.1 0.2 0.1" euler="80 0 10">
        <joint name="one"/><joint name="two" pos="0 0.02 0.05" axis="1 0.1 0" ref="15"/>
        <site name="left_tool" pos="0 0 0.25" xyaxes="0 1 0.1 -1 0 0"/>
        <body name="left_hand" pos="0.3 0 0.1" quat="2 0 0 1"><joint name="three" type="slide" range="-0.1 0.3"/></body>
      </body>
      <frame pos="0.1 -0.2 0.1" axisangle="1 0 0 -80">
        <body name="right" zaxis="0.1 0 1"><joint name="four"/>
          <body name="right_hand" pos="0.3 0 0.125"><joint name="five"/></body></body>
      </frame>
    </body>
  </worldbody>
  <equality><joint joint1="three" joint2="one" polycoef="0.01 -0.25"/></equality>
</mujoco>
"""
UR_NOMINAL = """[DH]
a = [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
d = [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
alpha = [1.570796327, 0, 0, 1.570796327, -1.570796327, 0]
"""
UR_CALIBRATION = """[mounting]
delta_theta = [0.00000125, -0.0025, 0.00125, 0.00125, 0.0025, 0.0]
delta_a = [0.00025, 0.00125, 0.0005, 0.00025, 0.0005, 0]
delta_d = [0.00025, 0.0005, -0.00025, 0.00075, 0.0005, 0.0005]
delta_alpha = [0.0005, 0.00025, 0.0005, 0.0005, 0.0005, 0]
calibration_status = 2 # 2 == Linearised
"""
STUDY = """name = "Study"
arm = "arm.toml"
trials = 10
seed = 3
[deviation]
length_mm = [1.0, { normal = 0.5 }]
[capture]
sockets = 2
region = { x_mm = [200, 600], y_mm = [-300, 300], z_mm = [100, 500] }
poses = 20
[noise]
encoder_arcsec = [1, 2]
[reference]
ends_mm = [[[400, 200, 300], [600, 200, 300]]]
u_mm = 0.001
[bounds]
override = { probe_z = 20.0 }
"""
ABOUT = """[laboratory]
name = "Laboratory"
country = "DE"
[[person]]
name = "A. Person"
main_signer = true
[certificate]
number = "42"
begin = 2026-01-30
end = 2026-01-31
temperature_celsius = 20.1
temperature_u_celsius = 0.2
"""


def originals(folder: Path) -> dict[str, Callable[[], object]]:
    """Write one file of every kind; name of the file that is mutated -> what it is read by."""
    random_numbers = np.random.default_rng(0)
    sample = results()
    aj.files.save_arm(sample.arm.arm, folder / "arm.toml")
    for name in ("hole_0.csv", "hole_1.csv", "hole_1_old.csv"):
        rows = random_numbers.uniform(-90, 90, (5, 7))
        lines = [",".join(f"{x:.4f}" for x in row) for row in rows]
        (folder / name).write_text("time,q1,q2,q3,q4,q5,q6\n" + "\n".join(lines) + "\n")
    for name, centre in (("points.csv", 0.0), ("sphere.csv", 15.5)):
        directions = random_numbers.normal(size=(25, 3))
        points = centre * directions / np.linalg.norm(directions, axis=1)[:, None] + [400, 200, 300]
        points += random_numbers.normal(0, 0.01, points.shape)
        (folder / name).write_text("\n".join(";".join(f"{x:.5f}" for x in row) for row in points) + "\n")
    header = [*(f"q{i} [deg]" for i in range(1, 7)), "X [mm]", "Y [mm]", "Z [mm]", "U(95) X [mm]", "U(95) Y [mm]"]
    header += ["U(95) Z [mm]", "Q0", "q1q", "q2q", "q3q", "d", "Group", "Side", "Ball"]
    rows = []
    for i in range(6):
        turn = random_numbers.normal(size=4)
        values = [*random_numbers.uniform(-90, 90, 6), *random_numbers.uniform(100, 900, 3), 0.01, 0.02, 0.03]
        values += [*turn / np.linalg.norm(turn), 500.0 + i]
        rows.append([*(f"{x:.6f}" for x in values), "ab"[i % 2], ["one", "other"][i // 3], "ab"[i % 2]])
    (folder / "o.csv").write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    for name, text in (
        ("m.toml", MANIFEST),
        ("o.toml", OBSERVED),
        ("p.toml", POINTS),
        ("s.toml", STUDY),
        ("l.toml", ABOUT),
        ("r.urdf", URDF),
        ("r.xml", MJCF),
        ("urcontrol.conf", UR_NOMINAL),
        ("calibration.conf", UR_CALIBRATION),
    ):
        (folder / name).write_text(text)
    (folder / "kinematics.yaml").write_text(aj.files.ur_kinematics_yaml(sample.arm.arm))
    about = aj.files.read_administrative_data(folder / "l.toml")
    (folder / "dcc.xml").write_text(aj.certificate.dcc_xml(sample.record, about, created=MADE))

    def manifest() -> object:
        return aj.files.read_manifest(folder / "m.toml")._replace(sources=())

    def observed() -> object:
        return aj.files.read_manifest(folder / "o.toml")._replace(sources=())

    def points_file() -> object:
        return aj.files.read_points(folder / "p.toml")._replace(sources=())

    def certificate_text() -> str:
        return (folder / "dcc.xml").read_text(errors="surrogateescape")

    return {
        "m.toml": manifest,
        "hole_0.csv": manifest,
        "o.toml": observed,
        "o.csv": observed,
        "arm.toml": lambda: aj.files.load_specification(folder / "arm.toml"),
        "r.urdf": lambda: aj.load_arm(folder / "r.urdf"),
        "r.xml": lambda: aj.load_arm(folder / "r.xml"),
        "urcontrol.conf": lambda: aj.load_arm(folder / "urcontrol.conf"),
        "calibration.conf": lambda: aj.load_arm(folder / "calibration.conf"),
        "kinematics.yaml": lambda: aj.load_arm(folder / "kinematics.yaml"),
        "p.toml": points_file,
        "points.csv": points_file,
        "s.toml": lambda: aj.study.read_study(folder / "s.toml").specification,
        "l.toml": lambda: aj.files.read_administrative_data(folder / "l.toml"),
        "dcc.xml": lambda: sorted(aj.certificate.parse_dcc(certificate_text()).values()),
    }


NASTY = ["\0", "\x1b[2J", "\u202e", "\x7f", "\x9b", "\u2028", "\x1c", "\ufeff"]
NUMBER = re.compile(r"(?<![\w.{])(?<!e[+-])-?\d+(?:\.\d+)?(?![\w.}])")


def random_position(text: str, choose: random.Random) -> int:
    return choose.randrange(len(text) + 1)


def _inside_string(text: str, at: int) -> bool:
    return text[text.rfind("\n", 0, at) + 1 : at].count('"') % 2 == 1


def replaced(pattern: str, text: str, choose: random.Random, by: Callable[[str], str], strings: bool = False) -> str:
    """One match in another form; ``strings``: only outside quotes, where any text is as good as another."""
    found = [one for one in re.finditer(pattern, text) if not strings or not _inside_string(text, one.start())]
    if not found:
        return text
    one = choose.choice(found)
    return text[: one.start()] + by(one.group()) + text[one.end() :]


def inserted(text: str, choose: random.Random, what: str) -> str:
    at = random_position(text, choose)
    return text[:at] + what + text[at:]


def lines_changed(text: str, choose: random.Random, change: Callable[[list[str], int], None]) -> str:
    lines = text.split("\n")
    change(lines, choose.randrange(len(lines)))
    return "\n".join(lines)


def number(text: str, choose: random.Random, by: Callable[[str], str]) -> str:
    return replaced(NUMBER.pattern, text, choose, by, strings=True)


EDITS: dict[str, Callable[[str, random.Random], str]] = {
    "another character": lambda text, choose: replaced(
        r"[^\n]", text, choose, lambda _: choose.choice("0123456789abcxyz.,;-+=[]{}\"'# ")
    ),
    "character left out": lambda text, choose: replaced(".", text, choose, lambda _: ""),
    "character twice": lambda text, choose: replaced(".", text, choose, lambda one: 2 * one),
    "line left out": lambda text, choose: lines_changed(text, choose, lambda lines, i: lines.pop(i)),
    "line twice": lambda text, choose: lines_changed(text, choose, lambda lines, i: lines.insert(i, lines[i])),
    "cut short": lambda text, choose: text[: random_position(text, choose)],
    "negative": lambda text, choose: number(text, choose, lambda one: "-" + one),
    "lines exchanged": lambda text, choose: lines_changed(
        text, choose, lambda lines, i: lines.insert(choose.randrange(len(lines)), lines.pop(i))
    ),
    "cell moved": lambda text, choose: replaced(
        r"[^,;=\n]+[,;][^,;=\n]+", text, choose, lambda one: re.sub(r"(.*)([,;])(.*)", r"\3\2\1", one)
    ),
    "another case": lambda text, choose: replaced(r"[A-Za-z]+", text, choose, str.swapcase),
}
CORRUPTIONS: dict[str, Callable[[str, random.Random], str]] = {
    "control character": lambda text, choose: inserted(text, choose, choose.choice(NASTY)),
    "Arabic digits": lambda text, choose: number(
        text, choose, lambda one: "".join(chr(0x660 + int(c)) if c.isdigit() else c for c in one)
    ),
    "fullwidth digit": lambda text, choose: number(
        text, choose, lambda one: "".join(chr(0xFF10 + int(c)) if c.isdigit() else c for c in one)
    ),
    "quoted number": lambda text, choose: number(text, choose, lambda one: f'"{one}"'),
    "boolean": lambda text, choose: number(text, choose, lambda _: choose.choice(["true", "True", "false"])),
    "huge": lambda text, choose: number(
        text, choose, lambda _: choose.choice(["1e300", "-1e300", "9" * 5001, "1e999"])
    ),
    "not finite": lambda text, choose: number(text, choose, lambda _: choose.choice(["nan", "inf", "-inf", "NaN"])),
    "hexadecimal": lambda text, choose: number(text, choose, lambda one: f"{one}x1"),
    # In a list, a comma makes two numbers of one.
    "decimal comma": lambda text, choose: replaced(
        r"(?m)^[^\[\n]*?\d\.\d", text, choose, lambda one: f"{one[:-2]},{one[-1]}"
    ),
    "opening quote": lambda text, choose: lines_changed(
        text, choose, lambda lines, i: lines.__setitem__(i, '"' + lines[i])
    ),
    "deep": lambda text, choose: lines_changed(
        text,
        choose,
        lambda lines, i: lines.insert(i, choose.choice(["a = " + "[" * 900, "a = " + "{a=" * 900, "[" * 900])),
    ),
    "dotted": lambda text, choose: "\n" + ".".join(["a"] * 20_000) + " = 1\n" + text,
    "bytes": lambda text, choose: inserted(text, choose, "\udcff\udcfe"),
    "unit": lambda text, choose: number(text, choose, lambda one: one + choose.choice(["mm", " mm", "\u00b0", "%"])),
    "exponent of Fortran": lambda text, choose: number(text, choose, lambda one: one + choose.choice("dDqf") + "1"),
    "digits in groups": lambda text, choose: number(
        text, choose, lambda one: re.sub(r"\d", lambda digit: digit[0] + choose.choice("'_\u00a0\u2009"), one, count=1)
    ),
    "typographic minus": lambda text, choose: number(
        text, choose, lambda one: choose.choice("\u2212\u2013\ufe63\uff0d") + one.lstrip("-")
    ),
    "letter of another alphabet": lambda text, choose: replaced(
        r"(?m)(?<=^)[aceopxy](?=\w* ?=)",
        text,
        choose,
        lambda one: "\u0430\u0441\u0435\u043e\u0440\u0445\u0443"["aceopxy".index(one)],
    ),
    "another encoding": lambda text, choose: text.encode(choose.choice(["utf-16", "utf-16-le", "utf-32"])).decode(
        errors="surrogateescape"
    ),
}


# Names in the text, of keys, elements, attributes or columns, by the ending of the file.
NAMES = {
    ".toml": r"(?m)(?:^|(?<=[{,])) *([A-Za-z_][\w-]*)(?= *=[^=])|^\[+([\w.]+)\]+",
    ".yaml": r"(?m)^ *([A-Za-z_]\w*):",
    ".conf": r"(?m)^ *([A-Za-z_]\w*) *=|^\[(\w+)\]",
    ".urdf": r"</?([A-Za-z_][\w:]*)|\s([A-Za-z_]\w*)\s*=",
    ".xml": r"</?([A-Za-z_][\w:]*)|\s([A-Za-z_]\w*)\s*=",
    ".csv": r"\A[^\n]*",
}


def new_names(file: str, original: str, mutated: str) -> set[str]:
    """Names of the mutated text that the original does not have."""
    found = [
        {
            cell
            for one in re.finditer(NAMES[Path(file).suffix], text)
            for cell in re.split(",|;", one[one.lastindex or 0])
        }
        for text in (original, mutated)
    ]
    return {name for name in found[1] - found[0] if re.search(r"[^\W\d]", name)}


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many mutations, each of a file and of a kind drawn at random."""
    choose = random.Random(seed)
    readers = originals(folder)
    expected = {file: exact(read()) for file, read in readers.items()}
    for _ in range(count):
        file = choose.choice(list(readers))
        kind, mutations = choose.choice([("edits", EDITS), ("corruptions", CORRUPTIONS)])
        mutation = choose.choice(list(mutations))
        original = (folder / file).read_text()
        mutated = mutations[mutation](original, choose)
        (folder / file).write_bytes(mutated.encode(errors="surrogateescape"))
        edit = kind == "edits"
        names = new_names(file, original, mutated) if edit else ()
        outcome, message = read_again(readers[file], expected[file], OTHER if edit else SILENT, names)
        (folder / file).write_text(original)
        changed = [line for line in mutated.split("\n") if line not in original.split("\n")][:2]
        yield Attempt(kind, outcome, f"{file}, {mutation}: {[line[:90] for line in changed]} {message}")
