"""Files that are written: whole or not at all, all those of a command together, and none that the command reads.

Whatever is written goes to a temporary file in the same folder, which is locked while its writer runs and is renamed
at the end. So a temporary file without a lock was left by a process that was killed, and is removed.

A command replaces a file only where aacmm wrote it, as it says itself or as its beginning shows (`asking`).
"""

import contextlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, NamedTuple

from ..core.errors import InputError
from ..core.file_owners import is_planted_link, may_replace

try:
    import fcntl
except ImportError:  # Windows, where an open file cannot be removed, which serves as the lock
    fcntl = None

ELSEWHERE = "choose another output path"
_MARKS = (b"aacmm", b"atplotlib")  # near the beginning or end of most files that are written here
_MARKED = (".h5", ".html", ".pdf", ".png", ".svg", ".xml")  # of which all have one
_ENDS = 2**14  # bytes
_FIRST_ELEMENT = re.compile(rb"<[A-Za-z][^>]*>")
_asking: ContextVar[bool] = ContextVar("asking", default=False)


def as_path(path: Any) -> Path:
    """The path of a file, or `InputError` for anything else: a number would name an open file."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"the path of a file is of type {type(path).__name__}; give the path as text.")
    return Path(path)


def storable(text: str) -> str:
    """The same text, or `InputError` where HDF5 and TOML cannot hold it (NUL, or a file name that is not UTF-8)."""
    if "\0" in text or text.encode(errors="ignore").decode() != text:
        raise InputError(
            f"the name {text!r} contains a character that cannot be stored in a file; choose another name."
        )
    return text


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file whole or not at all."""
    with write_atomically(path) as temporary:
        temporary.write_bytes(text.encode())


@contextlib.contextmanager
def write_atomically(
    path: str | os.PathLike,
    advice: str = ELSEWHERE,
    *,
    leftovers: bool = True,
    same_kind: Callable[[Path], bool] | None = None,
) -> Iterator[Path]:
    """Write a file whole or not at all: yields a temporary path in the same folder, renamed onto it at the end.

    Inside `together`, the end is that of all outputs. A symbolic link is followed: the file that it points to is
    written. A file that is replaced leaves its permissions to the new one. Whatever goes wrong (Ctrl-C included), the
    temporary file is removed and an existing target stays as it was; ``leftovers``: those of killed processes are
    removed as well; ``same_kind`` as in `OutputFile`. Raises `InputError` where the path cannot be written, is a
    folder, a device, a pipe or read-only, or, in a command, where it is a file that aacmm did not write (`asking`).
    """
    file, group = OutputFile(path, advice, same_kind), _current.get()
    waits = False
    try:
        with file.refusing():
            file.check()
            if leftovers:
                _remove_leftovers(file.target)
            file.create()
            yield file.temporary
            with open(file.temporary, "rb+") as written:
                os.fsync(written.fileno())
            if file.target.exists():
                replaced = file.target.stat()
                if hasattr(os, "chown"):
                    with contextlib.suppress(OSError):
                        os.chown(file.temporary, replaced.st_uid, replaced.st_gid)
                os.chmod(file.temporary, stat.S_IMODE(replaced.st_mode))
            file.check_replaced()
            if group is None:
                _put_in_place([file])
            else:  # it waits for the others
                for read in group.read:
                    _check_different(file, read)
                if file.target in group.made:
                    group.made[file.target].discard()
                group.made[file.target] = file
                waits = True
    finally:
        if not waits:
            file.discard()


