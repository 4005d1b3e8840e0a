"""Fields in braces: one entry of a manifest names every file that its pattern matches."""

import difflib
import fnmatch
import glob
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from ..core.errors import InputError
from ..core.text import is_control, quoted

_FIELD = re.compile(r"\{(\w+)\}")
# A folder's or file's name that is one field, perhaps with an extension.
_WHOLE = re.compile(r"\{\w+\}(?:\.\w+)?")
_ANYTHING = "[^/]+"
_WORD = r"(?:[^\W_]|-)+"
_MOST_FIELDS = 8  # each more multiplies the ways in which a name can match
_LONGEST_NAME = 200  # characters
_NAMED = 3  # near misses that a message names


def fields_of(text: str) -> set[str]:
    """Names of the fields in braces."""
    return set(_FIELD.findall(text))


def check_fields(text: str) -> None:
    """Refuse fields without a name, more of them than a path has folders, and fields with nothing between them."""
    for name in _FIELD.findall(text):
        if not name[0].isalpha():
            raise InputError(f"the field {{{name}}} in {quoted(text)} has no name; begin it with a letter.")
    if len(_FIELD.findall(text)) > _MOST_FIELDS:
        raise InputError(f"{quoted(text)} has more than {_MOST_FIELDS} fields; write more of it out.")
    if re.search(r"\{\w+\}\{\w+\}", text):
        raise InputError(f"{quoted(text)} has two fields with nothing between them; write what divides them.")


def check_name(name: str) -> None:
    """Refuse a name with characters that act on a terminal or end a text (NUL, ESC), and one longer than a line."""
    if any(map(is_control, name)):
        raise InputError(f"the name {quoted(name)} holds a control character; rename it.")
    if len(name) > _LONGEST_NAME:
        raise InputError(f"the name {quoted(name)} has {len(name):,} characters, over {_LONGEST_NAME}; shorten it.")


def in_braces(fields: Iterable[str]) -> str:
    """Names of fields as people write them."""
    return ", ".join(f"{{{name}}}" for name in sorted(fields)) or "no field"


def fill(text: str, values: Mapping[str, str]) -> str:
    """The text with its fields replaced by their values."""
    return _FIELD.sub(lambda field: values[field.group(1)], text)


def matches(folder: Path, pattern: str, exclude: Sequence[str] = ()) -> list[dict[str, str]]:
    """The values of the fields for each file below ``folder`` that the pattern matches, in the order of the paths.

    A field that makes up a whole folder or file name (but for its extension) matches anything but "/"; one that
    shares the name with other text matches letters, digits and "-" only: ``hole_{hole}.csv`` matches ``hole_0.csv``
    and not ``hole_0_pose.csv``. ``exclude``: shell patterns of file names, or of paths relative to ``folder``.
    Raises `InputError` where no file matches, naming those that nearly do.
    """
    before = "" if Path(pattern).is_absolute() else f"{folder.as_posix()}/"
    # Separators only: to resolve "./" or "//" would keep the pattern from matching.
    paths = _glob(glob.escape(before) + "*".join(map(glob.escape, _FIELD.sub("\0", pattern).split("\0"))))
    paths = [path.removeprefix(before) for path in paths]
    kept = [path for path in paths if not _excluded(path, exclude)]
    names = list(dict.fromkeys(_FIELD.findall(pattern)))
    strict, loose = (re.compile(_expression(pattern, partial)) for partial in (_WORD, _ANYTHING))
    values = [dict(zip(names, match.groups(), strict=True)) for path in kept if (match := strict.fullmatch(path))]
    if values:
        return values
    where = f"no file matches '{pattern}' in {folder}"
    near = [path for path in kept if loose.fullmatch(path)]
    if near:
        raise InputError(
            f"{where}, but nearly {_some(near)}: next to other text in a name, a field is letters, digits and '-' "
            "only; write more of the name out."
        )
    if len(kept) < len(paths):
        left_out = [path for path in paths if path not in kept]
        raise InputError(f"{where} but {_some(left_out)}, which exclude leaves out; change exclude.")
    alike = _alike(before, pattern)
    raise InputError(f"{where}" + (f"; there is {_some(alike)}" if alike else "") + "; check the path.")


def _glob(pattern: str) -> list[str]:
    return sorted(path.replace(os.sep, "/") for path in glob.glob(pattern))


def _expression(pattern: str, partial: str) -> str:
    """Regular expression of a path, with a group for each field, in the order in which they first appear.

    ``partial`` is what a field may be next to other text in a name. A field that is repeated must match the same text
    each time.
    """
    components = [text for text in pattern.split("/") if _FIELD.search(text)]
    shared = {name for text in components if not _WHOLE.fullmatch(text) for name in _FIELD.findall(text)}
    expression, last, seen = "", 0, []
    for field in _FIELD.finditer(pattern):
        name = field.group(1)
        expression += re.escape(pattern[last : field.start()])
        if name in seen:
            expression += f"(?:\\{seen.index(name) + 1})"
        else:
            expression += f"({partial if name in shared else _ANYTHING})"
            seen.append(name)
        last = field.end()
    return expression + re.escape(pattern[last:])


def _excluded(path: str, exclude: Sequence[str]) -> bool:
    names = (path, path.rpartition("/")[2])
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in exclude for name in names)


def _alike(before: str, pattern: str) -> list[str]:
    """Files as deep in the folders as the pattern, with names like it."""
    fixed = _FIELD.split(pattern)[0].rpartition("/")[0]
    below = glob.escape(before + fixed) + ("/" if fixed else "")
    deeper = "/".join("*" for _ in pattern.removeprefix(fixed).strip("/").split("/"))
    paths = [path.removeprefix(before) for path in _glob(below + deeper) if os.path.isfile(path)]
    return difflib.get_close_matches(pattern, paths, n=_NAMED, cutoff=0.3)


def _some(paths: Sequence[str]) -> str:
    more = f" and {len(paths) - _NAMED} more" if len(paths) > _NAMED else ""
    return ", ".join(f"'{path}'" for path in paths[:_NAMED]) + more
