"""Robots in XML: elements with their places in the text, and edits of single attributes that leave all else as it is.

A misspelt ``<origin>`` or ``pos=`` would count as one that is missing, and the arm would be another one without any
message. So in elements that are read, names that nearly are, or elsewhere are, those of the format are refused, and in
those without room for other tools' data every other name as well. Names with a prefix (``drake:...``) pass.

The parser is expat: it says where each tag is in bytes, which edits need, and in which line, which messages need. A
document type is refused: its entities could name other files, or grow to any size.
"""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from ..core.errors import InputError, nearest
from ..core.text import is_control, is_number, number, quoted

MOST_CHARACTERS = 20_000_000  # the largest robots of public collections have a twentieth of it
_DEEPEST = 64  # levels of elements; a URDF has six, an MJCF two more than its longest chain of bodies
_ALIKE = 0.7  # of difflib: one wrong, missing, exchanged or repeated letter in four
_LARGEST = 1e6  # m and rad or deg, of positions, angles and directions
_EXPAND = "so the file is a xacro file; expand it with 'xacro FILE.xacro > FILE.urdf' and give FILE.urdf."
_TAG = re.compile(rb"""<(?:[^"'>]++|"[^"]*+"|'[^']*+')*+>""")  # a ``>`` in a value does not end a tag


class Names(NamedTuple):
    """The names in an element that is read, divided by blanks."""

    attributes: str = ""
    once: str = ""  # children, of each at most one
    often: str = ""
    others: bool = False  # whether names that are not like these pass


@dataclass(frozen=True, eq=False)
class Format:
    """A format in XML: its root, the elements that are read, and those that messages call by their name."""

    name: str
    root: str
    names: Mapping[str, Names]
    named: tuple[str, ...]


class Element(NamedTuple):
    """An element that is read, with those inside it."""

    name: str
    attributes: dict[str, str]
    words: str  # what messages call it
    line: int
    place: tuple[int, int]  # where its start tag begins and ends, as bytes of the text in UTF-8
    children: list["Element"]

    @property
    def where(self) -> str:
        """Its line and name, as messages begin."""
        return f"line {self.line}: {self.words}"

    def child(self, name: str) -> "Element | None":
        """The first child of a name."""
        return next((child for child in self.children if child.name == name), None)

    def text(self, name: str) -> str:
        """An attribute that must be there."""
        value = self.attributes.get(name, "")
        if not value:
            raise InputError(f"{self.where} has no {name}; add it.")
        if any(map(is_control, value)):
            raise InputError(f"{self.where} has a control character in {name}; remove the character.")
        return value

    def numbers(self, name: str, default: tuple[float, ...]) -> Float[np.ndarray, " k"]:
        """The numbers of an attribute, as many as by default."""
        text = self.attributes.get(name)
        if text is None:
            return np.array(default)
        stated, count = f"{self.where} has {name} = {quoted(text)}", len(default)
        if "${" in text or "$(" in text:
            raise InputError(f"{stated}, {_EXPAND}")
        values = np.array([number(part) for part in text.split()] if all(map(is_number, text.split())) else [])
        if count >= 3 and np.any(np.abs(values) >= _LARGEST):  # limits may be as large as one likes
            raise InputError(f"{stated}; the numbers must be below {_LARGEST:g}.")
        if len(values) != count or not np.all(np.isfinite(values)):
            raise InputError(f"{stated}; give {'one number' if count == 1 else f'{count} numbers'}.")
        return values


class Document(NamedTuple):
    """What was parsed."""

    format: Format
    root: Element
    end: int  # where the end tag of the root begins, as bytes of the text in UTF-8


@lru_cache(maxsize=2)
def parse_xml(text: str, formats: tuple[Format, ...]) -> Document:
    """The elements of a text of one of the formats; `InputError` where it is not XML, or a name is not known there."""
    stack: list[Element | None] = []  # None: not read
    root: list[Element] = []
    chosen: list[Format] = []
    ends = [0]

    def start(name: str, attributes: dict[str, str], line: int, place: tuple[int, int]) -> None:
        if name.startswith("xacro:"):
            raise InputError(f"line {line} has <{quoted(name)[1:-1]}>, {_EXPAND}")
        parent = stack[-1] if stack else None
        if not stack:
            chosen.extend(known for known in formats if known.root == name)
            if not chosen:
                roots = " and ".join(f"{known.name} has the root element <{known.root}>" for known in formats)
                raise InputError(f"the root element is <{quoted(name)[1:-1]}>, but {roots}; give such a file.")
        names = chosen[0].names
        if stack and (parent is None or not _is_read(names, name, parent, line)):
            stack.append(None)
            return
        if parent is None:
            words = "the robot"
        elif name in chosen[0].named:
            words = f"{name} {quoted(attributes['name'])}" if attributes.get("name") else f"a {name}"
        else:
            words = f"<{name}> of {parent.words.partition(' of ')[2] if parent.words[0] == '<' else parent.words}"
        element = Element(name, attributes, words, line, place, [])
        for key in attributes:
            if key == "quat_xyzw":
                raise InputError(f"{element.where} has a quaternion (quat_xyzw); write the rotation as rpy instead.")
            if key not in names[name].attributes.split() and ":" not in key and key != "xmlns":
                _check_name(names, element, "attribute", key, names[name].attributes.split())
        (root if parent is None else parent.children).append(element)
        stack.append(element)

    def end(_: str, place: tuple[int, int]) -> None:
        stack.pop()
        ends.append(place[0])

    def text_between(data: str, line: int) -> None:
        if data.strip() and stack[-1] is not None:
            raise InputError(
                f"line {line}: {stack[-1].words} contains the text {quoted(data.strip())}, which is not allowed "
                "there; remove the text."
            )

    scan(text, start, end, text_between)
    return Document(chosen[0], root[0], ends[-1])


