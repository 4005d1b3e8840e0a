"""Which files are tables, but not text, and their lines as a text table would have them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ...core.errors import InputError, require
from ..inputs import InputFile
from ..reader_process import read_apart

# By the end of a file's name: the module that reads it, and the extra that it needs.
_SOURCES: dict[str, tuple[str, str]] = {
    ".mat": ("matlab", ""),
    ".npz": ("numpy_arrays", ""),
    ".npy": ("numpy_arrays", ""),
    ".json": ("nested_lists", ""),
    ".xlsx": ("spreadsheet", "excel"),
    ".xlsm": ("spreadsheet", "excel"),
    ".parquet": ("lerobot_dataset", "lerobot"),
    ".bag": ("recordings", "ros"),
    ".db3": ("recordings", "ros"),
    ".mcap": ("recordings", "ros"),
    ".zstd": ("recordings", "ros"),
}
_FOLDERS = (".parquet", ".db3", ".mcap", ".zstd")  # what a recording or data set in a folder consists of
_MOST_FILES = 10_000
_MOST_CHARACTERS = 2**27


class Lines(NamedTuple):
    """A table as lines of text with tabs between the cells."""

    lines: list[str]
    header: bool  # whether the first line is the names of the columns, and no row of the file
    note: str  # what was read, where that is not all of the file


class InputFolder(os.PathLike):
    """A folder of files that are one table together, each of them read once. Raises `InputError`."""

    def __init__(self, path: str | os.PathLike):
        self._path = Path(path)
        paths = sorted(file for file in self._path.rglob("*") if file.suffix in _FOLDERS and file.is_file())
        if not paths or len(paths) > _MOST_FILES:
            raise InputError(
                f"{path} is a folder with {len(paths):,} files ending in {', '.join(_FOLDERS)}; give a file, or the "
                "folder of a ROS 2 recording or of a LeRobot data set."
            )
        paths += [file for file in [self._path / "meta" / "info.json"] if file.is_file()]
        self.files = [InputFile(file) for file in paths]

    def __fspath__(self) -> str:
        return str(self._path)

    __str__ = __fspath__


def input_table(path: str | os.PathLike, share: float = 1.0) -> InputFile | InputFolder:
    """Open what a table is read from: a file, of at most this ``share`` of the limit unless it is a recording, or a
    folder."""
    if os.path.isdir(path):
        return InputFolder(path)
    return InputFile(path, 1.0 if is_recording(path) else share)


def is_recording(path: str | os.PathLike) -> bool:
    """Whether a path is that of a recording of ROS, or a folder."""
    return os.path.isdir(path) or _SOURCES.get(Path(path).suffix.lower(), ("", ""))[0] == "recordings"


def lines_of_source(path: str | os.PathLike, tables: Sequence[str] = (), corners: int = 0) -> Lines | None:
    """The lines of a table in a file that is not text; None of any other file. Raises `InputError`.

    Args:
        path: the file, or folder.
        tables: what in the file: a variable, a sheet, topics of a recording; by default the only one.
        corners: the dimension of the corners that are wanted instead of a row for each pose, else 0.
    """
    if os.path.isdir(path) and not isinstance(path, InputFolder):
        path = InputFolder(path)
    files = path.files if isinstance(path, InputFolder) else [path]
    module, extra = _SOURCES.get(Path(files[0]).suffix.lower(), ("", ""))
    if not module:
        if tables:
            raise InputError(f"{path} is a text file, so table does not apply; remove table.")
        return None
    if extra:
        require(extra, f"Reading {Path(path).name}")
    opened = [file if isinstance(file, InputFile) else InputFile(file) for file in files]
    members = {os.path.relpath(file, path) if len(opened) > 1 else Path(file).name: file.content for file in opened}
    options = {"tables": list(tables), "corners": corners}
    read = read_apart(path, f"{__package__}.{module}", members, options)
    lines = read["text"].split("\n")
    if len(read["text"]) > _MOST_CHARACTERS:
        raise InputError(f"{path} has a table of more than {_MOST_CHARACTERS // 2**20} MiB; give a smaller one.")
    return Lines(lines, read["header"], read["note"])
