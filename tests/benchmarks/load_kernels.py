"""How long the kernels of a run take to be loaded, and what memory: ``python -m tests.benchmarks.load_kernels``.

In fresh processes in turn: as we load them, and as numba does, with what it keeps for its compiler.
"""

import subprocess
import sys
import time
from statistics import median

from numba.core import codegen
from numba.core.sigutils import normalize_signature

from tiler.engine.task_limits import resident_memory
from tiler.executors.kernels import RUN, _kernel, read_list
from tiler.executors.numba_registry import look_up

ROUNDS = 7
WAYS = OURS, NUMBAS = "ours", "numba's"


def load(way: str) -> tuple[float, float]:
    """Load all kernels into this process; gives the time (s) and the memory (MiB) that it took."""
    look_up()
    called = [
        (_kernel(module, name).dispatcher, normalize_signature(signature)[0])
        for module, names in read_list()[RUN].items()
        for name, signatures in names.items()
        for signature in signatures
    ]
    if way == NUMBAS:
        codegen.JITCPUCodegen._library_class = codegen.JITCodeLibrary
    before, start = resident_memory(), time.perf_counter()
    for dispatcher, arguments in called:
        dispatcher.compile(arguments)
    return time.perf_counter() - start, (resident_memory() - before) / 2**20


def main() -> None:
    """Measure both ways in turn, and say what they took at the median."""
    found: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    for _ in range(ROUNDS):
        for way in WAYS:
            command = [sys.executable, "-m", "tests.benchmarks.load_kernels", way]
            told = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
            found[way].append((float(told[0]), float(told[1])))
    for way, rows in found.items():
        seconds, memory = (median(values) for values in zip(*rows, strict=True))
        print(f"{way}: {seconds:.3f} s, {memory:.0f} MiB")


if __name__ == "__main__":
    if sys.argv[1:]:
        print(*load(sys.argv[1]))
    else:
        main()
