"""A process that reads every HDF5 file before this one does, within limits of time and memory.

On damaged metadata the HDF5 library loops for ever in C, where Ctrl-C does not end it, takes gigabytes, or crashes. The
SHA-256 at the end of a file detects what happened to it by chance, but anybody can compute it again. So a child process
reads all of a file first, in the way in which it will be read here. Where it does not come to the end, the file is
refused. The child serves all files up to the first that is refused, then another is started; it ends with this process,
whose pipe to it is then closed. It is a new interpreter and no fork: threads of JAX may hold locks.

Tables in files that are not text are read by the child alone, which returns their lines: a few bytes of such a file may
unpack to gigabytes, and their libraries are as little prepared for damage as that of HDF5.
"""

import atexit
import contextlib
import faulthandler
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import InputError

# An intact file takes some milliseconds, and little more memory than its own size.
_CPU_SECONDS, _SECONDS_PER_MIB, _CLOCK_PER_CPU = 2.0, 1.0, 30
_MEMORY = 256 * 2**20
# Of a table: compressed ones unpack to tens of times their size, and are slow to read where each cell is an object.
_TABLE_SECONDS, _TABLE_SECONDS_PER_MIB, _TABLE_MEMORY = 10.0, 3.0, 2**30
_MOST_SEALS = 100_000
_vouched_for: set[str] = set()
_READY = b"ready\n"
_COMMAND = "import sys; sys.path[:] = sys.argv[1:]; from aacmm_jax.files.reader_process import serve; serve()"


def damaged(path: str | os.PathLike) -> InputError:
    """What is said of a file that cannot be read to its end."""
    return InputError(f"{path} is damaged or incomplete, or was edited; create it again.")


def vouch_for(seal: str) -> None:
    """This process has written the file with this seal, or it was read through: it need not be again."""
    if len(_vouched_for) >= _MOST_SEALS:
        _vouched_for.clear()
    _vouched_for.add(seal)


def _has_interpreter() -> bool:
    """A program that contains Python may have none beside it."""
    return bool(sys.executable) and not getattr(sys, "frozen", False)


def read_through(path: str | os.PathLike, source: Any, size: int, largest: int, seal: str) -> None:
    """Raise `InputError` where HDF5 cannot read a file, or what is in it is not what files of this package contain.

    ``source`` is its bytes, or the open file where they are too many for the memory: the child opens it by its name.
    """
    if seal in _vouched_for:
        return
    if not _has_interpreter():
        from .hdf5_content import check

        check(str(path), source, size, largest)
        vouch_for(seal)
        return
    content = source.getbuffer() if hasattr(source, "getbuffer") else source  # of a file that is in memory already
    sent = isinstance(content, bytes | memoryview)
    seconds = _CPU_SECONDS + _SECONDS_PER_MIB * size / 2**20
    request = {
        "path": str(path),
        "opened": None if sent else os.path.abspath(path),
        "sent": len(content) if sent else 0,
        "size": size,
        "largest": largest,
        # Of memory: the bytes, copies of them in HDF5, and what is read.
        "limits": (seconds, _CLOCK_PER_CPU * seconds, _MEMORY + 3 * size + min(largest, 100 * size)),
    }
    answer = _reader.answer(request, content if sent else b"")
    if answer is None:
        raise damaged(path)
    if answer:
        raise InputError(answer)
    vouch_for(seal)


def read_apart(
    path: str | os.PathLike, module: str, members: Mapping[str, bytes], options: Mapping[str, Any]
) -> dict[str, Any]:
    """What ``read(members, **options)`` of a module of this package returns, from the child: values that JSON can hold.

    ``members`` are the contents of the files by name. Its `InputError` says what is wrong as a predicate: "has no
    sheet". Raises `InputError` that begins with the path, also where the child does not come to the end.
    """
    size = sum(map(len, members.values()))
    seconds = _TABLE_SECONDS + _TABLE_SECONDS_PER_MIB * size / 2**20
    request = {
        "path": str(path),
        "module": module,
        "options": dict(options),
        "members": [(name, len(content)) for name, content in members.items()],
        "sent": size,
        "limits": (seconds, _CLOCK_PER_CPU * seconds, _TABLE_MEMORY + 4 * size),
    }
    answer = _reader.answer(request, *members.values()) if _has_interpreter() else _read_table(request, members)
    if answer is None or "refused" in answer:
        unreadable = (
            "is damaged or incomplete, or takes too much memory or time to read; save it again, or give a smaller file."
        )
        raise InputError(f"{path} {(answer or {}).get('refused') or unreadable}")
    return answer


def _read_table(request: dict[str, Any], members: Mapping[str, bytes]) -> dict[str, Any] | None:
    """The answer to a request of `read_apart`: what was read, or why it is refused."""
    try:
        return importlib.import_module(request["module"]).read(members, **request["options"])
    except InputError as error:
        return {"refused": str(error)}
    except MemoryError:
        return None
    except Exception:  # a single wrong byte surfaces as almost any exception of these libraries
        return {"refused": ""}


def start() -> None:
    """Start the child where none runs; it is ready some time later."""
    with _reader.lock, contextlib.suppress(OSError, TypeError, ValueError):  # which `answer` meets again
        _reader.start()


