"""What becomes of tasks that fail: tried again, then set aside with all that is needed to find out why."""

from dataclasses import asdict, dataclass
from typing import Any

from pipeline.data.errors import CityError, ConfigError, OutputError
from tiler.engine.stage import Scope
from tiler.engine.task import Failure
from tiler.engine.task_limits import WorkerError

KILLED_TRIES = 3  # a process that was killed may be nobody's fault: a node that failed, a walltime


@dataclass(frozen=True)
class Policy:
    """How failures are dealt with."""

    retries: int = 0  #: how often a task is tried again; not after errors that say what is wrong with the input
    #: go on without the items that fail, and without what needs them; otherwise the first failure ends the run
    set_aside: bool = False


@dataclass(frozen=True)
class SetAside:
    """An item that failed and was set aside."""

    #: the item
    stage: str
    name: str
    scope: Scope  #: scope of the stage
    kind: str  #: as of `tiler.engine.task.Failure`
    reason: str  #: the error's message
    trace: str  #: where it arose
    attempts: int  #: how often it was tried
    inputs: dict[str, tuple[str, ...]]  #: items that it reads, by stage
    file: str = ""  #: path of its file, for the scope FILE; else empty

    def as_json(self) -> dict[str, Any]:
        """Plain JSON values."""
        return asdict(self) | {"scope": self.scope.value}


def tries(failure: Failure, policy: Policy) -> int:
    """How often a task that fails like this is run in all.

    Examples
    --------
    >>> policy = Policy(retries=1)
    >>> [tries(Failure(error), policy) for error in (ValueError(), CityError())]
    [2, 1]
    """
    error = failure.error
    if failure.kind == "killed":
        return max(policy.retries + 1, KILLED_TRIES)
    return policy.retries + 1 if isinstance(error, WorkerError) or not isinstance(error, CityError) else 1


def ends_the_run(failure: Failure, scope: Scope, policy: Policy) -> bool:
    """Whether nothing can go on: a stage of the whole region, a full disk, a wrong parameter."""
    return not policy.set_aside or scope is Scope.REGION or isinstance(failure.error, (OutputError, ConfigError))


def describe_reason(error: Exception) -> str:
    """An error as one line: its type too, where its message was not written for users."""
    text = " ".join(str(error).split())
    return text if isinstance(error, CityError) else f"{type(error).__name__}: {text}"
