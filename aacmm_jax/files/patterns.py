"""Fields in braces: one entry of a manifest names every file that its pattern matches."""

import difflib
import fnmatch
import glob
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..core.errors import InputError
from ..core.text import is_control, quoted, shorten

_FIELD = re.compile(r"\{(\w+)\}")
# A folder's or file's name that is one field, perhaps with an extension.
_WHOLE = re.compile(r"\{\w+\}(?:\.\w+)?")
_ANYTHING = "[^/]+"
_WORD = r"(?:[^\W_]|-)+"
_MOST_FIELDS = 8  # each more multiplies the ways in which a name can match
_LONGEST_NAME = 200  # characters
_SHOWN = 3  # near misses that a message names


def fields_of(text: str) -> set[str]:
    """Names of the fields in braces."""
    return set(_FIELD.findall(text))


def check_fields(text: str) -> None:
    """Refuse fields without a name, more of them than a path has folders, and fields with nothing between them."""
    names = _FIELD.findall(text)
    for name in names:
        if not name[0].isalpha():
            raise InputError(
                f"the field {{{name}}} in {quoted(text)} has a name that does not begin with a letter; rename the "
                "field."
            )
    if len(names) > _MOST_FIELDS:
        raise InputError(
            f"{quoted(text)} has more than {_MOST_FIELDS} fields; use fewer fields and write out more of the name."
        )
    if re.search(r"\{\w+\}\{\w+\}", text):
        raise InputError(
            f"{quoted(text)} has two fields with nothing between them; add the text that separates the two fields."
        )


def check_name(name: str) -> None:
    """Refuse a name with characters that act on a terminal or end a text (NUL, ESC), and one longer than a line."""
    if any(map(is_control, name)):
        raise InputError(f"the name {quoted(name)} contains a control character; remove the character.")
    if len(name) > _LONGEST_NAME:
        raise InputError(
            f"the name {quoted(name)} has {len(name):,} characters, more than {_LONGEST_NAME}; shorten the name."
        )


def in_braces(fields: Iterable[str]) -> str:
    """Names of fields as people write them."""
    return ", ".join(f"{{{name}}}" for name in sorted(fields)) or "no field"


def fill(text: str, values: Mapping[str, str]) -> str:
    """The text with its fields replaced by their values."""
    return _FIELD.sub(lambda field: values[field.group(1)], text)


def matching(pattern: str, names: Iterable[str]) -> list[dict[str, str]]:
    """The values of the fields for each name that the pattern matches as a whole, as in `matches`."""
    expression, fields = re.compile(_expression(pattern, _WORD)), list(dict.fromkeys(_FIELD.findall(pattern)))
    return [dict(zip(fields, found.groups(), strict=True)) for name in names if (found := expression.fullmatch(name))]


def matches(folder: Path, pattern: str, exclude: Sequence[str] = ()) -> list[dict[str, str]]:
    """The values of the fields for each file below ``folder`` that the pattern matches, in the order of the paths.

    A field that makes up a whole folder or file name (but for its extension) matches anything but "/"; one that
    shares the name with other text matches letters, digits and "-" only: ``hole_{hole}.csv`` matches ``hole_0.csv``
    and not ``hole_0_pose.csv``. ``exclude``: shell patterns of file names, or of paths relative to ``folder``.
    Raises `InputError` where no file matches, naming those that nearly do.
    """
    before = "" if Path(pattern).is_absolute() else f"{folder.as_posix()}/"

    def below(pattern: str) -> list[str]:
        # Separators only: to resolve "./" or "//" would keep the pattern from matching.
        return sorted(
            path.replace(os.sep, "/").removeprefix(before) for path in glob.glob(glob.escape(before) + pattern)
        )

    paths = below("*".join(map(glob.escape, _FIELD.sub("\0", pattern).split("\0"))))
    left_out = [path for path in paths if is_excluded(path, exclude)]
    kept = [path for path in paths if path not in set(left_out)]
    if values := matching(pattern, kept):
        return values
    loose = re.compile(_expression(pattern, _ANYTHING))
    where = f"no file matches '{pattern}' in {folder}"
    near = [f"'{path}'" for path in kept if loose.fullmatch(path)]
    if near:
        raise InputError(
            f"{where}. The most similar names are {shorten(near, _SHOWN)}. If a file or folder name has other text "
            "beside a field, the field matches only letters, digits and '-'; write out more of the name."
        )
    if left_out:
        shown = shorten([f"'{path}'" for path in left_out], _SHOWN)
        raise InputError(f"{where} except {shown}, but the key exclude leaves these files out; change exclude.")
    # Files as deep in the folders as the pattern, with names like it.
    fixed = _FIELD.split(pattern)[0].rpartition("/")[0]
    deeper = "/".join("*" for _ in pattern.removeprefix(fixed).strip("/").split("/"))
    files = [path for path in below(glob.escape(fixed) + "/" * bool(fixed) + deeper) if os.path.isfile(before + path)]
    alike = [f"'{path}'" for path in difflib.get_close_matches(pattern, files, n=_SHOWN, cutoff=0.3)]
    raise InputError(f"{where}" + (f"; similar names: {', '.join(alike)}" if alike else "") + "; check the path.")


def is_excluded(path: str, exclude: Sequence[str]) -> bool:
    """Whether a path, or its name, matches one of these shell patterns."""
    return any(fnmatch.fnmatchcase(name, x) for x in exclude for name in (path, Path(path).name))


def _expression(pattern: str, partial: str) -> str:
    """Regular expression of a path, with a group for each field, in the order in which they first appear.

    ``partial`` is what a field may be next to other text in a name. A field that is repeated must match the same text
    each time.
    """
    components = [text for text in pattern.split("/") if _FIELD.search(text)]
    shared = {name for text in components if not _WHOLE.fullmatch(text) for name in _FIELD.findall(text)}
    expression, seen = "", []
    for literal, name in re.findall(r"(.*?)(?:\{(\w+)\}|$)", pattern, flags=re.DOTALL):
        expression += re.escape(literal)
        if name in seen:
            expression += f"(?:\\{seen.index(name) + 1})"
        elif name:
            expression += f"({partial if name in shared else _ANYTHING})"
            seen.append(name)
    return expression
