"""What numba knows of, looked up before the first kernel: 0.2 s, which workers are spared as they are forked."""

from collections.abc import Iterator
from contextlib import contextmanager


def look_up() -> None:
    """Let numba look up all types and functions that it knows, as it does at the first kernel; once a process.

    Notes
    -----
    To see whether scipy has BLAS, numba would import `scipy.linalg` then: 0.12 s. It is among what we depend on,
    and a kernel that calls BLAS imports it when it is compiled or loaded.
    """
    from numba.core.registry import cpu_target

    with _blas_taken_for_granted():
        cpu_target.typing_context.refresh()
        cpu_target.target_context.refresh()


@contextmanager
def _blas_taken_for_granted() -> Iterator[None]:
    """Answer numba's question meanwhile; a version of it that asks otherwise has its way."""
    from numba.np import linalg

    ask = getattr(linalg, "ensure_blas", None)
    if ask is None:
        yield
        return
    linalg.ensure_blas = lambda: None
    try:
        yield
    finally:
        linalg.ensure_blas = ask
