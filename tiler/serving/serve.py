"""The web server of a run folder: `citystitch serve`."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

from pipeline.data.errors import ConfigError
from tiler.config.config import Config
from tiler.dashboard.server import is_loopback, serve_rules
from tiler.editing.edit import held_city, write_city_files
from tiler.engine.executor import Executor, OnDemand
from tiler.engine.task_limits import limit_workers
from tiler.mesh_files.run_files import find_files
from tiler.serving.bodies import MOST_BYTES
from tiler.serving.edit_queue import EditQueue
from tiler.serving.handlers import COOKIE, CityState, EditList, Keyed, OneEdit, Service, cookie_of
from tiler.serving.section import Section
from tiler.store.folder_lock import only_run
from tiler.store.kept import IN_PIECES, IN_STORE, need
from tiler.tiles3d.base import open_base
from tiler.tiles3d.globe import Globe
from tiler.tiles3d.update import MERGING_LEVEL, TILES, update_tileset
from tiler.tiles3d.view import PAGE, Files, show_until_interrupted
from tiler.words.plain_text import say_nothing

LEAST_TOKEN = 16  # characters
EDITABLE = 625.0  # m; side of tiles up to which edits are quick, see `docs/edit.md`
FOLDER = "view"  # below that of the run, with its 3D Tiles


class KeyedFiles(Keyed, Files):
    """Files of a folder for those who have the token."""

    def set_extra_headers(self, path: str) -> None:
        """Tell the page that the mesh is there, to be cut."""
        super().set_extra_headers(path)
        self.set_header("Citystitch-Section", "yes")


class Page(KeyedFiles):
    """The page; ``?token=`` is kept as a cookie, which opens the reads."""

    def prepare(self) -> None:
        """Take the token out of the address."""
        token = self.get_query_argument("token", "") if self.token else ""
        if token:
            self.request.headers["Authorization"] = f"Bearer {token}"
        super().prepare()
        if token:
            self.set_cookie(COOKIE, cookie_of(token), httponly=True, samesite="Strict")
            self.redirect("/")


def read_token(path: Path | None) -> str:
    """Read the token of clients; ConfigError where the file cannot be read."""
    try:
        return "" if path is None else path.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--token-file {path}: cannot be read ({error})") from None


@dataclass(frozen=True)
class Placed:
    """Where the tiles lie on the globe, see `tiler.tiles3d.globe.Globe`."""

    geoid_height: float = 0.0
    vertical_crs: str = ""


@contextmanager
def serve_city(
    directory: Path,
    address: str,
    *,
    token: str = "",
    workers: int = 0,
    placed: Placed | None = None,
    say: Callable[[str], None] = say_nothing,
) -> Iterator[str]:
    """Serve a run folder: its 3D Tiles, their page, and edits; gives its URL.

    Parameters
    ----------
    directory : Path
        Folder of a finished run, which this process holds meanwhile.
    address : str
        Where to listen, ``HOST:PORT``; port 0 is a free one.
    token : str
        What a client must send; may be empty where only this machine reaches the address.
    workers : int
        Worker processes, started with the first edit and kept; 0 for this one.
    placed : Placed, optional
        Where the tiles lie.
    say : callable
        Called with sentences that the user should read.

    Raises
    ------
    ConfigError
        If a token is missing or short, nobody can listen there, or the run cannot be edited.
    InputError
        If the folder holds no finished run.
    OutputError
        If the tiles cannot be written.
    """
    host = address.rpartition(":")[0].strip("[]")
    if not token and not is_loopback(host):
        raise ConfigError(f"{address}: others reach it; give --token-file with a token of theirs")
    if token and len(token) < LEAST_TOKEN:
        raise ConfigError(
            f"the token has {len(token)} characters, at least {LEAST_TOKEN} expected; take a longer one"
        )
    given = placed or Placed()

    def write_tiles(merging_level: float = 0.0) -> None:
        update_tileset(directory / FOLDER, find_files(directory), merging_level=merging_level, **vars(given))

    with ExitStack() as stack:
        city = stack.enter_context(held_city(directory, workers, say))
        if (side := city.config.tile_size_or_default) > EDITABLE:
            say(f"tiles of {side:g} m: an edit makes a whole one anew; with --tile-size 500 it is done sooner")
        write_city_files(city)  # which a killed server has left
        write_tiles()
        open_executor = partial(_warm_executor, workers, city.config) if workers else nullcontext
        queue = EditQueue(city, lambda _: write_tiles(MERGING_LEVEL), open_executor, say, at_rest=write_tiles)
        paths = {"/city": CityState, "/edits": EditList, "/edits/(.+)": OneEdit}
        globe = Globe(city.crs, city.bounds, **vars(given))
        rules = _make_rules(directory, globe, paths, service=Service(city, queue), token=token)
        root = stack.enter_context(serve_rules(rules, address, most_body=2 * MOST_BYTES))
        stack.enter_context(queue)  # ends before the server: clients are told
        yield f"{root}/"


@contextmanager
def view_city(directory: Path, address: str) -> Iterator[str]:
    """Show a finished run, which this process holds meanwhile: as `serve_city`, without edits; gives its URL.

    InputError, ConfigError and OutputError as there.
    """
    files = find_files(directory)
    need(directory, IN_STORE, IN_PIECES)
    with only_run(directory):
        update_tileset(directory / FOLDER, files)
        with serve_rules(_make_rules(directory, open_base(files).site.globe), address) as root:
            yield f"{root}/"


def _make_rules(
    directory: Path, globe: Globe, paths: Mapping[str, type[Keyed]] = MappingProxyType({}), **own: Any
) -> Callable[[bool], list[Any]]:
    """Make the paths of a server: tiles of a run, their page and sections, and others, with attributes for all."""
    own |= {"directory": directory, "globe": globe}
    tiles = {"path": str((directory / FOLDER / TILES).resolve())}
    files = [("/tiles/(.*)", KeyedFiles, tiles), ("/(.*)", Page, PAGE)]
    given: list[tuple[str, type[Keyed], dict[str, str]]] = [(path, kind, {}) for path, kind in paths.items()]
    given += [("/section", Section, {}), *files]

    def rules(loopback: bool) -> list[Any]:
        mine = own | {"loopback": loopback}
        return [(path, type(kind.__name__, (kind,), mine), words) for path, kind, words in given]

    return rules


@contextmanager
def _warm_executor(workers: int, config: Config) -> Iterator[Executor]:
    """Give workers for all edits."""
    from tiler.executors.local_cluster import local

    with ExitStack() as stack:
        yield OnDemand(workers, lambda: stack.enter_context(local(workers, limit_workers(config))))


def show_city(directory: Path, address: str, say: Callable[[str], None], **given: Any) -> None:
    """Serve a run folder until the process is interrupted; what is at work then ends first. See `serve_city`."""
    show_until_interrupted("serve", serve_city(directory, address, say=say, **given), say)
