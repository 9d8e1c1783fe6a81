"""A page that shows a folder of 3D Tiles, and the web server for both: `citystitch view`.

The page and the libraries that it needs are in ``viewer/``: nothing is fetched from elsewhere.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

from tornado.web import StaticFileHandler

from pipeline.data.errors import InputError
from tiler.dashboard.handlers import POLICY, Guarded
from tiler.dashboard.server import serve_rules
from tiler.tiles3d.subtrees import TILESET

VIEWER = Path(__file__).parent / "viewer"
PAGE = {"path": str(VIEWER), "default_filename": "page.html"}


class Files(Guarded, StaticFileHandler):
    """Files of a folder; a browser asks each time whether one has changed."""

    def compute_etag(self) -> str:
        """Tell a file by its time and size: tornado keeps the hash of one that has changed since."""
        found = self.get_absolute_path(self.root, self.path)
        stat = os.stat(found)
        return f'"{stat.st_mtime_ns:x}-{stat.st_size:x}"'

    def set_extra_headers(self, _path: str) -> None:
        """Let nothing be used again unasked, and the decoder of Draco run: WebAssembly, in a worker."""
        self.set_header("Cache-Control", "no-cache")
        policy = POLICY.replace("script-src 'self'", "script-src 'self' 'wasm-unsafe-eval'") + "; worker-src blob:"
        self.set_header("Content-Security-Policy", policy)


@contextmanager
def serve_tiles(folder: Path, address: str) -> Iterator[str]:
    """Serve a folder of 3D Tiles and its page, in a thread; gives its URL.

    Parameters
    ----------
    folder : Path
        What `citystitch export --format 3dtiles` wrote, or any other tileset.
    address : str
        Where to listen, ``HOST:PORT``; port 0 is a free one.

    Raises
    ------
    InputError
        If there is no tileset.
    ConfigError
        If nobody can listen there.
    """
    if not (folder / TILESET).is_file():
        raise InputError(
            f"{folder}: has no {TILESET}; write one by citystitch export RUN --format 3dtiles -o tiles, or name "
            "the folder of a finished run"
        )

    def rules(loopback: bool) -> list[Any]:
        files = type("Files", (Files,), {"loopback": loopback})
        return [("/tiles/(.*)", files, {"path": str(folder.resolve())}), ("/(.*)", files, PAGE)]

    with serve_rules(rules, address) as root:
        yield f"{root}/"


def show_until_interrupted(what: str, server: AbstractContextManager[str], say: Callable[[str], None]) -> None:
    """Let a server run until the process is interrupted, and say its URL; errors as of the server."""
    with server as url:
        say(f"{what}: {url} (Ctrl-C ends it)")
        with suppress(KeyboardInterrupt):
            threading.Event().wait()
