"""The paths of the service: state of the city, journal, and edits; errors are JSON, too."""

import asyncio
import hashlib
import hmac
import json
from concurrent.futures import Future
from dataclasses import dataclass
from http.client import responses
from typing import Any
from urllib.parse import urlsplit

from tornado.web import HTTPError

from pipeline.data.errors import CityError, OutputError
from tiler.dashboard.handlers import Guarded
from tiler.editing.edit import City, Outcome
from tiler.editing.requests import ConflictError
from tiler.engine.schedule import StoppedError
from tiler.serving.bodies import MOST_BYTES, make_asked, read_body
from tiler.serving.edit_queue import EditQueue
from tiler.store.edit_journal import Edit

COOKIE = "citystitch"


@dataclass(frozen=True)
class Service:
    """What the paths of edits answer from: the city, and its queue of edits."""

    city: City
    queue: EditQueue


class Keyed(Guarded):
    """Paths for those who have the token; for reads alone a cookie that stands for it does, too.

    Attributes
    ----------
    token : str
        That of who may ask, empty for none; a server has classes of its own with it.
    """

    token = ""

    def prepare(self) -> None:
        """Refuse who has no token, and writes that another page of a browser sends."""
        super().prepare()
        token, reads = self.token, self.request.method in ("GET", "HEAD")
        given = self.request.headers.get("Authorization", "").removeprefix("Bearer ")
        known = bool(token) and _same(given, token)
        if token and not known and not (reads and _same(self.get_cookie(COOKIE, "") or "", cookie_of(token))):
            raise HTTPError(401, reason="send the token: Authorization: Bearer TOKEN")
        origin = self.request.headers.get("Origin")
        if not reads and origin and not known and urlsplit(origin).netloc != self.request.host:
            raise HTTPError(403, reason="writes of other origins need the token")


class Api(Keyed):
    """Paths that answer JSON."""

    def reply(self, found: Any, status: int = 200) -> None:
        """Send an answer."""
        self.set_status(status)
        self.set_header("Content-Type", "application/json; charset=utf-8")
        self.finish(json.dumps(found))

    def refuse(self, error: Exception) -> None:
        """Tell why something was not done."""
        status = 503 if isinstance(error, OutputError | StoppedError) else 422
        if isinstance(error, CityError):
            self.reply({"error": str(error)}, status)
        else:
            self.reply({"error": f"{type(error).__name__}: {error}; the city is as before"}, 500)

    def write_error(self, status_code: int, **others: Any) -> None:
        """Describe what is wrong."""
        error = others.get("exc_info", (None, None, None))[1]
        self.reply({"error": getattr(error, "reason", None) or responses.get(status_code, "unknown")}, status_code)


class CityState(Api):
    """``GET /city``: revision, and what the writer does."""

    service: Service

    def get(self) -> None:
        """Send the state."""
        city, queue = self.service.city, self.service.queue
        state = {"revision": queue.revision, "state": queue.state, "waiting": queue.n_waiting}
        self.reply(state | {"crs": city.crs, "bounds": city.bounds, "trouble": queue.trouble})


class EditList(Api):
    """``GET /edits``: the journal; ``POST /edits``: an edit, answered when it is done."""

    service: Service

    def get(self) -> None:
        """Send all edits."""
        self.reply([describe_edit(edit) for edit in self.service.queue.journal])

    async def post(self) -> None:
        """Check an edit, let it wait for its turn, and tell what came of it."""
        if self.request.headers.get("Content-Type", "").partition(";")[0].strip() != "application/json":
            raise HTTPError(415, reason="Content-Type: application/json expected")
        if len(self.request.body) > MOST_BYTES:
            raise HTTPError(413, reason=f"{len(self.request.body)} bytes, bound {MOST_BYTES}")
        service = self.service
        try:
            body = read_body(self.request.body)
            asked = await asyncio.get_running_loop().run_in_executor(None, make_asked, body, service.city)
            found = service.queue.put(asked)
            if isinstance(found, Edit):
                self.reply(describe_edit(found))
            else:
                self.reply(describe_outcome(await asyncio.wrap_future(found)), 201)
        except ConflictError as error:
            changed = [describe_edit(edit) for edit in error.edits]
            self.reply({"error": str(error), "changed": changed, "revision": service.queue.revision}, 409)
        except Exception as error:
            self.refuse(error)


class OneEdit(Api):
    """``GET /edits/ID``: what became of the edit of that name."""

    service: Service

    def get(self, name: str) -> None:
        """Send the edit, or that it waits."""
        found = self.service.queue.find(name)
        if found is None:
            raise HTTPError(404, reason="no edit of that id is done or waits; send it again")
        if isinstance(found, Future):
            self.reply({"id": name, "state": "waiting"}, 202)
        else:
            self.reply(describe_edit(found))


def describe_edit(edit: Edit) -> dict[str, Any]:
    """Describe an edit for a client."""
    found = {"number": edit.number, "date": edit.date, "action": edit.action, "buildings": edit.ids}
    return found | {"source": edit.source, "id": edit.request}


def describe_outcome(outcome: Outcome) -> dict[str, Any]:
    """Describe an edit that is done just now."""
    tasks = outcome.record["tasks"]
    more = {"notes": list(outcome.told), "ran": tasks["ran"], "tasks": tasks["all"]}
    return describe_edit(outcome.edit) | more


def cookie_of(token: str) -> str:
    """Give what a browser keeps in place of a token: it does not tell it."""
    return hashlib.sha256(f"{COOKIE} {token}".encode()).hexdigest()


def _same(given: str, wanted: str) -> bool:
    """Compare in a time that does not depend on where two texts differ."""
    return hmac.compare_digest(given.encode(), wanted.encode())
