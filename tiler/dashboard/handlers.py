"""The paths below ``/citystitch``: the page, its state, and the metrics. They read, and take nothing else."""

import asyncio
import gzip
import json
import math
from collections.abc import Callable
from http.client import responses
from pathlib import Path
from typing import Any

from tornado.web import HTTPError, RequestHandler

from pipeline.data.errors import CityError
from tiler.dashboard.event_reader import EventReader
from tiler.dashboard.map_view import Box, Question
from tiler.dashboard.metrics import CONTENT_TYPE, describe_metrics, write_text
from tiler.dashboard.page_data import describe_page
from tiler.dashboard.server import PREFIX

HERE = Path(__file__).parent
FILES = {
    "": ("page.html", "text/html; charset=utf-8"),
    "page.css": ("page.css", "text/css; charset=utf-8"),
    "page.js": ("page.js", "text/javascript; charset=utf-8"),
    "map.js": ("map.js", "text/javascript; charset=utf-8"),
    "tables.js": ("tables.js", "text/javascript; charset=utf-8"),
}
# Nothing is fetched from elsewhere, nobody frames the page, and no text of a run can become a program.
POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:"
POLICY += "; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
HEADERS = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}
LOOPBACK = {"127.0.0.1", "localhost", "::1"}
LEAST_ZIPPED = 1000  # bytes


class Guarded(RequestHandler):
    """What is said and refused on all paths of ours.

    Attributes
    ----------
    loopback : bool
        Answer only who asks for this machine by a name of its own: a page of the web that has its name point here
        gets nothing.
    """

    loopback: bool

    def set_default_headers(self) -> None:
        """Add the headers on what the browser may do."""
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse foreign names of this machine."""
        if self.loopback and _host_name(self.request.host) not in LOOPBACK:
            raise HTTPError(403, reason="ask by 127.0.0.1 or localhost")

    def write_error(self, status_code: int, **others: Any) -> None:
        """Describe what is wrong in one line of plain text."""
        error = others.get("exc_info", (None, None, None))[1]
        reason = getattr(error, "reason", None) or responses.get(status_code, "unknown")
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(f"{status_code} {reason}\n")


class Base(Guarded):
    """What the paths of a run have in common.

    Parameters
    ----------
    follower : EventReader
        The run.
    loopback : bool
        See `Guarded`.
    dask : bool
        Whether Dask's own pages are served beside.
    """

    def initialize(self, follower: EventReader, loopback: bool, dask: bool) -> None:
        """Take the parameters."""
        self.follower, self.loopback, self.dask = follower, loopback, dask

    async def reply(self, make: Callable[[], tuple[str, str]]) -> None:
        """Make an answer and its type in a thread of its own, and send it, packed where that is worth it."""
        zipped = "gzip" in self.request.headers.get("Accept-Encoding", "")

        def packed() -> tuple[bytes, str, bool]:
            text, kind = make()
            content = text.encode()
            pack = zipped and len(content) >= LEAST_ZIPPED
            return gzip.compress(content, 5, mtime=0) if pack else content, kind, pack

        content, kind, pack = await asyncio.get_running_loop().run_in_executor(None, packed)
        self.set_header("Content-Type", kind)
        self.set_header("Vary", "Accept-Encoding")
        if pack:
            self.set_header("Content-Encoding", "gzip")
        self.finish(content)


class Page(Base):
    """The page and what belongs to it: known files only, so no path leads elsewhere."""

    async def get(self, name: str) -> None:
        """Send a file."""
        if name not in FILES:
            raise HTTPError(404)
        file, kind = FILES[name]
        await self.reply(lambda: ((HERE / file).read_text(), kind))


class StateOfRun(Base):
    """The state of the run as JSON, see `tiler.dashboard.page_data`."""

    async def get(self) -> None:
        """Answer what the page asks for."""
        question = Question(
            self.get_query_argument("stage", ""),
            self.get_query_argument("value", ""),
            _read_view(self.get_query_argument("view", "")),
            _read_number(self.get_query_argument("since", "0")),
            self.get_query_argument("key", ""),
        )

        def make() -> tuple[str, str]:
            try:
                found = describe_page(self.follower, question) | {"dask": self.dask}
            except CityError as error:
                found = {"trouble": str(error)}
            return json.dumps(found, separators=(",", ":")), "application/json; charset=utf-8"

        await self.reply(make)


class Metrics(Base):
    """The metrics of the run for Prometheus."""

    async def get(self) -> None:
        """Send all metrics."""
        try:
            await self.reply(lambda: (write_text(describe_metrics(self.follower)), CONTENT_TYPE))
        except CityError as error:
            raise HTTPError(503, reason="the run cannot be read") from error


class Home(Base):
    """Without the slash, names relative to the page would be wrong."""

    def get(self) -> None:
        """Send the browser to the page."""
        self.redirect(f"{PREFIX}/")


def make_rules(follower: EventReader, *, loopback: bool, dask: bool, root: bool = False) -> list[Any]:
    """List the paths for tornado; parameters as of `Base`, and with `root` the path ``/`` leads to the page."""
    given = {"follower": follower, "loopback": loopback, "dask": dask}
    rules: list[Any] = [
        (PREFIX, Home, given),
        (f"{PREFIX}/api/state", StateOfRun, given),
        (f"{PREFIX}/metrics", Metrics, given),
        (f"{PREFIX}/([a-z.]*)", Page, given),
    ]
    return [("/", Home, given), ("/metrics", Metrics, given), *rules] if root else rules


def _host_name(host: str) -> str:
    if host.startswith("["):
        return host[1:].split("]", maxsplit=1)[0]
    return host.rsplit(":", 1)[0]


def _read_number(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise HTTPError(400, reason="since must be a whole number")
    return int(text)


def _read_view(text: str) -> Box | None:
    if not text:
        return None
    try:
        xmin, ymin, xmax, ymax = map(float, text.split(","))
    except ValueError:
        raise HTTPError(400, reason="view must be four numbers") from None
    if not all(map(math.isfinite, (xmin, ymin, xmax, ymax))):
        raise HTTPError(400, reason="view must be four numbers")
    return xmin, ymin, xmax, ymax
