"""Compiled kernels are read from disk without what only the compiler needs, of kernels that call them."""

from functools import cache
from typing import Any

import llvmlite.binding
from numba.core import codegen


class Library(codegen.JITCodeLibrary):  # type: ignore[misc]  # numba has no types
    """The code of a kernel, as numba keeps it, whose part for the compiler is read when that asks for it.

    Besides its machine code each has LLVM's, which is linked into kernels that call it when these are compiled. To
    read that, and to list its functions, takes two thirds of the time in which a kernel is loaded, and memory.
    """

    _unread: bytes | None = None

    @classmethod
    def _unserialize(cls, target: Any, state: tuple[str, str, Any]) -> Any:
        name, kind, code = state
        if kind != "object":
            return super()._unserialize(target, state)
        machine_code, for_compiler = code
        library = super()._unserialize(target, (name, kind, (machine_code, _empty())))
        library._shared_module, library._unread = None, for_compiler
        return library

    def _get_module_for_linking(self) -> Any:
        if self._unread is not None:
            self._shared_module = llvmlite.binding.parse_bitcode(self._unread)
            self._codegen._engine._load_defined_symbols(self._shared_module)
            self._unread = None
        return super()._get_module_for_linking()

    def get_pointer_to_function(self, name: str) -> int:
        """Give the address of a function; 0 if there is none."""
        if self._unread is None:
            return int(super().get_pointer_to_function(name))
        return int(self._codegen._engine.get_function_address(name))


def leave_unread() -> None:
    """Let numba load kernels so from now on, if it is a version that keeps them as this one does."""
    theirs = codegen.JITCodeLibrary
    known = all(hasattr(theirs, name) for name in ("_unserialize", "_get_module_for_linking"))
    if known and getattr(codegen.JITCPUCodegen, "_library_class", None) is theirs:
        codegen.JITCPUCodegen._library_class = Library


@cache
def _empty() -> bytes:
    return bytes(llvmlite.binding.parse_assembly("").as_bitcode())
