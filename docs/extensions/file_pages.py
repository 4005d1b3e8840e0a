"""The reference of file formats: every key that the readers accept, and every group that the writers write.

Keys come from the models that files are validated with; contents of HDF5 files from files that are written here.
"""

import contextlib
import enum
import re
import tempfile
import types
import typing
from pathlib import Path

import h5py
from api_pages import DOCS, write_if_changed
from class_fields import fields
from key_descriptions import DESCRIPTIONS
from pydantic import BaseModel

import aacmm_jax as aj
from aacmm_jax.files import administrative_data, arm_tables, cells, kits, manifest_tables
from aacmm_jax.study import specification

FOLDER = DOCS / "reference" / "files"
# Page: title, what it is for, the model that reads it.
FORMATS: dict[str, tuple[str, str, type[BaseModel]]] = {
    "manifest": (
        "Manifest of a capture",
        "`aacmm import FILE`, `aj.files.read_manifest`",
        manifest_tables.PosesManifest,
    ),
    "points": ("Manifest of points", "`aacmm evaluate FILE`, `aj.files.read_points`", manifest_tables.PointsManifest),
    "arm": ("Arm", "an arm of every command, `aj.load_arm`", arm_tables.ArmFile),
    "study": ("Study", "`aacmm study FILE`, `aj.study.read_study`", specification.Specification),
    "kit": ("Kit of artefacts and instruments", "`aacmm plan --kit FILE`, `aj.files.read_kit`", kits._Kit),
    "cell": ("Cell of a robot", "`aacmm plan --cell FILE`, `aj.files.load_cell`", cells._CellFile),
    "laboratory": (
        "Administrative data",
        "`--about FILE`, `aj.files.read_administrative_data`",
        administrative_data.AdministrativeData,
    ),
}
# Classes whose arguments say what the keys of their tables are.
_DOCUMENTED = {f"{kind.__name__}Table": kind for kind in manifest_tables.TABLES} | {
    f"{kind.__name__}Table": kind for kind in kits.simulated_kinds().values()
}


def _inside(annotation: object) -> list[object]:
    """The types of which an annotation is made, without ``Annotated``, lists and unions."""
    if isinstance(annotation, type) and not isinstance(annotation, types.GenericAlias):
        return [annotation]
    if typing.get_origin(annotation) is typing.Literal:
        return [annotation]
    return [part for inner in typing.get_args(annotation) for part in _inside(inner)]


def _models(annotation: object) -> list[type[BaseModel]]:
    return [part for part in _inside(annotation) if isinstance(part, type) and issubclass(part, BaseModel)]


def _kind(annotation: object) -> str:
    """What a value is in TOML, in words."""
    parts = _inside(annotation)
    text = str(annotation)
    words = []
    for part in parts:
        if typing.get_origin(part) is typing.Literal:
            words += [f"`{value!r}`".replace("'", '"') for value in typing.get_args(part)]
        elif isinstance(part, type) and issubclass(part, enum.Enum | BaseModel):
            words.append("table")
        else:
            words.append({float: "number", int: "whole number", str: "text", bool: "true or false"}.get(part, ""))
    table = re.match(r"(typing\.Annotated\[)?dict\[", text)
    if table:
        words.remove("text")  # the keys
    named = list(dict.fromkeys(word for word in words if word))
    if table:
        return f"table of {' or '.join(named)}" + (", or lists of these" if "list[" in text else "")
    several = "list: " if re.match(r"(typing\.(Annotated|Optional)\[)*list\[", text) else ""
    if several and len(named) == 1 and not named[0].startswith("`"):
        return "tables" if named == ["table"] else f"list of {named[0]}s"
    also = [kind for kind, start in (("list", "list["), ("table", "dict[")) if start in text and not several]
    inner = [str(part) for part in typing.get_args(annotation) if part is not type(None)]
    if also and all(re.match(r"(typing\.Annotated\[)?(list|dict)\[", part) for part in inner):
        return f"{' or '.join(also)} of {' or '.join(f'{word}s' for word in named)}"
    return several + (" or ".join(named) or "date") + (f", or a {' or '.join(also)} of these" if also else "")


def _argument(model: type[BaseModel], key: str) -> str:
    """What the observation of a table says about an argument of this name."""
    text = getattr(_DOCUMENTED.get(model.__name__), "__doc__", None) or ""
    match = re.search(rf"^ +{key}: (.*?)(?=\n +\w+: |\n\n|\Z)", text, flags=re.MULTILINE | re.DOTALL)
    return " ".join(match[1].split()) if match else ""


def description(model: type[BaseModel], key: str, field_name: str) -> str:
    """What a key is: from the observation, the comment in the model, or the list of descriptions."""
    comments = fields(model) if model.__module__.startswith("aacmm_jax") and model.__name__ not in _DOCUMENTED else {}
    comment = comments.get(field_name, ("", ""))[1]
    stated = DESCRIPTIONS.get(f"{model.__name__}.{key}") or DESCRIPTIONS.get(key, "")
    return _argument(model, key) or stated or f"{comment[:1].upper()}{comment[1:]}."[bool(not comment) :]


