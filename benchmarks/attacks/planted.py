"""What another user leaves where a study will be run: a folder of blocks, blocks, links, modules; and what they can
read of files while these are written.

Both are ordinary users with numbers of their own, in a folder where everybody may make files, as in /tmp.
"""

import os
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import h5py

import aacmm_jax as aj
from aacmm_jax.study.blocks import VARIABLES, computed_with
from aacmm_jax.study.store import Results, parts_of, write_block

from .kills import differences
from .outcomes import DONE, REFUSED, SAME, SILENT, UNEXPECTED, Attempt, is_sentence
from .samples import BLOCK
from .work_as import OTHER_USER, USER, as_user

MODULES = ("json", "signal", "pickle", "runpy", "multiprocessing", "numpy", "jax", "h5py", "filelock", "aacmm_jax")
LINE = "from aacmm_jax.cli import main\n\nif __name__ == '__main__':\n    main()\n"


class Place:
    """A folder where everybody may make files, a Python that every user can run, and a home for the user."""

    def __init__(self, folder: Path):
        self.root = Path(tempfile.mkdtemp(dir="/tmp"))
        self.root.chmod(0o755)
        self.shared, self.home = self.root / "shared", self.root / "home"
        for made, mode in ((self.shared, 0o1777), (self.home, 0o700)):
            made.mkdir()
            made.chmod(mode)
        os.chown(self.home, USER, USER)
        self.python = readable_python(self.root)
        self.command = self.root / "aacmm"  # as pip writes it: what its folder holds is looked for first
        self.command.mkdir()
        (self.command / "aacmm").write_text(LINE)
        # One study, begun and finished, as root's, from which others are made.
        self.sample = folder / "sample"
        self.sample.mkdir()
        # In a process of its own: this one forks, which JAX does not survive once it has computed.
        program = "import pathlib, sys; from attacks.samples import make; make(pathlib.Path(sys.argv[1]))"
        folders = os.pathsep.join([str(Path(__file__).parents[1]), *filter(None, sys.path)])
        line = [sys.executable, "-c", program, str(self.sample)]
        subprocess.run(line, env=os.environ | {"PYTHONPATH": folders}, check=True)

    def run(self, *words: object, user: int = USER, umask: int = 0o022) -> tuple[int, str]:
        """Exit code and standard error of a command of one of the users."""
        process = self.started(*words, user=user, umask=umask)
        _, errors = process.communicate(timeout=600)
        return process.returncode, errors

    def started(self, *words: object, user: int = USER, umask: int = 0o022) -> subprocess.Popen:
        """A command of one of the users, in the shared folder, as a process of its own."""
        paths = [path for path in sys.path if "site-packages" in path]
        environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(self.home),
            "LD_LIBRARY_PATH": str(self.python.parents[1] / "lib"),
            "PYTHONPATH": os.pathsep.join([str(Path(aj.__file__).parents[1]), *paths]),
        }
        line = [str(self.python), str(self.command / "aacmm"), *map(str, words)]
        return subprocess.Popen(
            line, cwd=self.shared, env=environment, umask=umask, user=user, group=user, extra_groups=[],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def unfinished(self, owner: int, *, poisoned: bool = False) -> Path:
        """A study of a user without its last block, in the shared folder; ``poisoned``: with other numbers."""
        path, study = self.shared / "s.h5", aj.study.read_study(self.sample / "study.toml")
        stored = Results(path, study, BLOCK, computed_with())
        stored.create()
        with h5py.File(self.sample / "study.h5") as whole:
            for block in stored.blocks[:-1]:
                results = {name: whole["trials"][name][block.slices] for name in VARIABLES}
                results["estimate"] = results["estimate"] + poisoned
                write_block(stored.file_of(block), results)
        own(path, owner)
        own(parts_of(path), owner)
        return path

    def clear(self) -> None:
        """Empty the shared folder."""
        for item in self.shared.iterdir():
            shutil.rmtree(item) if item.is_dir() and not item.is_symlink() else item.unlink()


def readable_python(root: Path) -> Path:
    """This Python, or a copy of it where other users may not enter its folder."""
    executable = Path(os.path.realpath(sys.executable))
    if all(folder.stat().st_mode & stat.S_IXOTH for folder in executable.parents):
        return executable
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    ignored = shutil.ignore_patterns("site-packages", "test", "__pycache__", "*.a", "config-*")
    shutil.copytree(Path(sys.base_prefix) / "lib" / version, root / "python" / "lib" / version, ignore=ignored)
    for library in (Path(sys.base_prefix) / "lib").glob("libpython*.so*"):
        shutil.copy(library, root / "python" / "lib")
    (root / "python" / "bin").mkdir()
    return Path(shutil.copy(executable, root / "python" / "bin" / version))


def own(path: Path, user: int) -> None:
    """Give a file, or a folder and what it contains, to a user."""
    for item in (path, *path.rglob("*")):
        os.chown(item, user, user, follow_symlinks=False)


def plant_study(place: Place) -> None:
    """A study of the other user, unfinished and with other numbers."""
    place.unfinished(OTHER_USER, poisoned=True).chmod(0o666)


def plant_finished(place: Place) -> None:
    """A finished study of the other user."""
    shutil.copy(place.sample / "study.h5", place.shared / "s.h5")
    own(place.shared / "s.h5", OTHER_USER)
    (place.shared / "s.h5").chmod(0o666)


def plant_folder(place: Place) -> None:
    """Only its folder of blocks: their names are right, and their seals valid."""
    place.unfinished(OTHER_USER, poisoned=True).unlink()


def plant_folder_beside(place: Place) -> None:
    """The folder of blocks beside an unfinished study of the user, which lacks its own."""
    own(place.unfinished(OTHER_USER, poisoned=True), USER)


def plant_link_to_folder(place: Place) -> None:
    """A link to a folder of blocks, beside the user's study."""
    path = place.unfinished(USER, poisoned=True)
    parts_of(path).rename(elsewhere := place.shared / "elsewhere")
    parts_of(path).symlink_to(elsewhere)
    os.chown(parts_of(path), OTHER_USER, OTHER_USER, follow_symlinks=False)


def plant_block(place: Place) -> None:
    """A block in the user's folder, as the other user could leave it while the folder's mode allowed it."""
    path = place.unfinished(USER, poisoned=True)
    own(min(parts_of(path).iterdir()), OTHER_USER)


def plant_link_to_block(place: Place) -> None:
    """A link to a block."""
    path = place.unfinished(USER, poisoned=True)
    block = min(parts_of(path).iterdir())
    block.rename(elsewhere := place.shared / "elsewhere.h5")
    block.symlink_to(elsewhere)
    os.chown(block, USER, USER, follow_symlinks=False)


def plant_open_folder(place: Place) -> None:
    """A folder of blocks that everybody may write to."""
    parts_of(place.unfinished(USER, poisoned=True)).chmod(0o777)


def plant_link_to_output(place: Place) -> None:
    """A link from the study's name to a file of the user."""
    (place.shared / "s.h5").symlink_to(place.home / "precious")
    os.chown(place.shared / "s.h5", OTHER_USER, OTHER_USER, follow_symlinks=False)


def plant_lock(place: Place) -> None:
    """A link from the name of the study's lock to a file of the user."""
    lock = place.shared / ".s.h5.lock"
    lock.symlink_to(place.home / "precious")
    os.chown(lock, OTHER_USER, OTHER_USER, follow_symlinks=False)


PLANTED = (
    plant_study,
    plant_finished,
    plant_folder,
    plant_folder_beside,
    plant_link_to_folder,
    plant_block,
    plant_link_to_block,
    plant_open_folder,
    plant_link_to_output,
    plant_lock,
)


def against_studies(place: Place) -> Iterator[Attempt]:
    """Studies that are started, continued or read where something is planted."""
    for plant in PLANTED:
        place.clear()
        (precious := place.home / "precious").write_text("precious")
        own(precious, USER)
        plant(place)
        before = listed(place.shared)
        code, errors = place.run("study", place.sample / "study.toml", "-o", place.shared / "s.h5")
        what = f"{plant.__doc__}: {errors}"
        if precious.read_text() != "precious" or (code == 2 and listed(place.shared) != before):
            yield Attempt("planted", SILENT, f"changed: {what}")
        elif code == 2:
            yield Attempt("planted", REFUSED if is_sentence(errors.strip()) else UNEXPECTED, what)
        else:  # what is right was computed all the same
            different = differences(place.sample / "study.h5", place.shared / "s.h5")
            yield Attempt("planted", SILENT if code or different else SAME, what)
    for owner, plant, believed in (
        ("a colleague's study", plant_study, True),
        ("a folder of another user", plant_folder_beside, False),
        ("a link to a folder", plant_link_to_folder, False),
        ("a block of another user", plant_block, False),
        ("a link to a block", plant_link_to_block, False),
    ):
        place.clear()
        plant(place)
        code, errors = place.run("show", place.shared / "s.h5")
        expected = (code == 0) if believed else (code == 2 and is_sentence(errors.strip()))
        right = DONE if believed else REFUSED
        yield Attempt("planted: read", right if expected else SILENT, f"{owner}: {code} {errors}")


def listed(folder: Path) -> dict[str, tuple]:
    """What is in a folder, and whose."""
    found = ((item, item.lstat()) for item in folder.rglob("*"))
    return {str(item): (one.st_ino, one.st_size, one.st_uid, one.st_mode) for item, one in found}


def against_modules(place: Place) -> Iterator[Attempt]:
    """Whether commands run modules that the other user put into the working folder."""
    place.clear()
    for name in MODULES:
        marker = place.shared / f"ran-{name}"
        (place.shared / f"{name}.py").write_text(f"open({str(marker)!r}, 'w').close()\nraise ImportError\n")
    own(place.shared, OTHER_USER)
    home = place.home
    for words in (
        ("demo", home / "demo"),
        ("study", place.sample / "study.toml", "-o", home / "study.h5"),
        ("report", home / "study.h5", "-o", home / "study.html"),
        ("show", home / "study.h5", "--figures", home / "figures"),
    ):
        code, errors = place.run(*words)
        ran = sorted(item.name for item in place.shared.glob("ran-*"))
        outcome = SILENT if ran else UNEXPECTED if code else DONE
        yield Attempt("modules", outcome, f"{' '.join(map(str, words))}: {ran} {errors[-500:]}")


def against_temporary_files(place: Place) -> Iterator[Attempt]:
    """Whether the other user can read a file while it is written that they may not read afterwards."""
    out, specification = place.root / "out", place.sample / "study.toml"
    for what, umask, mode in (("a new file", 0o077, None), ("a private file replaced", 0o022, 0o600)):
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(mode=0o755)
        words = {
            "simulate": (
                "simulate",
                "cheng2018-simulation",
                "-o",
                out / "c.h5",
                "--poses",
                9,
                "--socket",
                "A=400,200,300",
            ),
            "study": ("study", specification, "-o", out / "s.h5", "--workers", "1"),
            "report": ("report", place.sample / "study.h5", "-o", out / "r.html"),
        }
        if mode is not None:
            for line in words.values():
                (file := Path(line[line.index("-o") + 1])).write_bytes(b"")
                file.chmod(mode)
            (out / "s.h5").unlink()  # a study that is continued is its own
        own(out, USER)
        for name, line in words.items():
            if mode is not None and name == "study":
                continue
            process = place.started(*line, umask=umask)
            seen = as_user(OTHER_USER, lambda process=process: opened_meanwhile(process.pid, out))
            _, errors = process.communicate()
            outcome = UNEXPECTED if process.returncode else SILENT if seen else DONE
            yield Attempt("temporary files", outcome, f"{what}: {name}: {seen} {errors[-500:]}")


def opened_meanwhile(process: int, folder: Path) -> list[str]:
    """The files below a folder that could be opened while a process ran."""
    seen: set[str] = set()
    while alive(process):
        for path in folder.rglob("*"):
            try:
                with open(path, "rb"):
                    seen.add(path.name)
            except OSError:
                continue
        time.sleep(0.001)
    return sorted(seen)


def alive(process: int) -> bool:
    """Whether a process has not ended; one that has is a zombie until its parent asks."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def attack(folder: Path) -> Iterator[Attempt]:
    """Everything once."""
    place = Place(folder)
    try:
        yield from against_studies(place)
        yield from against_modules(place)
        yield from against_temporary_files(place)
    finally:
        shutil.rmtree(place.root)
