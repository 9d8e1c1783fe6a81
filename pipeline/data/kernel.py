"""Kernels: functions that numba compiles at their first call and keeps on disk; they run without the GIL."""

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, overload

import numba

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@overload
def kernel(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]: ...
@overload
def kernel(**options: str) -> Callable[[Callable[Arguments, Result]], Callable[Arguments, Result]]: ...
def kernel(function: Any = None, **options: str) -> Any:
    """Apply `numba.njit`, which has no types: ``@kernel``, or ``@kernel(inline="always")`` with options."""
    if function is None:
        return lambda function: kernel(function, **options)
    try:
        return numba.njit(cache=True, nogil=True, **options)(function)
    except RuntimeError:  # numba may write no folder for what it compiles: `tiler.executors.kernels` says so
        return numba.njit(nogil=True, **options)(function)