def tables(model: type[BaseModel]) -> dict[str, tuple[type[BaseModel], bool]]:
    """Every table of a file by its name: its model, and whether there may be several."""
    by_path: dict[str, tuple[type[BaseModel], bool]] = {"": (model, False)}
    waiting = [("", model)]
    while waiting:
        prefix, current = waiting.pop(0)
        for name, field in current.model_fields.items():
            for inner in _models(field.annotation):
                path = f"{prefix}.{field.alias or name}".lstrip(".")
                if path not in by_path:
                    by_path[path] = (inner, "list[" in str(field.annotation))
                    waiting.append((path, inner))
    return by_path


def _table_of_keys(model: type[BaseModel]) -> list[str]:
    lines = ["| key | value | |", "|---|---|---|"]
    for name, field in model.model_fields.items():
        key = field.alias or name
        default = "; required" if field.is_required() else ""
        if not field.is_required() and isinstance(field.default, str | int | float) and field.default not in ("", 0):
            stated = str(field.default).lower() if isinstance(field.default, bool) else field.default
            default = f"; default `{stated}`"
        text = description(model, key, name).replace("|", r"\|")
        lines.append(f"| `{key}` | {_kind(field.annotation)}{default} | {text} |")
    return lines


def page(title: str, purpose: str, model: type[BaseModel]) -> str:
    """One TOML format."""
    lines = [f"# {title}", "", f"A TOML file for {purpose}. Any other key is refused, and so is a quoted number.", ""]
    for path, (table, several) in tables(model).items():
        heading = "At the top" if not path else f"`[[{path}]]`" if several and "." not in path else f"`[{path}]`"
        lines += [f"## {heading}", ""]
        if table.__doc__ and table.__module__.startswith("aacmm_jax") and path and table.__name__ not in _DOCUMENTED:
            lines += [table.__doc__.partition("\n\n")[0].replace("\n   ", "").replace("``", "`"), ""]
        lines += [*_table_of_keys(table), ""]
    return "\n".join(lines)


def _written_files(folder: Path) -> dict[str, Path]:
    """A file of each kind, made of what the examples of the reference use."""
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / "reference" / "index.md").read_text("utf-8"), flags=re.DOTALL)
    namespace: dict[str, typing.Any] = {}
    with contextlib.chdir(folder):
        for block in blocks:
            exec(compile(block, "docs/reference/index.md", "exec"), namespace)
    paths = {name: folder / f"{name}.h5" for name in ("capture", "calibration", "evaluation", "study")}
    aj.files.save_capture(paths["capture"], namespace["recording"])
    aj.files.save_calibration(paths["calibration"], namespace["record"])
    recording = aj.Recording(namespace["two_bars"], namespace["nominal"])
    aj.files.save_evaluation(paths["evaluation"], aj.evaluate_capture(namespace["record"], recording))
    return paths


def _contents(path: Path) -> list[str]:
    """Groups and arrays of a file, with shape, unit and long name."""
    lines = ["| | shape | unit | |", "|---|---|---|---|"]

    def line(name: str, item: h5py.Group | h5py.Dataset) -> None:
        attributes = {key: value for key, value in item.attrs.items() if isinstance(value, str)}
        shape = " x ".join(map(str, item.shape)) if isinstance(item, h5py.Dataset) else "group"
        said = attributes.get("long_name", "") or ", ".join(
            f"`{key}`" for key in item.attrs if isinstance(item, h5py.Group)
        )
        lines.append(f"| `{name}` | {shape or 'one'} | {attributes.get('units', '')} | {said} |".replace("||", "| |"))

    with h5py.File(path) as file:
        lines.append(f"| `/` | group | | {', '.join(f'`{key}`' for key in file.attrs)} |")
        file.visititems(line)
    return lines


def hdf5_page() -> str:
    """The contents of the HDF5 files."""
    lines = [
        "# HDF5 files",
        "",
        "Captures, calibrations, evaluations and studies, after the conventions of netCDF-4: `xarray.open_dataset(FILE,"
        ' group="parameters", engine="h5netcdf")` reads every table with its units. Lengths are in mm, angles in rad.'
        " Listed is what files have that are made of the examples of the reference; the shapes are theirs, and groups"
        " of other observations and models are added where a capture has them. Of groups, attributes are listed.",
        "",
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name, path in _written_files(Path(folder)).items():
            lines += [f"## A {name}" if name != "evaluation" else "## An evaluation", "", *_contents(path), ""]
    return "\n".join(lines)


def write_pages(app) -> None:
    """Write the page of every format; that of HDF5 files, which takes some seconds, where it is missing."""
    for name, (title, purpose, model) in FORMATS.items():
        write_if_changed(FOLDER / f"{name}.md", page(title, purpose, model))
    if not (FOLDER / "hdf5.md").exists():
        write_if_changed(FOLDER / "hdf5.md", hdf5_page())


def setup(app) -> dict[str, object]:
    """Called by Sphinx."""
    app.connect("builder-inited", write_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