class _Reader:
    """The child process, and the requests to it: one at a time."""

    def __init__(self) -> None:
        self._process: Any = None
        self._started = False  # whether it has said that it is ready
        self.lock = threading.Lock()

    def start(self) -> None:
        if self._process is not None and self._process.poll() is None:
            return
        self.stop()
        home = str(Path(__file__).parents[2])
        # Nothing is imported from the current folder, unless the package itself was.
        paths = [path for path in sys.path if os.path.isabs(path) or os.path.abspath(path) == home]
        options: dict[str, Any] = {"start_new_session": True}  # Ctrl-C is for this process alone
        if os.name == "nt":
            options = {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-X", "utf8", "-c", _COMMAND, *map(os.path.abspath, [*paths, home])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd=os.path.abspath(os.sep),
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            **options,
        )

    def stop(self) -> None:
        """End the child, which has nothing to lose."""
        process, self._process, self._started = self._process, None, False
        if process is not None:
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with contextlib.suppress(OSError):  # what was not sent
                    pipe.close()

    def answer(self, request: dict[str, Any], *contents: Any) -> Any:
        """What was read, empty where that is nothing; a sentence why it cannot be; None where the file is damaged."""
        with self.lock:
            try:
                return self._ask(request, contents)
            except BaseException:  # the answer to a request that was interrupted must not be taken for the next one's
                self.stop()
                raise

    def _ask(self, request: dict[str, Any], contents: Sequence[Any]) -> Any:
        path = request["path"]
        try:
            self.start()
            if not self._started and self._process.stdout.readline() != _READY:
                raise OSError(None, f"exit status {self._process.wait()}")
        except (OSError, TypeError, ValueError) as error:  # an interpreter that is not there, has no name, or fails
            reason = (getattr(error, "strerror", None) or str(error)).lower()
            raise InputError(
                f"{path} cannot be read, because the process that reads files before they are opened does not start "
                f"({reason}); check whether {sys.executable} -c 'import h5py' works."
            ) from error
        self._started, answer = True, b""
        with contextlib.suppress(OSError):  # it has ended
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            for content in contents:
                self._process.stdin.write(content)
            self._process.stdin.flush()
            answer = self._process.stdout.readline()
        if answer.endswith(b"\n") and (answer == b'""\n' or answer[:1] == b"{"):
            return json.loads(answer)
        status = None if answer.endswith(b"\n") else self._process.wait()
        self.stop()  # it ends
        if status is None:
            return json.loads(answer)
        killed = status == -getattr(signal, "SIGKILL", 0)
        if not killed:
            return None
        return (
            f"{path} cannot be read: the operating system ended the process that reads the file, probably because "
            "memory was short; free some memory and try again."
        )


def _after_fork() -> None:
    """The child is the parent's, and so are requests to it, which another thread may have begun."""
    global _reader
    process, _reader = _reader._process, _Reader()
    if process is not None:
        process.returncode = 0
        for pipe in (process.stdin, process.stdout):
            os.close(pipe.fileno())  # and not `close`, which would send what the parent's thread has begun to send
        _of_parents.append(process)  # else Python would warn that its pipes are not closed


_of_parents: list[Any] = []
_reader = _Reader()
atexit.register(lambda: _reader.stop())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def serve() -> None:
    """What the child does: read one file after the other, until one cannot be read or the parent has ended."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # what a library prints is no answer
    from .hdf5_content import check

    with contextlib.suppress(OSError, ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if hasattr(signal, "SIGPROF"):
        signal.signal(signal.SIGPROF, signal.SIG_DFL)  # ends the process; the parent may have had it ignored
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGPROF])
    answers.write(_READY)
    for line in sys.stdin.buffer:
        request = json.loads(line)
        content = sys.stdin.buffer.read(request["sent"])
        answer: Any = ""
        if "module" in request:
            importlib.import_module(request["module"])  # before memory is limited
            members, end = {}, 0
            for name, size in request["members"]:
                members[name], end = content[end : end + size], end + size
            with _limited(*request["limits"]):
                answer = _read_table(request, members)
        else:
            try:
                with _limited(*request["limits"]), contextlib.ExitStack() as stack:
                    source = content or stack.enter_context(open(request["opened"], "rb"))
                    check(request["path"], source, request["size"], request["largest"])
            except InputError as error:
                answer = str(error)
            except Exception:  # a single wrong byte surfaces as almost any exception of HDF5, h5py and NumPy
                answer = None
        encoded = json.dumps(answer).encode() + b"\n"
        while encoded:  # a pipe may take less at a time
            encoded = encoded[answers.write(encoded) :]
        if answer is None or (isinstance(answer, str) and answer):
            break  # without memory, for one, HDF5 can no longer read what it could before


@contextlib.contextmanager
def _limited(cpu: float, clock: float, memory: int) -> Iterator[None]:
    """While a file is read: so many seconds of CPU time and by the clock, and bytes of memory.

    On Linux all of them, on macOS those of time, on Windows that by the clock.
    """
    faulthandler.dump_traceback_later(clock, exit=True)
    with contextlib.suppress(OSError, ImportError):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        import resource

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        limit = used + memory if hard == resource.RLIM_INFINITY else min(used + memory, hard)
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, cpu)
    try:
        yield
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()
