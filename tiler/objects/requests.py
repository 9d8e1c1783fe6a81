"""Requests to object stores and web servers: obstore makes and repeats them, here its errors become plain ones.

obstore repeats what another try may mend, with growing and shuffled pauses: answers of 500 and more, 408 and 429,
refused and dropped connections, timeouts, and a body that breaks off, which it takes up again by a range.
"""

import errno
import os
import re
import time
from collections.abc import Callable
from datetime import timedelta
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

from pipeline.data.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from obstore.store import HTTPStore, S3Store

T = TypeVar("T")
FIRST_PATIENCE = 20.0  # s for one that has never answered: its address may be wrong
BACKOFF: Any = {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=10), "base": 2}
TIMEOUT = timedelta(seconds=120)  # of one try
CONNECT_TIMEOUT = timedelta(seconds=10)
_STATUS = re.compile(r"status code: (\d{3})")
_METADATA = ("169.254.169.254", "169.254.170.2")  # where credentials are looked for last
_known: set[str] = set()  # roots that have given any answer to this process
EVERY = "*"  # in it: all others too


class StoreUnreachableError(OutputError):
    """A bucket or server has not answered for all of a run's patience: the run ends, and may be resumed."""


class ChangedError(Exception):
    """A conditional request found another object than it was meant for, or one where none should be."""


def trust_addresses(trusted: bool) -> None:
    """Return whether this process does tasks: their driver has reached all stores, so waiting is worth it."""
    (_known.add if trusted else _known.discard)(EVERY)


def ask(place: object, patience: float, request: Callable[["S3Store | HTTPStore"], T], root: str) -> T:
    """Make a request, which obstore repeats while the store is not there, busy, or broken.

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
    bound = min(patience, FIRST_PATIENCE) if _known.isdisjoint((root, EVERY)) else patience
    store, start = make_store(root, bound), time.monotonic()
    try:
        found = request(store)
    except Exception as error:
        answer = _judge(error)
        if isinstance(answer, Exception):
            _known.add(root)
            raise answer from None
        waited = f"for {time.monotonic() - start:.0f} s"
        if bound == patience:
            raise StoreUnreachableError(
                f"{place}: no sound answer {waited}, bound {patience:g} s ({answer}); the same command "
                "goes on where the run ended"
            ) from None
        if not answer.startswith("status"):
            raise StoreUnreachableError(
                f"{place}: nothing has answered at {root} {waited} ({answer}); check the address"
            ) from None
        _known.add(root)  # the address is right: it is worth waiting for
        return ask(place, patience, request, root)
    _known.add(root)
    return found


def _judge(error: Exception) -> Exception | str:
    """Give the plain error for one of obstore, or a few words where it has repeated the request in vain."""
    from obstore import exceptions

    text = str(error)
    status = _STATUS.search(text)
    number = int(status[1]) if status else 0
    denied = (exceptions.PermissionDeniedError, exceptions.UnauthenticatedError, PermissionError)
    if isinstance(error, exceptions.PreconditionError | exceptions.AlreadyExistsError):
        return ChangedError()
    if number == 405:  # which obstore takes for an object that is not there
        kind, words = errno.EIO, "refused with status 405; the server must take HEAD and GET"
    elif "NoSuchBucket" in text:
        kind, words = errno.ENOENT, "no such bucket"
    elif isinstance(error, FileNotFoundError):
        kind, words = errno.ENOENT, "no such object"
    elif any(host in text for host in _METADATA):
        kind = errno.EACCES
        words = "no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a role"
    elif number in (401, 403) or isinstance(error, denied):  # listings give a generic error
        kind, words = errno.EACCES, "access denied; check credentials and rights"
    elif isinstance(error, exceptions.NotSupportedError):
        kind, words = errno.EOPNOTSUPP, "the server gives no ranges of files; download the file"
    elif not isinstance(error, exceptions.GenericError):
        return error
    elif "Header missing" in text:
        kind, words = errno.EIO, "the server does not tell the size of the file; download it"
    elif 0 < number < 500 and number not in (408, 429):
        code = re.search(r"<Code>(\w+)</Code>", text)
        kind, words = errno.EIO, f"refused with status {number}" + (f", {code[1]}" if code else "")
    elif number:
        return f"status {number}"
    else:
        return "no connection" if "error sending request" in text else "the answer broke off"
    return OSError(kind, words)  # a FileNotFoundError or PermissionError by its number


def make_store(root: str, patience: float) -> "S3Store | HTTPStore":
    """Give obstore's store of a bucket or server; one for each process."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL", "")
    return _make_store(root, patience, endpoint, os.getpid())


@lru_cache(maxsize=32)
def _make_store(root: str, patience: float, endpoint: str, _process: int) -> "S3Store | HTTPStore":
    try:
        from obstore.store import HTTPStore, S3Store
    except ImportError:
        raise ConfigError(f"{root}: needs obstore; pip install 'citystitch[objects]'") from None
    retries: Any = {"max_retries": 10**6, "retry_timeout": timedelta(seconds=patience), "backoff": BACKOFF}
    options: Any = {"timeout": TIMEOUT, "connect_timeout": CONNECT_TIMEOUT}
    if not root.startswith("s3://"):
        return HTTPStore.from_url(root, client_options=options | {"allow_http": True}, retry_config=retries)
    if endpoint.startswith("http://"):  # whoever names such an endpoint wants it
        options["allow_http"] = True
    given: dict[str, Any] = {"endpoint": endpoint} if endpoint else {}
    return S3Store.from_url(root, client_options=options, retry_config=retries, **given)
