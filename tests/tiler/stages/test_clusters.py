"""Clusters stored by the tile that owns them: as they were given, and each tile's own found by its place."""

from pathlib import Path
from zipfile import ZipFile

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from stitch.tiling.grid import Key
from tests.helpers.campaigns import examples
from tiler.citymodels.clusters import pack_clusters, place_in_grid, unpack_clusters
from tiler.config.declared import Declared
from tiler.engine.stage import Scope
from tiler.engine.task import Failure, Record, Task, run_task
from tiler.stages.city import list_members
from tiler.store.result_file import rows_per_chunk
from tiler.store.store import Store

# Two tiles; the second house of each is in a cluster with the first house of the first tile.
HOUSE = np.array([[4, -1, 0], [4, -1, 1], [5, 2, 0], [5, 2, 1]])
CLUSTER = np.array([0, 0, 2, 0])
CHANGED = np.array([True, True, False, True])


def own_rows(arrays: dict[str, NDArray[np.int64]], tile: Key) -> list[list[int]]:
    place = place_in_grid(arrays["grid"], tile)
    if place < 0:
        return []
    rows: list[list[int]] = arrays["owned"][arrays["start"][place] : arrays["start"][place + 1]].tolist()
    return rows


def test_a_tile_finds_the_houses_of_the_clusters_that_it_owns() -> None:
    arrays = pack_clusters(HOUSE, CLUSTER, CHANGED)
    assert arrays["grid"].tolist() == [4, -1, 2, 4]
    assert own_rows(arrays, Key(4, -1)) == [[4, -1, 0, 0, 1], [4, -1, 1, 0, 1], [5, 2, 1, 0, 1]]
    assert own_rows(arrays, Key(5, 2)) == [[5, 2, 0, 0, 0]]
    assert own_rows(arrays, Key(5, 0)) == []
    for outside in (Key(3, -1), Key(6, 0), Key(4, -2), Key(5, 3)):
        assert own_rows(arrays, outside) == []
    house, cluster = unpack_clusters(arrays)
    assert house.tolist() == HOUSE.tolist()
    assert cluster.tolist() == CLUSTER.tolist()


def test_a_region_without_houses_has_no_clusters() -> None:
    arrays = pack_clusters(np.empty((0, 3), np.int64), np.empty(0, np.int64), np.empty(0, np.bool_))
    assert own_rows(arrays, Key(0, 0)) == []
    house, cluster = unpack_clusters(arrays)
    assert (house.shape, cluster.shape) == ((0, 3), (0,))


def test_a_tile_reads_its_own_rows_alone(tmp_path: Path) -> None:
    n = rows_per_chunk(np.empty((0, 5), np.int64))
    house = np.column_stack((np.repeat(np.arange(3), n), np.zeros(3 * n, np.int64), np.tile(np.arange(n), 3)))
    arrays = pack_clusters(house, np.arange(3 * n), np.ones(3 * n, np.bool_))
    store = Store(tmp_path / "store.zarr")
    with store.writer("join-0", "region") as writer:
        writer.put(**arrays)
        writer.commit({"key": "", "facts": {}, "notes": []})
    file = store.file("join-0", "region")
    with ZipFile(file) as archive:
        place = file.read_bytes().index(archive.read("owned/c/2/0"))
    with file.open("r+b") as damaged:
        damaged.seek(place)
        damaged.write(bytes(100))
    found = {}
    for name in ("0_0", "1_0", "2_0"):
        given = Declared("members-0", {})
        refs: dict[str, tuple[str, ...]] = {"join-0": ("region",)}
        task = Task("members-0", name, Scope.TILE, (0, 0, 1, 1), given, None, "", store, refs, name, tmp_path)
        found[name] = run_task(list_members, task)
    for name in ("0_0", "1_0"):
        outcome = found[name]
        assert isinstance(outcome, Record)
        assert outcome.facts == {"n": n, "names": [name]}
    assert isinstance(found["2_0"], Failure)
    assert "is damaged" in str(found["2_0"].error)


@settings(max_examples=examples(50), deadline=None)
@given(st.lists(st.tuples(st.integers(-3, 3), st.integers(-3, 3), st.integers(1, 4)), min_size=1), st.data())
def test_clusters_come_back_as_they_were_given(tiles: list[tuple[int, int, int]], data: st.DataObject) -> None:
    n_houses = {(i, j): n for i, j, n in tiles}
    house = np.array([(i, j, k) for (i, j), n in sorted(n_houses.items()) for k in range(n)], np.int64)
    cluster = np.empty(len(house), np.int64)
    for row in range(len(house)):
        firsts = [k for k in range(row) if cluster[k] == k]
        cluster[row] = data.draw(st.sampled_from([row, *firsts]))
    changed = np.array([data.draw(st.booleans()) for _ in house])
    arrays = pack_clusters(house, cluster, changed)
    back, again = unpack_clusters(arrays)
    assert (back.tolist(), again.tolist()) == (house.tolist(), cluster.tolist())
    for i, j in n_houses:
        mine = (house[cluster, :2] == (i, j)).all(axis=1)
        expected = np.column_stack((house[mine], house[cluster[mine], 2], changed[mine]))
        assert own_rows(arrays, Key(i, j)) == expected.tolist()