class OutputFile:
    """A file that is being written under a temporary name; a symbolic link is followed to the file it points to.

    ``same_kind`` says whether an existing file is of the kind of the new one, where more than their ends tells it.
    """

    def __init__(
        self, path: str | os.PathLike, advice: str = ELSEWHERE, same_kind: Callable[[Path], bool] | None = None
    ):
        self.named, self._advice, self._same_kind = as_path(path), advice, same_kind
        with self.refusing():
            if "\0" in str(path):
                raise OSError(None, "its name contains a NUL character")
            self.target = Path(os.path.realpath(self.named))
        self.temporary = _beside(self.target)
        self._lock: int | None = None
        self.backup: Path | None = None

    @contextlib.contextmanager
    def refusing(self) -> Iterator[None]:
        """Whatever the operating system refuses is an `InputError` that names the file."""
        try:
            yield
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise InputError(f"{self.named} cannot be written: {reason}; {self._advice}.") from error

    def check(self) -> None:
        """Raise `OSError` where the file cannot be written."""
        named, target, folder = self.named, self.target, self.target.parent
        exists = target.exists()
        # A link in /proc (/dev/stdout) leads to what has no path, and one that leads to itself remains a link.
        no_file = (named.exists() or exists or target.is_symlink()) and not target.is_file()
        problems = {
            "it is another user's link": is_planted_link(named),
            "it is a folder": no_file and target.is_dir(),
            "it is not an ordinary file": no_file,
            # The superuser may write to a file without write permission, which is protected all the same.
            "it is read-only": exists and not (target.stat().st_mode & 0o222 and os.access(target, os.W_OK)),
            "not a directory": folder.stat() and not folder.is_dir(),  # there must be one
            "its folder is read-only": not os.access(folder, os.W_OK | os.X_OK),
            "it belongs to another user, and only that user may replace it": exists and not may_replace(target),
        }
        for problem, present in problems.items():
            if present:
                raise OSError(None, problem)

    def create(self) -> None:
        """Make the temporary file and lock it; whoever removes leftovers may have seen it before it was locked."""
        while True:
            mode = 0o600 if self.target.exists() else 0o666  # later it gets the permissions of what it replaces
            self._lock = os.open(self.temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, mode)
            if fcntl is None:
                return
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(self._lock, fcntl.LOCK_EX)
            if self.temporary.exists():
                return
            self._unlock()

    def check_replaced(self) -> None:
        """Raise `InputError` where a file would replace one that somebody else wrote; of commands only.

        Before any work where its name tells that the new one will say who wrote it; else once it is complete.
        """
        if not _asking.get() or not self.target.exists():
            return
        if not self.temporary.exists():
            ours = self.target.suffix.lower() not in _MARKED or _is_marked(self.target)
        else:
            # Where the new file says who wrote it, the old one must, too. Tables, TOML, JSON and URDF have no place for
            # that: they must have the same first line, or element, with the names of columns, of the arm or the robot.
            first, first_new = _ends(self.target)[0], _ends(self.temporary)[0]
            if _is_marked(self.temporary):
                ours = _is_marked(self.target) and first[:4] in (b"", first_new[:4])
            else:
                ours = not first or _beginning(first) == _beginning(first_new)
            if ours and self._same_kind is not None and os.path.getsize(self.target):
                token = _current.set(None)  # it may be read, though it is an output
                try:
                    ours = self._same_kind(self.target)
                finally:
                    _current.reset(token)
        if not ours:
            raise InputError(
                f"{self.named} exists and is not an earlier output of the same kind; choose another name, or replace "
                "it with --overwrite."
            )

    def replace(self, keep: bool) -> None:
        """Put the new file in place; with ``keep``, the old one can be put back from its backup."""
        if keep and self.target.exists():
            self.backup = _beside(self.target)
            try:
                os.link(self.target, self.backup)
            except OSError:  # a file system without hard links
                shutil.copy2(self.target, self.backup)
        self.check()
        if fcntl is None:
            self._unlock()
        os.replace(self.temporary, self.target)

    def discard(self) -> None:
        """Remove the temporary files that are left."""
        self._unlock()
        for left in (self.temporary, self.backup):
            if left is not None:
                with contextlib.suppress(OSError):
                    left.unlink()

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None


def _beside(target: Path) -> Path:
    return target.parent / f".{target.name}.{secrets.token_hex(4)}.part"


def _put_in_place(files: list[OutputFile]) -> None:
    """Rename all files or none: where one cannot be, those before it are undone."""
    replaced: list[OutputFile] = []
    try:
        for file in files:
            with file.refusing():
                file.replace(keep=len(files) > 1)
            replaced.append(file)
    except BaseException:
        for file in reversed(replaced):
            with contextlib.suppress(OSError):
                if file.backup is None:
                    file.target.unlink()
                else:
                    os.replace(file.backup, file.target)
        raise
    finally:
        for file in files:
            file.discard()


