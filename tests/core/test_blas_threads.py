"""One thread of BLAS within, and the former number again afterwards."""

import threading
from collections.abc import Iterator

import pytest
import scipy.linalg  # noqa: F401 - has a BLAS of its own
from threadpoolctl import threadpool_info, threadpool_limits

from aacmm_jax.core.blas_threads import CHOSEN, one_blas_thread


def numbers() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    for name in CHOSEN:
        monkeypatch.delenv(name, raising=False)
    with threadpool_limits(limits=2, user_api="blas"):
        if numbers() != {2}:
            pytest.skip("the BLAS of this machine has one thread")
        yield monkeypatch


def test_one_thread_within_and_the_former_number_afterwards(two: pytest.MonkeyPatch) -> None:
    inner = one_blas_thread(numbers)
    assert one_blas_thread(lambda: (inner(), numbers()))() == ({1}, {1})
    assert numbers() == {2}


def test_an_error_leaves_the_former_number(two: pytest.MonkeyPatch) -> None:
    def fails() -> None:
        raise ValueError("to be mended")

    for _ in range(2):
        with pytest.raises(ValueError, match="mended"):
            one_blas_thread(fails)()
    assert (one_blas_thread(numbers)(), numbers()) == ({1}, {2})


def test_a_number_that_was_chosen_stays(two: pytest.MonkeyPatch) -> None:
    two.setenv("OMP_NUM_THREADS", "2")
    assert one_blas_thread(numbers)() == {2}


def test_a_call_beside_another_changes_nothing(two: pytest.MonkeyPatch) -> None:
    seen = list[set[int]]()

    def outer() -> None:
        other = threading.Thread(target=one_blas_thread(lambda: seen.append(numbers())))
        other.start()
        other.join()
        seen.append(numbers())

    one_blas_thread(outer)()
    assert (seen, numbers()) == ([{1}, {1}], {2})
