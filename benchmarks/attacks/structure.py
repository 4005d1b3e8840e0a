"""One name of a file is misspelt or repeated: an element or attribute of a URDF or MJCF, a key or table of a TOML file.

A result that differs is silent unless a sentence, of the refusal or of a warning, says so. Values are data and stay.
"""

import contextlib
import copy
import random
import re
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path

import aacmm_jax as aj
from aacmm_jax.files.mjcf_text import parse_robot
from aacmm_jax.files.urdf_text import collision_shapes

from . import texts
from .outcomes import Attempt, exact, read_again

ROOT = Path(__file__).resolve().parents[2]
_SEVERAL = ("visual", "collision")
_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_KINDS = ("element", "attribute", "attribute twice", "element twice")
_IN_A_JOINT = 3  # so much more often is a name in a joint or a link's masses and shapes taken, than another one
KIT = """[[socket]]
name = "cone"
point = [400, 200, 300]
poses = 5
places = 3
normal = [0, 0, 1]
half_angle_deg = 40.0
"""
CELL = """clearance = 20.0
[[half_space]]
name = "table"
normal = [0, 0, 1]
point = [0, 0, -500]
[[box]]
name = "cupboard"
centre = [900, 0, 100]
size = [100, 200, 300]
rotation = [0, 0, 0.5]
[[capsule]]
name = "post"
start = [900, 500, 0]
end = [900, 500, 700]
radius = 30.0
[body]
radius = 40.0
tool_radius = 10.0
"""
PRIORS = """
[priors]
sd = { lengths = 0.5, angles = 0.05, d_3 = 0.1 }
mean = { d_3 = 750.2 }
[noise]
encoder_arcsec = 2.0
seating_mm = 0.005
"""
_KEY = re.compile(texts.NAMES[".toml"])


def misspelt(name: str, choose: random.Random) -> str:
    """The name with letters exchanged, left out, doubled, replaced, or in capitals."""
    while True:
        at = choose.randrange(len(name))
        other = choose.choice(
            [
                name[:at] + name[at + 1 : at + 2] + name[at] + name[at + 2 :],
                name[:at] + name[at + 1 :],
                name[:at] + name[at] + name[at:],
                name[:at] + choose.choice(_LETTERS) + name[at + 1 :],
                name[:at] + name[at].upper() + name[at + 1 :],
                name.upper(),
            ]
        )
        if other and other != name and re.fullmatch(r"[A-Za-z_][\w-]*", other):
            return other


def edited_robot(text: str, choose: random.Random, kinds: Sequence[str] = _KINDS) -> tuple[str, tuple[str, ...]]:
    """A URDF or MJCF with one name misspelt or repeated, and the names that a sentence may say."""
    root = ET.fromstring(text)
    parents = {child: parent for parent in root.iter() for child in parent}
    pool = [element for element in root.iter() if element is not root and "}" not in element.tag]
    for top in root.iterfind("joint"):
        pool += _IN_A_JOINT * list(top.iter())
    for link in root.iterfind("link"):
        pool += _IN_A_JOINT * [
            element for part in (*link.iter("inertial"), *link.iter("collision")) for element in part
        ]
    element = choose.choice(pool)
    kind = choose.choice(kinds)
    if kind.startswith("attribute") and element.attrib:
        name = choose.choice(list(element.attrib))
        wrong = misspelt(name, choose) if kind == "attribute" else name.upper()
        element.attrib = {wrong if key == name else key: value for key, value in element.attrib.items()} | (
            {name: _other(element.attrib[name])} if kind == "attribute twice" else {}
        )
    elif kind == "element twice":
        if element.tag in _SEVERAL:
            element = parents[element]  # of which there is one
        wrong = name = element.tag
        twin = copy.deepcopy(element)
        for part in twin.iter():
            part.attrib = {key: value if key == "name" else _other(value) for key, value in part.attrib.items()}
        siblings = parents[element]
        siblings.insert(list(siblings).index(element) + choose.randrange(2), twin)
    else:
        name = element.tag
        wrong = element.tag = misspelt(name, choose)
    return ET.tostring(root, encoding="unicode"), (name, wrong)


def _other(value: str) -> str:
    """The value with other digits, so that it matters which of two is read."""
    return re.sub(r"\d", lambda digit: str((int(digit[0]) + 1) % 10), value, count=1)


