"""Whether scheduler and workers of a cluster will do for a run: asked before it, and told a line a difference."""

import inspect
import time
from collections.abc import Callable, Mapping
from typing import Any

from pipeline.errors import ConfigError
from tiler.scheduler import versions
from tiler.scheduler.terms import GRACE, Files, Refusal, Terms, check_files, own_versions
from tiler.scheduler.versions import TRANSPORT

ANSWER, LATE_ANSWER = 60.0, 5.0  # s that workers may take to answer, before a run and in it
NAMED = 3  # workers that are named in a line; the others are counted

# Runs the text of `tiler.scheduler.versions` where there may be no citystitch.
PROBE = "exec(source, scope := {}) or scope['tell_versions'](only)"

EARLY = "this cluster cannot take the tasks of this run, and nothing was written"
LATE = "a worker has joined that cannot take tasks of this run; all that was done is kept"
ADVICE = (
    "install the same versions there, as deploy/requirements.lock has them, and start scheduler and workers again"
)
FILES_ADVICE = "workers must see output folder and inputs under the same paths: mount the shared file system there"

Versions = dict[str, str]


class UnansweredError(ConfigError):
    """A worker has not answered in time: it is out of reach, or its task holds the interpreter."""


class ClusterMismatchError(ConfigError):
    """A cluster cannot take the tasks of a run: its message has a line a difference."""

    @property
    def lines(self) -> list[str]:
        """Lines of the message."""
        return str(self).split("\n")


def check_cluster(client: Any, address: str, terms: Terms, *, late: bool = False) -> None:
    """Hold scheduler and all workers against this process.

    Parameters
    ----------
    client : distributed.Client
        Connected client.
    address : str
        What the user calls the scheduler.
    terms : Terms
        What workers must meet.
    late : bool
        Whether the run is at work already.

    Raises
    ------
    ClusterMismatchError
        If a version differs or a library is missing, or if output folder or inputs are not there, or others.
    UnansweredError
        If a worker does not answer within `ANSWER` or `LATE_ANSWER` seconds.
    """
    here, source, head = own_versions(), inspect.getsource(versions), f"{address}: {LATE if late else EARLY}"
    carried = {name: here[name] for name in ("python", "citystitch", *TRANSPORT)}
    bound = LATE_ANSWER if late else ANSWER

    def ask(function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        return _ask(client, address, bound, function, *given, **named)

    there = ask(client.run_on_scheduler, eval, PROBE, {"source": source, "only": TRANSPORT})
    lines = compare_versions(carried, {f"scheduler {address}": there})
    found = ask(client.run, eval, PROBE, {"source": source, "only": None}, on_error="return")
    lines += compare_versions(here, found)
    if lines:
        raise ClusterMismatchError("\n".join([head, *lines, ADVICE]))
    end = time.monotonic() + GRACE
    while lines := compare_files(ask(client.run, check_files, terms, on_error="return")):
        if time.monotonic() >= end:
            raise ClusterMismatchError("\n".join([head, *lines, FILES_ADVICE]))
        time.sleep(0.5)


def tell_refusal(refusal: Refusal, address: str) -> ClusterMismatchError:
    """The error of a worker that joined while a run was at work."""
    lines = compare_versions(own_versions(), {refusal.worker: refusal.versions})
    files = compare_files({refusal.worker: refusal.files})
    advice = [*([ADVICE] if lines else []), *([FILES_ADVICE] if files else [])]
    return ClusterMismatchError("\n".join([f"{address}: {LATE}", *lines, *files, *advice]))


def compare_versions(here: Versions, there: Mapping[str, Versions | BaseException]) -> list[str]:
    """Tell differences of versions, a line for each library and version that is elsewhere.

    Parameters
    ----------
    here : dict of str to str
        Versions of this process.
    there : mapping of str to dict of str to str
        Those elsewhere by address; an error for one that could not tell.

    Examples
    --------
    >>> compare_versions({"numpy": "2.4"}, {"tcp://a:1": {"numpy": "2.3"}, "tcp://b:1": {"numpy": "2.4"}})
    ['numpy: 2.4 here, 2.3 there (tcp://a:1)']
    """
    lines: dict[str, list[str]] = {}
    for place, found in sorted(there.items()):
        if isinstance(found, BaseException):
            words = " ".join(f"{type(found).__name__}: {found}".split())
            lines.setdefault(f"versions: cannot be told there ({words})", []).append(place)
            continue
        for name, version in here.items():
            if found.get(name) != version:
                lines.setdefault(f"{name}: {version} here, {found.get(name)} there", []).append(place)
    return [f"{line} ({_name(places)})" for line, places in lines.items()]


def compare_files(there: Mapping[str, Files | BaseException]) -> list[str]:
    """Tell what is wrong with files, by path, elsewhere: a line for each file and fault."""
    lines: dict[str, list[str]] = {}
    for place, found in sorted(there.items()):
        told = {"files": f"cannot be looked at there ({found!r})"} if isinstance(found, BaseException) else found
        for path, what in told.items():
            lines.setdefault(f"{path}: {what}", []).append(place)
    return [f"{line} ({_name(places)})" for line, places in lines.items()]


def _name(places: list[str]) -> str:
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    return ", ".join(places[:NAMED]) + more


def _ask(client: Any, address: str, bound: float, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """Ask scheduler or workers, for a bounded time."""

    async def ask() -> Any:
        return await function(*given, **named)

    try:
        return client.sync(ask, callback_timeout=bound)
    except TimeoutError as error:
        raise UnansweredError(
            f"{address}: not all workers have answered within {bound:g} s; look at their logs, and run again"
        ) from error
