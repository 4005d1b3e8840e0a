"""YAML as cameras' and controllers' files have it: nested keys, lists and texts, from PyYAML; numbers stay text."""

from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.text import quoted

if TYPE_CHECKING:
    from yaml.nodes import Node

_DEEPEST = 20  # levels of nesting; PyYAML calls itself for each


def yaml_content(text: str) -> dict[str, Any]:
    """The entries of a YAML document: mappings, lists and texts.

    Raises `InputError`, also for a document that refers to its own parts, which can be small and yet fill the memory.
    """
    import yaml  # 20 ms, which only these files need

    text = text.removeprefix("%YAML:1.0")  # OpenCV's first line, which is no directive of YAML
    try:
        depth = 0
        for event in yaml.parse(text, Loader=yaml.BaseLoader):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent):
                raise InputError(f"{_line(event)} refers to another part of the file (*); write the value there.")
            if depth > _DEEPEST:
                raise InputError(f"{_line(event)} is nested more than {_DEEPEST} levels deep; give the original file.")
        root = yaml.compose(text, Loader=yaml.BaseLoader)
    except yaml.MarkedYAMLError as error:
        where = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise InputError(f"{where}the file is not valid YAML ({error.problem}); correct the line.") from error
    except yaml.YAMLError as error:
        raise InputError(f"the file is not valid YAML ({' '.join(str(error).split())}); correct the file.") from error
    content = _content(root) if root is not None else None
    if not isinstance(content, dict):
        raise InputError("the file has no 'key: value' at its top level; give the YAML file that the program wrote.")
    return content


def _content(node: "Node") -> Any:
    import yaml

    if not isinstance(node, yaml.MappingNode):
        return [_content(item) for item in node.value] if isinstance(node, yaml.SequenceNode) else node.value
    entries: dict[str, Any] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode):
            raise InputError(f"{_line(key)} has a list or table as key; correct the line.")
        if key.value in entries:
            raise InputError(f"{_line(key)}: {quoted(key.value)} occurs twice; remove one of the two.")
        entries[key.value] = _content(value)
    return entries


def _line(part: Any) -> str:
    return f"line {part.start_mark.line + 1}"
