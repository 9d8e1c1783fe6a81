"""Requests to object stores and web servers: repeated with patience, counted, and told in plain errors.

The requests are those of obstore (Rust's object_store), which has conditional puts, ranges, bulk deletes and the
credentials of the environment. Its own retries are off: here they are counted, jittered and bounded by one number.
"""

import errno
import os
import random
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta
from functools import lru_cache
from typing import Any, TypeVar

from pipeline.errors import ConfigError
from tiler.objects.places import StoreUnreachableError

T = TypeVar("T")
# s between two tries, doubled each time, up to a half of it taken off at random
FIRST_DELAY, LONGEST_DELAY = 0.1, 10.0
FIRST_PATIENCE = 20.0  # s for one that has never answered: its address may be wrong
TOLD_AFTER = 5.0  # s of waiting before somebody is told
TIMEOUT = timedelta(seconds=120)  # of one request
CONNECT_TIMEOUT = timedelta(seconds=10)
_STATUS = re.compile(r"status code: (\d{3})")
_AGAIN = {408, 425, 429}  # and all of 500 and more: what may be otherwise soon
_METADATA = ("169.254.169.254", "169.254.170.2")  # where credentials are looked for last


class ChangedError(Exception):
    """A conditional request found another object than it was meant for, or one where none should be."""


@dataclass
class Waits:
    """What a process had to wait for stores.

    Attributes
    ----------
    retries : int
        Requests that were repeated.
    seconds : float
        Time from each first failure to the answer.
    pauses : int
        Requests for which that took more than `TOLD_AFTER`.
    tasks, task_seconds : int, float
        Of a driver: items whose workers waited, and how long in all.
    tell : callable or None
        Called with a sentence when such a pause begins and ends.
    working : bool
        Whether this process does tasks: their run has begun, and they wait for a store that never answered here.
    """

    retries: int = 0
    seconds: float = 0.0
    pauses: int = 0
    tasks: int = 0
    task_seconds: float = 0.0
    tell: Callable[[str], None] | None = None
    working: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def say(self, text: str) -> None:
        """Tell a sentence, if somebody listens."""
        if self.tell is not None:
            self.tell(text)


WAITS = Waits()
_answered: set[str] = set()  # roots that have given any sound answer to this process


def ask(place: object, patience: float, request: Callable[[Any], T], root: str) -> T:
    """Make a request, again and again while the store is not there, busy, or broken.

    Parameters
    ----------
    place : object
        What is asked for, for messages.
    patience : float
        How long it is tried (s).
    request : callable
        Given obstore's store of `root`.
    root : str
        ``s3://BUCKET``, ``http://HOST`` or ``https://HOST``.

    Raises
    ------
    FileNotFoundError
        If there is no such object or bucket.
    PermissionError
        If access is denied, or there are no credentials.
    ChangedError
        If a condition of the request did not hold.
    OSError
        If the store refuses the request for another reason.
    StoreUnreachableError
        If it has not answered in time; `FIRST_PATIENCE` where it never has, but in tasks.
    ConfigError
        If obstore is not installed.
    """
    began, delay, told = 0.0, FIRST_DELAY, False
    while True:
        try:
            found = request(_client(root))
            break
        except Exception as error:
            reason = _judge_answer(error, root)
        now = time.monotonic()
        began = began or now
        waited = now - began
        if waited >= FIRST_PATIENCE and not WAITS.working and root not in _answered:
            raise StoreUnreachableError(
                f"{place}: nothing has answered at {root} for {waited:.0f} s ({reason}); check the address"
            )
        if waited >= patience:
            _count(waited, told)
            raise StoreUnreachableError(
                f"{place}: no sound answer for {waited:.0f} s, bound {patience:g} s ({reason}); the same command "
                "goes on where the run ended"
            )
        if waited >= TOLD_AFTER and not told:
            told = True
            WAITS.say(f"{root} does not answer ({reason}): waiting for it, at most {patience:g} s")
        with WAITS.lock:
            WAITS.retries += 1
        time.sleep(min(delay * random.uniform(0.5, 1.0), max(patience - waited, 0.0)))
        delay = min(2 * delay, LONGEST_DELAY)
    _answered.add(root)
    if began:
        _count(time.monotonic() - began, told)
        if told:
            WAITS.say(f"{root} answers again after {time.monotonic() - began:.0f} s")
    return found


