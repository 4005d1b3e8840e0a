"""Tables whose header contradicts the manifest in unit or order, or is misspelt.

The numbers are the same each time, and the manifest states their unit: another header gives the same result, or is
refused in one sentence.
"""

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import aacmm_jax as aj

from .outcomes import Attempt, exact, read_again

ARM = "cheng2018-simulation"
ANGLES = {"deg": ["deg", "\u00b0", "degrees"], "rad": ["rad", "radians"], "gon": ["gon", "grad"], "arcsec": ["arcsec"],
          "mrad": ["mrad"]}  # fmt: skip
LENGTHS = {"mm": ["mm"], "m": ["m"], "um": ["um", "\u00b5m"], "inch": ["inch", "in"]}
NO_ANGLES = ["mm", "m", "um", "inch", "counts", "s", "Nm", "A", "V", "\u00b0C", "rad/s", "%", "rev", "cm", "urad"]
NO_LENGTHS = ["deg", "rad", "counts", "s", "cm", "dm", "nm", "ft", "mil", "N", "\u00b0"]
NAMES = ["q{}", "q_{}", "J{}", "A{}", "joint {}", "axis_{}", "actual_q_{}", "Encoder {}", "state.q[{}]"]
TABLES = {
    "sockets": '[[socket]]\nfile = "a.csv"\ngroup = "Hole"\n',
    "columns by name": '[[socket]]\nfile = "a.csv"\ngroup = "Hole"\ncolumns = {names}\n',
    "angles": '[angles]\nunit = "{unit}"\n[[socket]]\nfile = "a.csv"\ngroup = "Hole"\n',
    "points": '[[points]]\nfile = "a.csv"\ncolumns = {{ points = ["X", "Y", "Z"] }}\n',
    "points by pattern": '[[points]]\nfile = "a.csv"\ncolumns = {{ q = {pattern}, points = ["X", "Y", "Z"] }}\n',
    "spheres": '[[socket]]\nfile = "a.csv"\ngroup = "Hole"\n[[sphere]]\nname = "S"\ntest = "probing"\n'
    'diameter = 25.0\nfile = "a.csv"\n',
    "manifest of points": "",
}
_ALL = 'units = {{ q = "{unit}"{length} }}\n'


class _Header:
    """The names and units of a table's columns: a time stamp, the joints, a position and the socket."""

    def __init__(self, choose: random.Random, unit: str, length: str):
        first, pattern = choose.choice([0, 1]), choose.choice(NAMES)
        self.names = ["Time", *(pattern.format(i + first) for i in range(6)), "X", "Y", "Z", "Hole"]
        self.pattern = pattern.replace("[", "[[]").format("?")
        self.units = ["s", *[choose.choice(ANGLES[unit])] * 6, *[choose.choice(LENGTHS[length])] * 3, ""]
        self.style = choose.choice(["square", "round", "row", "none"])

    def text(self) -> str:
        """The line, or both lines, of the header."""
        if self.style == "row":
            return ";".join(self.names) + "\n" + ";".join(self.units) + "\n"
        brackets = {"square": " [{}]", "round": " ({})", "none": ""}[self.style]
        return (
            ";".join(a + (brackets.format(b) if b else "") for a, b in zip(self.names, self.units, strict=True)) + "\n"
        )


def _other_unit(header: _Header, choose: random.Random, units: tuple[str, str]) -> None:
    """Every column of a quantity, or one of them, in another unit."""
    header.style = choose.choice(["square", "round", "row"])
    of_angles = choose.random() < 0.6
    known, others, stated = (ANGLES, NO_ANGLES, units[0]) if of_angles else (LENGTHS, NO_LENGTHS, units[1])
    unit = choose.choice([*(x for name, names in known.items() for x in names if name != stated), *others])
    columns = [1, 2, 3, 4, 5, 6] if of_angles else [7, 8, 9]
    for i in columns if choose.random() < 0.7 else [choose.choice(columns)]:
        header.units[i] = unit


