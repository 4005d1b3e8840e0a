"""A plugin of pytest that takes away what Windows lacks: `python -m pytest -p tests.missing_posix tests/files`.

Modules cannot be imported, functions and flags of `os` and `signal` are missing, and owners are not checked. What
Windows does differently cannot be simulated: paths with drives, open files that cannot be removed or renamed, text mode
of descriptors, signals, spawning. Child processes, the lock of files and `subprocess` have what they need.
"""

import os
import signal
import sys

MODULES = ("fcntl", "grp", "pwd", "resource", "termios", "tty")
FUNCTIONS = {
    os: "chown fchmod fchown fork geteuid getuid getgid sched_getaffinity sched_setaffinity sysconf "
    "O_CLOEXEC O_NOFOLLOW",
    signal: "ITIMER_PROF SIGPROF pthread_sigmask setitimer",
}


def pytest_runtest_call() -> None:
    """Once what the tests themselves need has been imported."""
    from aacmm_jax.core import file_owners
    from aacmm_jax.files import outputs

    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in FUNCTIONS.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
    file_owners.POSIX = False
    outputs.fcntl = None
