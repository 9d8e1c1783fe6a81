"""A proxy in front of an object store that fails on demand: errors, slow-downs, cut answers, silence."""

import http.client
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from tests.helpers.loopback import serving

OWN = {"connection", "transfer-encoding", "keep-alive", "content-length", "date", "server"}
ERRORS = {
    "403": b"<Error><Code>AccessDenied</Code><Message>Access Denied</Message></Error>",
    "429": b"<Error><Code>TooManyRequests</Code><Message>Please reduce your request rate.</Message></Error>",
    "500": b"<Error><Code>InternalError</Code><Message>We encountered an internal error.</Message></Error>",
    "503": b"<Error><Code>SlowDown</Code><Message>Please reduce your request rate.</Message></Error>",
}

# Takes the number of the request, its method and path; gives "", a key of ERRORS, "cut", or "lost": done, untold.
Fault = Callable[[int, str, str], str]


class FlakyProxy:
    """Passes requests on to a port of this machine, but for those that a rule makes fail."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.fault: Fault = lambda _number, _method, _path: ""
        self.seen: Counter[str] = Counter()  # requests by method
        self.failed: Counter[str] = Counter()  # by fault
        self.n_bytes = 0  # of all bodies given
        self.url = ""
        self._lock = threading.Lock()

    def judge(self, method: str, path: str) -> str:
        with self._lock:
            number = self.seen.total()
            self.seen[method] += 1
            found = self.fault(number, method, path)
            if found:
                self.failed[found] += 1
        return found


class _Handler(BaseHTTPRequestHandler):
    proxy: FlakyProxy
    protocol_version = "HTTP/1.1"

    def handle_any(self) -> None:
        body = self._body()
        fault = self.proxy.judge(self.command, self.path)
        if fault in ERRORS:
            self._answer(int(fault), {"Content-Type": "application/xml"}, ERRORS[fault])
            return
        if fault == "cut":
            self.close_connection = True
            return
        connection = http.client.HTTPConnection("127.0.0.1", self.proxy.port, timeout=60)
        try:
            headers = {name: value for name, value in self.headers.items() if name.lower() not in OWN}
            connection.request(self.command, self.path, body=body, headers=headers)
            answer = connection.getresponse()
            data = answer.read()
        except OSError:
            self.close_connection = True
            return
        finally:
            connection.close()
        if fault == "lost":
            self.close_connection = True
            return
        kept = {name: value for name, value in answer.getheaders() if name.lower() not in OWN}
        if self.command == "HEAD":
            kept["Content-Length"] = answer.getheader("Content-Length", "0")
        self.proxy.n_bytes += len(data)
        self._answer(answer.status, kept, data)

    do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815 (names of the library)

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding", "").lower() == "chunked":
            parts = []
            while size := int(self.rfile.readline().split(b";")[0], 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        return self.rfile.read(int(self.headers.get("Content-Length", "0")))

    def _answer(self, status: int, headers: dict[str, str], data: bytes) -> None:
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        if "Content-Length" not in headers:
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def log_message(self, *_: object) -> None:
        """Log nothing."""


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 64

    def handle_error(self, *_: object) -> None:
        """Say nothing: clients that are killed cut their connections."""


@contextmanager
def flaky_proxy(port: int) -> Iterator[FlakyProxy]:
    """Run a proxy in a thread."""
    proxy = FlakyProxy(port)
    handler = type("Handler", (_Handler,), {"proxy": proxy})
    with serving(_Server(("127.0.0.1", 0), handler)) as proxy.url:
        yield proxy
