"""One thread for the linear algebra of NumPy and SciPy while a calibration or a plan is computed.

Their matrices are so small that a second thread of BLAS mostly waits for the first: on two busy cores the calibration
of 1,000 poses of a UR5 took 56 s of CPU with two threads, and 12 s with one.
"""

import os
import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Function = TypeVar("Function", bound=Callable[..., Any])

CHOSEN = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
_LIMITED = threading.Lock()  # the number is of the process: one call at a time sets it, and sets it back


@cache
def _libraries() -> "ThreadpoolController":
    """The libraries of BLAS that are loaded: those of NumPy and SciPy."""
    import scipy.linalg  # noqa: F401 - has one of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def one_blas_thread(function: Function) -> Function:
    """Decorator: the function computes with one thread of BLAS, and sets the former number afterwards.

    Where the environment states how many threads to use (one of `CHOSEN`), that many are used.
    """

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        if any(name in os.environ for name in CHOSEN) or not _LIMITED.acquire(blocking=False):
            return function(*args, **kwargs)
        try:
            with _libraries().limit(limits=1, user_api="blas"):
                return function(*args, **kwargs)
        finally:
            _LIMITED.release()

    return call  # pyright: ignore[reportReturnType]
