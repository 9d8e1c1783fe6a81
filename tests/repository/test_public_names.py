"""Libraries are used by their public names alone: no private attribute, no private module, no patched module."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OURS = ("pipeline", "stitch", "tiler", "tests")
# Names with an underscore that their libraries document for use.
DOCUMENTED = {"_asdict", "_fields", "_make", "_replace", "_field_defaults", "_exit"}
# What a program may set.
SETTABLE = {"sys.stdout", "sys.stderr"}


def sources() -> list[Path]:
    return sorted(path for package in OURS[:3] for path in (ROOT / package).rglob("*.py"))


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name not in DOCUMENTED


def is_foreign(module: str | None) -> bool:
    return (module or "").split(".")[0] not in OURS


def own_names(tree: ast.Module) -> set[str]:
    """Private names that the module itself defines: of functions, classes, methods, variables and attributes."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            if isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"):
                names.add(node.attr)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            names.add(node.target.id)
        elif isinstance(node, ast.Assign):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
    return names


def foreign_names(tree: ast.Module) -> set[str]:
    """Names that stand for modules of libraries, or for what they have."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if is_foreign(alias.name):
                    names.add(alias.asname or alias.name.split(".")[0])
        elif isinstance(node, ast.ImportFrom) and is_foreign(node.module):
            names |= {alias.asname or alias.name for alias in node.names}
    return names


def root_of(node: ast.expr) -> str:
    while isinstance(node, ast.Attribute | ast.Subscript | ast.Call):
        node = node.func if isinstance(node, ast.Call) else node.value
    return node.id if isinstance(node, ast.Name) else ""


def find_private(tree: ast.Module) -> Iterator[str]:
    """Tell each use of a private name of a library, and each assignment to what a library has."""
    own, foreign = own_names(tree), foreign_names(tree)
    bases = {
        child.name: {root_of(base) for base in child.bases}
        for child in ast.walk(tree)
        if isinstance(child, ast.ClassDef)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if is_foreign(alias.name) and any(map(is_private, alias.name.split("."))):
                    yield f"{node.lineno}: imports {alias.name}"
        elif isinstance(node, ast.ImportFrom) and is_foreign(node.module):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            yield from (f"{node.lineno}: imports {name}" for name in names if is_private(name))
        elif isinstance(node, ast.Attribute):
            if isinstance(node.ctx, ast.Store) and root_of(node) in foreign and ast.unparse(node) not in SETTABLE:
                yield f"{node.lineno}: assigns to {ast.unparse(node)}"
            elif is_private(node.attr) and node.attr not in own:
                yield f"{node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.Call) and root_of(node.func) in ("getattr", "setattr", "delattr", "hasattr"):
            if (
                len(node.args) > 1
                and isinstance(node.args[1], ast.Constant)
                and is_private(str(node.args[1].value))
            ):
                yield f"{node.lineno}: {ast.unparse(node)}"
            if root_of(node.func) == "setattr" and root_of(node.args[0]) in foreign:
                yield f"{node.lineno}: {ast.unparse(node)}"
        elif isinstance(node, ast.ClassDef) and bases[node.name] & foreign:
            yield from (
                f"{part.lineno}: {node.name} overrides {part.name}"
                for part in node.body
                if isinstance(part, ast.FunctionDef) and is_private(part.name) and overrides(part)
            )


def overrides(method: ast.FunctionDef) -> bool:
    """Tell a method that calls the one of its base."""
    return any(
        isinstance(node, ast.Attribute)
        and node.attr == method.name
        and isinstance(node.value, ast.Call)
        and root_of(node.value.func) == "super"
        for node in ast.walk(method)
    )


def test_no_private_name_of_a_library_is_used() -> None:
    faults = [f"{path}:{fault}" for path in sources() for fault in find_private(ast.parse(path.read_text()))]
    assert faults == []


@pytest.mark.parametrize(
    "code",
    [
        "import numpy._core",
        "from numpy._core import multiarray",
        "from distributed.core import _name",
        "import zarr\nzarr.core._hidden()",
        "def f(client):\n    return client._asyncrun",
        "import distributed\ndistributed.config.value = 3",
        "import numba\nnumba.core.codegen.Library = object",
        "import numba\ngetattr(numba, '_hidden')",
        "import numba\nsetattr(numba, 'shown', 3)",
        "from numba import Base\nclass Mine(Base):\n    def _load(self):\n        return super()._load()",
    ],
)
def test_each_way_to_a_private_name_is_found(code: str) -> None:
    assert len(list(find_private(ast.parse(code)))) == 1


@pytest.mark.parametrize(
    "code",
    [
        "from pipeline.data.mesh import _own",
        "class Mine:\n    def keep(self):\n        self._own = 1\n    def show(self):\n        return self._own",
        "def f(row):\n    return row._asdict()",
        "import numpy as np\nnp.__version__",
    ],
)
def test_what_is_public_or_our_own_is_not(code: str) -> None:
    assert list(find_private(ast.parse(code))) == []