def scan(
    text: str,
    start: Callable[[str, dict[str, str], int, tuple[int, int]], None],
    end: Callable[[str, tuple[int, int]], None],
    between: Callable[[str, int], None] = lambda data, line: None,
) -> None:
    """Call ``start(name, attributes, line, place)``, ``end(name, place)`` and ``between(text, line)`` along a text.

    A place is where a tag begins and ends, as bytes of the text in UTF-8; the end of ``<a/>`` begins where its tag
    ends.
    """
    if len(text) > MOST_CHARACTERS:
        raise InputError(
            f"the file has {len(text):,} characters, more than {MOST_CHARACTERS:,}; give the file of a robot."
        )
    content = text.encode()
    parser = expat.ParserCreate("utf-8")
    empty: list[bool] = []  # of each element that has begun, whether it is ``<a/>``

    def place() -> tuple[int, int]:
        tag = _TAG.match(content, parser.CurrentByteIndex)
        return parser.CurrentByteIndex, len(content) if tag is None else tag.end()  # no XML, which expat refuses

    def on_start(name: str, attributes: dict[str, str]) -> None:
        begin, after = place()
        empty.append(content.endswith(b"/>", begin, after))
        if len(empty) > _DEEPEST + 1:
            raise InputError(
                f"line {parser.CurrentLineNumber} nests elements too deeply; at most {_DEEPEST} levels are allowed."
            )
        start(name, attributes, parser.CurrentLineNumber, (begin, after))

    def on_end(name: str) -> None:
        begin = parser.CurrentByteIndex
        end(name, (begin, begin) if empty.pop() else place())

    def refuse_entities(name: str, *_: object) -> None:
        raise InputError(
            f"the file declares a document type, {quoted(name)}, which aacmm does not accept; remove <!DOCTYPE ...>."
        )

    parser.StartElementHandler, parser.EndElementHandler = on_start, on_end
    parser.CharacterDataHandler = lambda data: between(data, parser.CurrentLineNumber)
    parser.StartDoctypeDeclHandler = refuse_entities
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise InputError(f"the file is not valid XML: {error}; correct the file at this point.") from error


def with_values(tag: str, values: Mapping[str, str], instead_of: Mapping[str, str] = MappingProxyType({})) -> str:
    """A start tag with other values of attributes; the rest stays to the byte.

    ``instead_of``: by attribute the pattern of those that state the same in another way, of which it takes the place.
    """
    for key, value in values.items():
        tag, count = re.subn(
            rf"""(\s)(?:{instead_of.get(key, key)})(\s*=\s*)("[^"]*"|'[^']*')""",
            lambda match, key=key, value=value: f"{match[1]}{key}{match[2]}{match[3][0]}{value}{match[3][0]}",
            tag,
            count=1,
        )
        if not count:
            tag = re.sub(r"\s*/?>$", lambda end, key=key, value=value: f' {key}="{value}"{end[0]}', tag)
    return tag


def replaced(text: str, changes: Iterable[tuple[int, int, str]]) -> str:
    """The text with other parts: where each begins and ends, as bytes of the text in UTF-8, and what replaces it."""
    content = text.encode()
    for start, end, part in sorted(changes, reverse=True):
        content = content[:start] + part.encode() + content[end:]
    return content.decode()


def _is_read(names: Mapping[str, Names], name: str, parent: Element, line: int) -> bool:
    """Whether an element is read; refuse one whose name is misspelt, repeated or at the wrong place."""
    parent = parent._replace(line=line)  # for messages
    once, often = names[parent.name].once.split(), names[parent.name].often.split()
    if name in (*once, *often):
        earlier = parent.child(name)
        if name in once and earlier is not None:
            raise InputError(
                f"{parent.where} has a second <{name}>, after the first in line {earlier.line}; remove one of the two."
            )
        if parent.name == "geometry" and parent.children:
            raise InputError(f"{parent.where} has two shapes; put each shape into its own <collision>.")
        return name in names
    if name in names:
        raise InputError(f"{parent.where} contains <{name}>, which is not allowed there; move it to the right element.")
    if ":" not in name:
        _check_name(names, parent, "element", name, [*once, *often])
    return False


def _alike(name: str, other: str) -> bool:
    """Whether one may be the other misspelt; of names of three letters one wrong letter is enough."""
    one_wrong = len(name) == len(other) and sum(map(str.__ne__, name, other)) == 1
    return one_wrong or sorted(name) == sorted(other) or difflib.SequenceMatcher(None, name, other).ratio() >= _ALIKE


def _check_name(known: Mapping[str, Names], element: Element, what: str, name: str, names: list[str]) -> None:
    """Refuse the name of an attribute or element in an element that is misspelt, or none of ``names``."""
    if not known[element.name].others or any(_alike(name.casefold(), other) for other in names):
        shape = "<{}>" if what == "element" else "{}"
        meant = nearest(shape.format(name.casefold()), map(shape.format, names)) if names else "; remove it."
        shown = f"<{quoted(name)[1:-1]}>" if what == "element" else quoted(name)
        raise InputError(f"{element.where} has an unknown {what} {shown}{meant}")