def _other_order(header: _Header, choose: random.Random, units: tuple[str, str]) -> None:
    """Names of joints from the last, two exchanged, at random, or one twice."""
    names = header.names[1:7]
    i, j = choose.sample(range(6), 2)
    changed = choose.choice(["reversed", "exchanged", "random", "twice"])
    if changed == "reversed":
        names.reverse()
    elif changed == "random":
        choose.shuffle(names)
    else:
        names[i], names[j] = names[j], names[i if changed == "exchanged" else j]
    header.names[1:7] = names


def _misspelt(text: str, choose: random.Random) -> str:
    i = choose.randrange(len(text))
    kind = choose.choice(["left out", "twice", "exchanged", "other"])
    if kind == "left out":
        return text[:i] + text[i + 1 :]
    if kind == "exchanged":
        return text[:i] + text[i : i + 2][::-1] + text[i + 2 :]
    return text[:i] + (2 * text[i] if kind == "twice" else choose.choice("abdegijmnqrx0123456789_")) + text[i + 1 :]


def _misspelt_name(header: _Header, choose: random.Random, units: tuple[str, str]) -> None:
    """A name with a character more, less, or another; the unit says what it did."""
    i = choose.randrange(1, len(header.names))
    header.names[i] = _misspelt(header.names[i], choose)


def _misspelt_unit(header: _Header, choose: random.Random, units: tuple[str, str]) -> None:
    """The same of a unit, in one column or in all of the quantity."""
    header.style = choose.choice(["square", "round", "row"])
    columns = choose.choice([[1, 2, 3, 4, 5, 6], [7, 8, 9]])
    unit = _misspelt(header.units[columns[0]], choose)
    for i in columns if choose.random() < 0.5 else [choose.choice(columns)]:
        header.units[i] = unit


KINDS: dict[str, Callable[[_Header, random.Random, tuple[str, str]], None]] = {
    "another unit": _other_unit,
    "another order": _other_order,
    "misspelt name": _misspelt_name,
    "misspelt unit": _misspelt_unit,
}


def attack(folder: Path, seed: int, count: int) -> Iterator[Attempt]:
    """So many headers, each changed in a way and read by a manifest that are drawn at random."""
    choose, numbers = random.Random(seed), np.random.default_rng(seed)
    rows = [
        ";".join([f"10:00:0{i}", *map(repr, numbers.uniform(-3, 3, 9).round(5).tolist()), "AABB"[i]]) for i in range(4)
    ]
    for _ in range(count):
        table = choose.choice(list(TABLES))
        unit, length = choose.choice(list(ANGLES)), choose.choice(list(LENGTHS))
        header = _Header(choose, unit, length)
        of_points = table == "manifest of points"
        if of_points:
            stated = f'[points]\nunit = "{length}"\n[[socket]]\nfile = "a.csv"\ngroup = "Hole"\n'
        else:
            stated = f'arm = "{ARM}"\n' + TABLES[table].format(
                names=header.names[1:7], unit=unit, pattern=repr(header.pattern)
            )
            of_length = f', points = "{length}"' if table.startswith("points") else ""
            stated += "" if table == "angles" else _ALL.format(unit=unit, length=of_length)
            stated = stated.replace("[[sphere]]", _ALL.format(unit=unit, length="") + "[[sphere]]")
        (folder / "m.toml").write_text(stated)
        read_file = aj.files.read_points if of_points else aj.files.read_manifest

        def read(read_file: Callable = read_file) -> object:
            result = read_file(folder / "m.toml")._replace(sources=())
            if getattr(result, "recorded_as", None) is not None:  # the names of columns are those of the header
                result = result._replace(recorded_as=result.recorded_as._replace(names=()))
            return result

        (folder / "a.csv").write_text(header.text() + "\n".join(rows) + "\n")
        expected = exact(read())
        # A list of names is right in whatever order the columns are.
        kind = choose.choice([kind for kind in KINDS if (kind, table) != ("another order", "columns by name")])
        KINDS[kind](header, choose, (unit, length))
        (folder / "a.csv").write_text(header.text() + "\n".join(rows) + "\n")
        outcome, message = read_again(read, expected)
        yield Attempt(kind, outcome, f"{table}, {unit}, {length}: {header.text()!r} {message}")
