"""Many clients, and a server that is killed again and again: the city ends as one run makes it."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException
from pathlib import Path
from typing import Any

import pytest
import shapely
from shapely import affinity

from tests.tiler.editing.test_edit import mesh_of, read_input, write
from tests.tiler.serving.test_service import ask, footprint
from tests.tiler.tiles3d.test_update import read_all
from tiler.config.config import make_config
from tiler.export.export import export_run
from tiler.serving.edit_queue import REST
from tiler.workflow.audit import Audit
from tiler.workflow.run import run

CLIENTS, EDITS, KILLS = 8, 25, 12  # edits of each client
LEAST_SECONDS, MOST_SECONDS = 4.0, 30.0  # between two kills


@contextmanager
def killed_server(folder: Path, random_source: random.Random, kills: int) -> Iterator[list[str]]:
    """Serve a folder by a process that is killed and started anew; gives its URL, empty while there is none."""
    place, ended = [""], threading.Event()

    def start() -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "tiler.cli.main", "serve", str(folder)]
        server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ)
        assert server.stdout is not None
        for line in server.stdout:
            if line.startswith("serve: "):
                place[0] = line.split()[1]
                return server
        raise AssertionError(f"the server ended with {server.wait()}")

    def work() -> None:
        for kill in range(kills + 1):
            server = start()
            ended.wait(random_source.uniform(LEAST_SECONDS, MOST_SECONDS) if kill < kills else None)
            place[0] = ""
            server.send_signal(signal.SIGTERM if kill == kills else signal.SIGKILL)
            server.wait()
            if server.stdout is not None:
                server.stdout.close()

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield place
    finally:
        ended.set()
        thread.join()


def send(place: list[str], body: dict[str, Any]) -> tuple[int, Any]:
    """Send an edit until somebody tells what came of it."""
    while True:
        try:
            status, told = ask(place[0], "/edits", body)
            if status != 503:
                return status, told
        except (OSError, HTTPException, IndexError):
            pass
        time.sleep(0.2)


class Client:
    """Edits buildings of the city at random, and remembers what it was told."""

    def __init__(self, number: int, place: list[str], shapes: dict[str, shapely.Polygon]) -> None:
        self._random, self._place = random.Random(number), place
        self._number, self._shapes = number, shapes
        self.done: list[tuple[int, str, shapely.Polygon | None]] = []
        self.refused = 0

    def work(self) -> None:
        """Send all edits."""
        for k in range(EDITS):
            name = self._random.choice(sorted(self._shapes))
            shape = affinity.translate(
                affinity.scale(self._shapes[name], self._random.uniform(0.6, 1.0), self._random.uniform(0.6, 1.0)),
                self._random.uniform(-1, 1),
            )
            action = self._random.choice(("replace", "replace", "remove", "add"))
            body: dict[str, Any] = {"id": f"{self._number}-{k}", "action": action, "building": name}
            if action != "remove":
                body["footprint"] = footprint(shape)
            if self._random.random() < 0.2:
                body["base"] = 0  # a conflict, mostly
            status, told = send(self._place, body)
            assert status in (200, 201, 409, 422), told
            if status in (200, 201):
                self.done.append((told["number"], name, shape if action != "remove" else None))
            self.refused += status in (409, 422)


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_edits_of_many_clients_with_kills_end_in_the_bytes_of_one_run(small_run: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(small_run, tmp_path / "city")
    shapes = read_input(folder)
    with killed_server(folder, random.Random(0), KILLS) as place:
        clients = [Client(number, place, shapes) for number in range(CLIENTS)]
        threads = [threading.Thread(target=client.work) for client in clients]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        while not place[0] or ask(place[0], "/city")[1]["state"] != REST:
            time.sleep(0.1)
        journal = ask(place[0], "/edits")[1]
    done = sorted((edit for client in clients for edit in client.done), key=lambda edit: edit[0])
    assert [number for number, _, _ in done] == list(range(1, len(done) + 1))  # told, each once, and none lost
    assert len(done) + sum(client.refused for client in clients) == CLIENTS * EDITS
    assert [edit["number"] for edit in journal] == [number for number, _, _ in done]
    for _, name, shape in done:
        shapes.pop(name, None)
        if shape is not None:
            shapes[name] = shape
    assert not [*Audit(folder)]
    final = write(tmp_path / "final.gpkg", *shapes.values(), ids=list(shapes))
    given = json.loads((folder / "run.json").read_text())["parameters"]
    run(make_config(given | {"footprints": str(final), "out": str(tmp_path / "whole")}))
    assert mesh_of(folder) == mesh_of(tmp_path / "whole")
    export_run(tmp_path / "whole", tmp_path / "tiles", name="3dtiles")
    with killed_server(folder, random.Random(0), 0) as place:
        while not place[0]:
            time.sleep(0.1)
    assert read_all(folder / "view/tiles") == read_all(tmp_path / "tiles")