def _count(seconds: float, told: bool) -> None:
    with WAITS.lock:
        WAITS.seconds += seconds
        WAITS.pauses += told


def _judge_answer(error: Exception, root: str) -> str:
    """Judge as `_judge`, and take note where that is an answer."""
    try:
        reason = _judge(error)
    except (OSError, ChangedError):
        _answered.add(root)
        raise
    if reason.startswith("status"):
        _answered.add(root)
    return reason


def _judge(error: Exception) -> str:
    """Say in a few words why a request failed that may be made again; raise an error for any other."""
    from obstore import exceptions

    text = str(error)
    status = _STATUS.search(text)
    if status is not None and status[1] == "405":  # which obstore takes for an object that is not there
        raise OSError(errno.EIO, "refused with status 405; the server must take HEAD and GET") from None
    refused = status is not None and status[1] in ("401", "403")  # listings give another error than reads
    if isinstance(error, FileNotFoundError) or "NoSuchBucket" in text:
        bucket = "NoSuchBucket" in text
        raise FileNotFoundError(errno.ENOENT, "no such bucket" if bucket else "no such object") from None
    if isinstance(error, (exceptions.PreconditionError, exceptions.AlreadyExistsError)):
        raise ChangedError from None
    denied = (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError, PermissionError)
    if refused or isinstance(error, denied):
        raise PermissionError(errno.EACCES, "access denied; check credentials and rights") from None
    if any(host in text for host in _METADATA):
        raise PermissionError(
            errno.EACCES,
            "no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a role",
        ) from None
    if not isinstance(error, exceptions.GenericError):
        if isinstance(error, exceptions.NotSupportedError):
            raise OSError(errno.EOPNOTSUPP, "the server gives no ranges of files; download the file") from None
        raise error
    if "range" in text.lower() and "support" in text.lower():
        raise OSError(errno.EOPNOTSUPP, "the server gives no ranges of files; download the file") from None
    if "Header missing" in text:
        raise OSError(errno.EIO, "the server does not tell the size of the file; download it") from None
    if status is None:
        return "no connection" if "error sending request" in text else "the answer broke off"
    if int(status[1]) < 500 and int(status[1]) not in _AGAIN:
        code = re.search(r"<Code>(\w+)</Code>", text)
        raise OSError(errno.EIO, f"refused with status {status[1]}" + (f", {code[1]}" if code else "")) from None
    return f"status {status[1]}"


def _client(root: str) -> Any:
    """Give obstore's store of a bucket or server; one for each process."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")
    return _make_client(root, endpoint, os.getpid())


@lru_cache(maxsize=32)
def _make_client(root: str, endpoint: str, _process: int) -> Any:
    try:
        from obstore.store import HTTPStore, S3Store
    except ImportError:
        raise ConfigError(f"{root}: needs obstore; pip install 'citystitch[objects]'") from None
    never: Any = {"max_retries": 0}
    options: Any = {"timeout": TIMEOUT, "connect_timeout": CONNECT_TIMEOUT}
    if not root.startswith("s3://"):
        return HTTPStore.from_url(root, client_options=options | {"allow_http": True}, retry_config=never)
    if endpoint.startswith("http://"):  # whoever names such an endpoint wants it
        options["allow_http"] = True
    given: dict[str, Any] = {"endpoint": endpoint} if endpoint else {}
    return S3Store.from_url(root, client_options=options, retry_config=never, **given)
