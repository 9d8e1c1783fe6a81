"""Which kernels Python calls, and with what: ``python -m tests.record_kernels`` writes the list of kernels anew.

Small cities are meshed, checked and drawn in all ways that have kernels of their own, by a process that finds
everything compiled: so it loads what Python calls, and not what only other kernels do.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from numba.core import event, types

from pipeline.kernel import Kernel
from tiler.cli.main import main
from tiler.executors.kernels import LIST, Kernels, read_list

WAYS = (
    (),
    ("--tile-size", "200"),
)
OTHER_WAYS = (
    ("--tile-size", "200", "--mesher", "layered"),
    ("--ground-filter",),
    ("--simplify", "paper", "--underground", "20"),
    ("--first-layer", "1", "--pad", "100"),
    ("--mesh-size", "5"),
)
PACKAGES = ("pipeline", "stitch", "tiler")


def record(folder: Path) -> dict[str, Kernels]:
    """Mesh cities in this process, below a folder; gives what runs have called by default, and what other ways."""
    city = folder / "city"
    _call("synth", str(city), "--size", "400", "--buildings", "60")
    inputs = ["run", str(city / "tiles"), "--footprints", str(city / "footprints.shp"), "--quiet", "--out"]
    for number, way in enumerate(WAYS):
        _call(*inputs, str(folder / f"{number}"), *way)
    by_default = _called()
    for number, way in enumerate(OTHER_WAYS):
        _call(*inputs, str(folder / f"other-{number}"), *way)
    tiled = str(folder / "1")
    _call("check", tiled)
    _call("report", tiled)
    _call("export", tiled, "--format", "openfoam", "-o", str(folder / "case"))
    for what in ("boundary", "mesh", "overview", "tiles", "sizes", "quality", "citymodel"):
        _call("render", tiled, "--what", what, "-o", str(folder / f"{what}.png"))
    return {"run": by_default, "other": _without(_called(), by_default)}


class _Compiled(event.Listener):  # type: ignore[misc]  # numba has no types
    """Names of the kernels that are compiled, as they are not found compiled."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def on_start(self, event: event.Event) -> None:
        """Called for each kernel, and for what numba has of its own in it."""
        self.names.append(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event: event.Event) -> None:
        """Nothing to do."""


def _called() -> Kernels:
    called: Kernels = {}
    for module, name, kernel in _kernels():
        if kernel.dispatcher.signatures:
            called.setdefault(module, {})[name] = sorted(map(spell, kernel.dispatcher.signatures))
    return called


def _without(kernels: Kernels, known: Kernels) -> Kernels:
    left: Kernels = {}
    for module, names in kernels.items():
        for name, signatures in names.items():
            if new := sorted({*signatures}.difference(known.get(module, {}).get(name, ()))):
                left.setdefault(module, {})[name] = new
    return left


def spell(arguments: tuple[types.Type, ...]) -> str:
    """Write a signature so that numba reads it."""
    return f"({''.join(f'{_spell(kind)}, ' for kind in arguments).removesuffix(' ')})"


def _spell(kind: types.Type) -> str:
    if isinstance(kind, types.Array) and kind.mutable and kind.aligned and kind.layout in "AC":
        axes = [":"] * (kind.ndim - 1) + ["::1" if kind.layout == "C" else ":"]
        return f"{_spell(kind.dtype)}[{', '.join(axes)}]"
    if isinstance(kind, types.containers.UniTuple):
        return f"UniTuple({_spell(kind.dtype)}, {kind.count})"
    if isinstance(kind, types.containers.Tuple):
        return f"Tuple(({''.join(f'{_spell(part)}, ' for part in kind.types)}))"
    return "boolean" if kind == types.boolean else repr(kind)


def _kernels() -> Iterator[tuple[str, str, Kernel]]:
    for module in sorted(name for name in sys.modules if name.split(".")[0] in PACKAGES):
        for name, kernel in sorted(vars(sys.modules[module]).items()):
            if isinstance(kernel, Kernel) and kernel.py_func.__module__ == module:
                yield module, name, kernel


def _call(*words: str) -> None:
    code = main(list(words))
    if code:
        raise SystemExit(f"{words}: exit code {code}")


def record_apart(folder: Path, **environment: str) -> tuple[dict[str, Kernels], list[str]]:
    """The same in a process of its own, below a folder that is not there yet; and what it compiled."""
    folder.mkdir(parents=True)
    path = folder / "called.json"
    subprocess.run(
        [sys.executable, "-m", "tests.record_kernels", folder, path],
        env=os.environ | environment,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    called, compiled = json.loads(path.read_text())
    return called, compiled


def _write_list() -> None:
    with tempfile.TemporaryDirectory() as name:
        record_apart(Path(name) / "compiled")
        called, _ = record_apart(Path(name) / "loaded")
    known = read_list()
    for part, kernels in called.items():  # modules keep their places: those that take longest go first
        order = [*known.get(part, {}), *kernels]
        called[part] = {module: kernels[module] for module in order if module in kernels}
    LIST.write_text(json.dumps(called, indent=1) + "\n")


if __name__ == "__main__":
    if sys.argv[1:]:
        below, written = map(Path, sys.argv[1:])
        watch = _Compiled()
        event.register("numba:compile", watch)
        written.write_text(json.dumps((record(below), watch.names)))
    else:
        _write_list()
