"""Wind roses: both kinds of table, shares, calm, and what cannot be."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.data.errors import InputError
from tiler.wind.rose import nearest_directions, read_rose


def write(folder: Path, text: str) -> Path:
    path = folder / "rose.csv"
    path.write_text(text)
    return path


def test_weibull_by_sector(tmp_path: Path) -> None:
    rose = read_rose(write(tmp_path, "direction, share, scale, shape\n0, 0.25, 4, 2\n-90, 0.65, 6, 1\n"))
    assert rose.direction.tolist() == [0.0, 270.0]
    assert rose.calm == pytest.approx(0.1)
    # Of shape 1 the mean is the scale, and a speed of the scale is exceeded for 1/e of the time.
    assert rose.mean_speed()[1] == pytest.approx(6.0)
    assert rose.exceeded(1, np.array([1.0, 0.5]), 6.0) == pytest.approx([np.exp(-1), np.exp(-2)])
    assert rose.exceeded(0, np.array([1.0]), 8.0) == pytest.approx([np.exp(-4)])


def test_a_table_of_speeds_in_percent(tmp_path: Path) -> None:
    rose = read_rose(write(tmp_path, "Direction,Speed,Share,note\n0,3,40,x\n0,7,20,x\n180,5,40,x\n"))
    assert rose.calm == 0.0
    assert rose.share.tolist() == [0.4, 0.2, 0.4]
    assert rose.mean_speed().tolist() == [3.0, 7.0, 5.0]
    assert rose.exceeded(1, np.array([0.5, 1.0, np.nan]), 5.0).tolist()[:2] == [0.0, 1.0]
    assert np.isnan(rose.exceeded(1, np.array([np.nan]), 5.0)).all()


def test_sectors_take_the_nearest_direction_across_north(tmp_path: Path) -> None:
    rose = read_rose(write(tmp_path, "direction,speed,share\n350,5,0.5\n170,5,0.3\n100,5,0.2\n"))
    row, off = nearest_directions(rose, [10.0, 190.0])
    assert row.tolist() == [0, 1, 0]
    assert off.tolist() == [20.0, 20.0, 90.0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "0 rows of no columns"),
        ("direction,share\n0,1\n", "1 rows of direction, share; a wind rose has rows of"),
        ("direction,speed,share\n", "0 rows of direction, speed, share"),
        ("direction,speed,share\n0,5\n", "line 2: share is None, must be a number from 0 on"),
        ("direction,speed,share\n0,fast,1\n", "line 2: speed is 'fast'"),
        ("direction,speed,share\n0,5,1\n0,-1,0\n", "line 3: speed is '-1'"),
        ("direction,share,scale,shape\n0,1,5,0\n", "line 2: shape is '0', must be more than 0"),
        ("direction,speed,share\n0,5,80\n0,6,30\n", "shares add up to 110, expected at most 1, or 100 percent"),
        ("direction,speed,share\n0,5,0\n", "shares add up to 0"),
    ],
)
def test_what_is_no_rose(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_rose(write(tmp_path, text))
    with pytest.raises(InputError, match="cannot be read as CSV"):
        read_rose(tmp_path / "none.csv")
