"""Servers on loopback: moto's S3, and one of files with or without ranges."""

import http.client
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from tests.helpers.loopback import free_ports, serving

BUCKET = "bucket"
SECRET = "5up3rs3cr3t"
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": SECRET, "AWS_DEFAULT_REGION": "us-east-1"}


class S3Server:
    """moto as a process of its own, with one bucket; it keeps nothing where it is started again."""

    def __init__(self) -> None:
        self.port = free_ports(1)[0]
        command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        end = time.monotonic() + 120
        while self.ask("PUT", f"/{BUCKET}") != 200:
            assert time.monotonic() < end, "moto does not answer"
            assert self._process.poll() is None, "moto has ended; pip install 'moto[server]'"
            time.sleep(0.1)

    def ask(self, method: str, path: str) -> int:
        """Make a request; gives its status, 0 where nobody answers."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request(method, path, headers={"Authorization": "AWS key:x"})
            answer = connection.getresponse()
            answer.read()
            return answer.status
        except OSError:
            return 0
        finally:
            connection.close()

    def stop(self) -> None:
        self._process.kill()
        self._process.wait(30)


@contextmanager
def s3_server() -> Iterator[S3Server]:
    server = S3Server()
    try:
        yield server
    finally:
        server.stop()


def environment(url: str) -> dict[str, str]:
    """Variables of a process that is to use a server."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
    return kept | KEYS | {"AWS_ENDPOINT_URL": url}


class FileServer:
    """Gives the files of a folder, by ranges if it may, and counts the bytes."""

    def __init__(self, folder: Path, *, ranges: bool) -> None:
        self.folder, self.ranges, self.n_bytes, self.n_requests, self.url = folder, ranges, 0, 0, ""


@contextmanager
def file_server(folder: Path, *, ranges: bool = True) -> Iterator[FileServer]:
    files = FileServer(folder, ranges=ranges)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self._answer(with_body=True)

        def do_HEAD(self) -> None:
            self._answer(with_body=False)

        def _answer(self, *, with_body: bool) -> None:
            path = files.folder / self.path.lstrip("/")
            if not path.is_file():
                self._send(403 if "secret" in self.path else 404, b"", {}, with_body)
                return
            data, asked = path.read_bytes(), self.headers.get("Range", "")
            tag = {"ETag": f'"{len(data)}-{path.stat().st_mtime_ns}"'}
            found = re.fullmatch(r"bytes=(\d+)-(\d+)", asked)
            if found and files.ranges:
                start, stop = int(found[1]), min(int(found[2]) + 1, len(data))
                tag["Content-Range"] = f"bytes {start}-{stop - 1}/{len(data)}"
                self._send(206, data[start:stop], tag, with_body)
            else:
                self._send(200, data, tag, with_body)

        def _send(self, status: int, data: bytes, headers: dict[str, str], with_body: bool) -> None:
            files.n_requests += 1
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Last-Modified", "Sun, 01 Jan 2023 00:00:00 GMT")
            self.end_headers()
            if with_body:
                files.n_bytes += len(data)
                self.wfile.write(data)

        def log_message(self, *_: Any) -> None:
            """Log nothing."""

    with serving(ThreadingHTTPServer(("127.0.0.1", 0), Handler)) as files.url:
        yield files
