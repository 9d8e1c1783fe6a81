"""Kernels: functions that numba compiles, which is imported when one is called: a driver calls none."""

from collections.abc import Callable
from functools import cached_property, partial, update_wrapper
from typing import Any, ParamSpec, TypeVar, overload

Given = ParamSpec("Given")
Result = TypeVar("Result")


class Kernel:
    """A function that is compiled for the types of its arguments when it is first called, and kept on disk.

    It is called without the interpreter's lock, from Python by position. Other kernels call it as well.

    Parameters
    ----------
    py_func : callable
        The function, of a module.
    targetoptions : dict
        Further options of `numba.njit`; numba looks for both here where another kernel calls this one.
    """

    def __init__(self, py_func: Callable[..., Any], targetoptions: dict[str, Any]) -> None:
        update_wrapper(self, py_func)
        self.py_func, self.targetoptions = py_func, targetoptions

    def __call__(self, *arguments: Any) -> Any:
        return self.dispatcher(*arguments)

    def __reduce__(self) -> str:
        return self.py_func.__qualname__

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's, which has the compiled code of each signature."""
        import numba

        from pipeline.kernel_library import leave_unread

        leave_unread()
        return numba.njit(cache=True, nogil=True, **self.targetoptions)(self.py_func)

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for where another kernel calls it."""
        return self.dispatcher._numba_type_


@overload
def kernel(function: Callable[Given, Result]) -> Callable[Given, Result]: ...


@overload
def kernel(**options: Any) -> Callable[[Callable[Given, Result]], Callable[Given, Result]]: ...


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """Make a kernel of a function: ``@kernel``, or ``@kernel(inline="always")`` with options of `numba.njit`."""
    if function is None:
        return partial(kernel, **options)
    return Kernel(function, options)
