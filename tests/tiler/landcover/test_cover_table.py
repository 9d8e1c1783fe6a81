"""Tables of patches: ours, and those of users with what is refused."""

from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.data.errors import ConfigError
from tiler.config.config import Config
from tiler.landcover.cover_table import TABLE, describe_patches, read_table

GOOD = '[water]\nz0 = 0.0002\nlevel = true\nclasses = ["Gracht"]\n[tarmac]\nz0 = 0.01\nclasses = ["road", "7"]\n'


def test_a_table_of_a_file_and_ours(tmp_path: Path) -> None:
    path = tmp_path / "table.toml"
    path.write_text(GOOD)
    config = Config(land_cover=("x.gpkg",), land_cover_table=str(path))
    rows = read_table(config)
    assert [(row.patch, row.roughness, row.level, row.classes) for row in rows] == [
        ("water", 0.0002, True, ("gracht",)),
        ("tarmac", 0.01, False, ("road", "7")),
    ]
    assert [row["patch"] for row in describe_patches(rows, padded=True)] == [
        "ground",
        "ground_water",
        "ground_tarmac",
        "ground_pad",
    ]
    assert read_table(Config(land_cover=("x.gpkg",))) == TABLE
    assert read_table(replace(config, land_cover=())) == ()
    words = [word for row in TABLE for word in row.classes]
    assert len(set(words)) == len(words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "0 patches"),
        ("[pad]\nz0 = 1\nclasses = ['a']", "not 'pad'"),
        ("[Water]\nz0 = 1\nclasses = ['a']", "small letters"),
        ("[water]\nz0 = 0\nclasses = ['a']", "z0 = 0"),
        ("[water]\nz0 = 1\nclasses = []", "list of words"),
        ("[water]\nz0 = 1\nclasses = ['a']\nlevel = 1", "true or false"),
        ("[water]\nz0 = 1\nclasses = ['a']\ncolour = 1", "nothing else"),
        ("[a]\nz0 = 1\nclasses = ['x']\n[b]\nz0 = 1\nclasses = ['X']", "give it to one"),
        ("[water", "not valid TOML"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "table.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_table(Config(land_cover=("x.gpkg",), land_cover_table=str(path)))