def _remove_leftovers(target: Path) -> None:
    """Remove the temporary files of processes that were killed while they wrote this file."""
    pattern = re.compile(rf"\.{re.escape(target.name)}\.[0-9a-f]{{8}}\.part")
    with contextlib.suppress(OSError):
        for item in os.scandir(target.parent):
            if not pattern.fullmatch(item.name) or not item.is_file(follow_symlinks=False):
                continue
            with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
                if fcntl is not None:
                    descriptor = os.open(item.path, os.O_RDONLY | os.O_NOFOLLOW)
                    stack.callback(os.close, descriptor)
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(item.path)


@contextlib.contextmanager
def asking() -> Iterator[None]:
    """What is written in this block replaces no file that aacmm did not write; `InputError` asks for --overwrite."""
    token = _asking.set(True)
    try:
        yield
    finally:
        _asking.reset(token)


def check_kept(path: str | os.PathLike, original: str) -> None:
    """Raise `InputError`, in a command, where the file that would be replaced is this text, which the user wrote."""
    if _asking.get() and os.path.isfile(path) and Path(path).read_bytes() == original.encode():
        raise InputError(
            f"{path} is the file from which the arm was read; choose another name, or replace it with --overwrite."
        )


def _is_marked(path: Path) -> bool:
    """Whether a file says that this package wrote it; or is empty."""
    both = b"".join(_ends(path))
    return not both or any(mark in both for mark in _MARKS)


def _ends(path: Path) -> tuple[bytes, bytes]:
    with open(path, "rb") as stream:
        first = stream.read(_ENDS)
        stream.seek(max(os.path.getsize(path) - _ENDS, 0))
        return first, stream.read()


def _beginning(text: bytes) -> bytes:
    element = _FIRST_ELEMENT.search(text) if text.lstrip(b"\xef\xbb\xbf").startswith(b"<") else None
    return element[0] if element else b"".join(text.split(b"\n", 2)[: 2 if text.startswith(b"{") else 1])


class _Outputs(NamedTuple):
    """The outputs of a command: those that are announced, those that are made and wait; and what it reads."""

    announced: list[OutputFile]
    made: dict[Path, OutputFile]
    read: list[Path]


_current: ContextVar[_Outputs | None] = ContextVar("outputs", default=None)


@contextlib.contextmanager
def together(*paths: str | os.PathLike | None) -> Iterator[None]:
    """What is written in this block appears at its end, all files together; after an exception, none.

    ``paths`` are the files that will be written, None those that are not asked for. Raises `InputError`, before any
    work, where one of them cannot be written or is named twice; and as soon as one of them is read.
    """
    outputs = [OutputFile(path) for path in paths if path is not None]
    for number, output in enumerate(outputs):
        with output.refusing():
            output.check()
        output.check_replaced()
        if any(_same(output.target, other.target) for other in outputs[:number]):
            raise InputError(f"{output.named} is given for two outputs; choose a different file for one of the two.")
    group = _Outputs(outputs, {}, [])
    token = _current.set(group)
    try:
        yield
        _put_in_place(list(group.made.values()))
    finally:
        _current.reset(token)
        for file in group.made.values():
            file.discard()


def reading(path: str | os.PathLike) -> None:
    """A file is about to be read: raise `InputError` where it is one of the outputs of the command."""
    group = _current.get()
    if group is not None:
        group.read.append(Path(path))
        for output in group.announced:
            _check_different(output, Path(path))


def waiting(path: str | os.PathLike) -> Path:
    """Where the content of a file is: of an output that is made but not in place yet, its temporary name."""
    group = _current.get()
    made = None if group is None else group.made.get(Path(os.path.realpath(path)))
    return Path(path) if made is None else made.temporary


def _check_different(output: OutputFile, path: Path) -> None:
    if _same(output.target, path):
        raise InputError(f"{output.named} is one of the files that this command reads; choose another output.")


def _same(first: Path, second: Path) -> bool:
    if os.path.realpath(first) == os.path.realpath(second):
        return True
    try:
        return os.path.samefile(first, second)
    except (OSError, ValueError):  # one of them does not exist
        return False
