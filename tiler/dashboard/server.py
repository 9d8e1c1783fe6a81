"""Serve the page of a run: on the HTTP server of its Dask scheduler, or by a small one of its own."""

import asyncio
import ipaddress
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.config.config import ANYWHERE
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.metrics import Collector

PREFIX = "/citystitch"
MOST_BODY = 0  # bytes of a body that is taken: nobody has anything to send


def read_address(text: str) -> tuple[str, int]:
    """Read an address to listen at.

    Parameters
    ----------
    text : str
        ``HOST:PORT``; port 0 is a free one, a port alone is of 127.0.0.1.

    Raises
    ------
    ConfigError
        If it is none, or another program listens there.

    Examples
    --------
    >>> read_address("127.0.0.1:0"), read_address("[::1]:0")
    (('127.0.0.1', 0), ('::1', 0))
    """
    host, port = _host(text), text.rpartition(":")[2]
    if not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise ConfigError(
            f"dashboard address {text!r}: is not HOST:PORT, port 0 to 65535; give 127.0.0.1:8787, say"
        )
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, int(port), type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(place)
    except OSError as error:
        raise ConfigError(
            f"dashboard address {text}: cannot be listened at ({error.strerror}); give another port, or port 0 "
            "for a free one"
        ) from error
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address.

    Examples
    --------
    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0")
    (True, True, False)
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@contextmanager
def serve(follower: EventReader, address: str = ANYWHERE) -> Iterator[str]:
    """Serve the page of a run by a server of its own, in a thread; gives its URL.

    Parameters
    ----------
    address : str
        Where to listen, see `read_address`.

    Raises
    ------
    ConfigError
        If nobody can listen there.
    """
    from tiler.dashboard.handlers import make_rules

    def rules(loopback: bool) -> list[Any]:
        return make_rules(follower, loopback=loopback, dask=False, root=True)

    with serve_rules(rules, address) as root:
        yield f"{root}{PREFIX}/"


@contextmanager
def serve_rules(
    make_rules: Callable[[bool], list[Any]], address: str, *, most_body: int = MOST_BODY
) -> Iterator[str]:
    """Serve paths by a server of its own, in a thread; gives its URL, without a slash at its end.

    Parameters
    ----------
    make_rules : callable
        Lists the paths for tornado, given whether only this machine reaches the address.
    address : str
        Where to listen, see `read_address`.
    most_body : int
        Bytes of a body that is taken.

    Raises
    ------
    ConfigError
        If nobody can listen there.
    """
    from tornado.httpserver import HTTPServer
    from tornado.netutil import bind_sockets
    from tornado.web import Application

    host, port = read_address(address)
    app = Application(make_rules(is_loopback(host)), log_function=_silent)
    sockets = bind_sockets(port, host)
    stopped = asyncio.Event()
    started: Future[asyncio.AbstractEventLoop] = Future()

    async def work() -> None:
        server = HTTPServer(app, max_body_size=most_body)
        server.add_sockets(sockets)
        started.set_result(asyncio.get_running_loop())
        await stopped.wait()
        server.stop()
        await server.close_all_connections()

    thread = threading.Thread(target=asyncio.run, args=(work(),), name="dashboard", daemon=True)
    thread.start()
    loop = started.result()
    try:
        yield _root(host, sockets[0].getsockname()[1])
    finally:
        loop.call_soon_threadsafe(stopped.set)
        thread.join()


@contextmanager
def mounted(follower: EventReader, scheduler: Any, address: str) -> Iterator[str]:
    """Show the page of a run on the HTTP server of its Dask scheduler, in this process; gives its URL.

    Parameters
    ----------
    scheduler : distributed.Scheduler
        The scheduler.
    address : str
        Where it was told to listen.

    Notes
    -----
    Where ``prometheus_client`` is there, Dask shows the metrics of its registry at ``/metrics``: ours are among
    them.
    """
    from tiler.dashboard.handlers import make_rules

    host = _host(address)
    rules = make_rules(follower, loopback=is_loopback(host), dask=True)
    scheduler.http_application.add_handlers(".*", rules)
    with _registered(follower):
        yield f"{_root(host, scheduler.http_server.port)}{PREFIX}/"


@contextmanager
def watched(out: Path, address: str | None, scheduler: Any | None, say: Callable[[str], None]) -> Iterator[None]:
    """Show the page of the run that this process drives, and tell its URL.

    Parameters
    ----------
    address : str or None
        Where to listen; None shows nothing.
    scheduler : distributed.Scheduler or None
        The scheduler in this process, which listens there already, if there is one.
    say : callable
        Called with the URL, and a warning where others reach it.
    """
    if address is None:
        yield
        return
    follower = EventReader(out, lambda: True)
    page = serve(follower, address) if scheduler is None else mounted(follower, scheduler, address)
    with page as url:
        say(f"dashboard: {url}")
        _warn_of_others(address, say)
        yield


def _warn_of_others(address: str, say: Callable[[str], None]) -> None:
    if not is_loopback(_host(address)):
        say(f"the dashboard at {address} shows names and paths of this run to whoever reaches that address")


def _host(address: str) -> str:
    return address.rpartition(":")[0].strip("[]") or "127.0.0.1"


def show_folder(folder: Path, address: str, say: Callable[[str], None]) -> None:
    """Show the page of the run in a folder until the process is interrupted.

    Parameters
    ----------
    folder : Path
        Folder of a run, at work, ended or dead.

    Raises
    ------
    InputError
        If the folder is not that of a run.
    ConfigError
        If nobody can listen there.
    """
    follower = EventReader(folder)
    with follower.lock:
        follower.advance(0.0)
    with serve(follower, address) as url, suppress(KeyboardInterrupt):
        say(f"dashboard: {url} (Ctrl-C ends it)")
        _warn_of_others(address, say)
        threading.Event().wait()


@contextmanager
def _registered(follower: EventReader) -> Iterator[None]:
    try:
        from prometheus_client import REGISTRY
    except ImportError:
        yield
        return
    collector = Collector(follower)
    REGISTRY.register(collector)
    try:
        yield
    finally:
        with suppress(KeyError):
            REGISTRY.unregister(collector)


def _root(host: str, port: int) -> str:
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{name}:{port}"


def _silent(_: Any) -> None:
    """Log no requests."""