def edited_toml(text: str, choose: random.Random) -> tuple[str, tuple[str, ...]]:
    """A TOML file with one key or table name misspelt, or one line repeated."""
    found = [
        one
        for one in _KEY.finditer(text)
        if not {"#", '"'} & set(text[text.rfind("\n", 0, one.start()) + 1 : one.start()])
    ]
    one = choose.choice(found)
    name, (start, end) = one[one.lastindex or 0], one.span(one.lastindex or 0)
    begin = text.rfind("\n", 0, start) + 1
    if choose.random() < 0.2 and not text[begin:start].strip():  # not a row of a list, which is data
        stop = text.find("\n", end) + 1 or len(text)
        line = text[begin:stop]
        return text[:stop] + _other(line) + text[stop:], (name,)
    head, _, last = name.rpartition(".")
    wrong = f"{head}." * bool(head) + misspelt(last, choose)
    return text[:start] + wrong + text[end:], (name, wrong)


def urdf_files() -> list[Path]:
    """The URDFs of the project and of example-robot-data."""
    found = [Path(str(file.locate())) for file in metadata.files("example-robot-data") or () if file.suffix == ".urdf"]
    found += [*(ROOT / "examples").rglob("*.urdf"), *(ROOT / "tests").rglob("*.urdf")]
    return sorted(path for path in found if "<joint" in path.read_text(encoding="utf-8"))  # one of them has no robot


def urdf_content(path: Path) -> tuple:
    """All that arms, their masses and their bodies take from a URDF."""
    text = path.read_text(encoding="utf-8")
    robot = parse_robot(text)
    joints = {name: joint._replace(element=None) for name, joint in robot.joints.items()}
    return joints, robot.links, collision_shapes(robot)


def _tomls(folder: Path) -> dict[str, Callable[[], object]]:
    """TOML files of every kind in a folder, and what reads each."""
    found = {name: read for name, read in texts.originals(folder).items() if name.endswith(".toml")}
    example = folder / "example"
    shutil.copytree(ROOT / "examples" / "simulated_robot", example)
    for name in ("tracker.toml", "plate.toml", "unseen.toml"):
        found[f"example/{name}"] = lambda name=name: aj.files.read_manifest(example / name)._replace(sources=())
    for source in (*(ROOT / "aacmm_jax/files/shipped_arms").glob("*.toml"), folder / "arm.toml"):
        name = f"of_{source.name}"
        added = PRIORS if "[noise]" not in source.read_text() and "[priors]" not in source.read_text() else ""
        (folder / name).write_text(source.read_text() + added)
        found[name] = lambda name=name: aj.files.load_specification(folder / name)
    for source in (ROOT / "aacmm_jax/study/shipped_studies").glob("*.toml"):
        (folder / source.name).write_text(source.read_text())
        found[source.name] = lambda name=source.name: aj.study.read_study(folder / name).specification
    (folder / "kit.toml").write_text(KIT)
    (folder / "cell.toml").write_text(CELL)
    found["kit.toml"] = lambda: aj.files.read_kit(folder / "kit.toml")
    found["cell.toml"] = lambda: aj.files.load_cell("cheng2018-simulation", folder / "cell.toml").cell
    readable: dict[str, Callable[[], object]] = {}
    for name, read in found.items():
        with contextlib.suppress(aj.InputError):  # a shipped arm whose joints the priors above do not fit
            read()
            readable[name] = read
    return readable


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many URDFs, and half as many MJCF and TOML files, each with one name misspelt or repeated."""
    choose = random.Random(seed)
    files, path = urdf_files(), folder / "robot.urdf"
    for _ in range(count):
        source = choose.choice(files)
        expected = exact(urdf_content(source))
        text, names = edited_robot(source.read_text(encoding="utf-8"), choose)
        path.write_text(text, encoding="utf-8")
        outcome, message = read_again(lambda: urdf_content(path), expected, names=names)
        yield Attempt("urdf", outcome, f"{source.name}, {' -> '.join(names)}: {message}")
    mjcf, path = ET.tostring(ET.fromstring(texts.MJCF), encoding="unicode"), folder / "robot.xml"
    path.write_text(mjcf, encoding="utf-8")
    expected = exact(aj.load_arm(path))
    for _ in range(count // 2):
        text, names = edited_robot(mjcf, choose, _KINDS[:-1])  # MJCF may have any element twice
        path.write_text(text, encoding="utf-8")
        outcome, message = read_again(lambda: aj.load_arm(path), expected, names=names)
        yield Attempt("mjcf", outcome, f"{' -> '.join(names)}: {message}")
    readers = _tomls(folder)
    results = {name: exact(read()) for name, read in readers.items()}
    for _ in range(count // 2):
        name = choose.choice(list(readers))
        original = (folder / name).read_text()
        text, names = edited_toml(original, choose)
        (folder / name).write_text(text)
        outcome, message = read_again(readers[name], results[name], names=names)
        (folder / name).write_text(original)
        yield Attempt("toml", outcome, f"{name}, {' -> '.join(names)}: {message}")
