"""A set of numbers that grows a block at a time."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tiler.citymodels.number_set import NumberSet

BLOCKS = st.lists(st.lists(st.integers(-(2**63), 2**63 - 1) | st.integers(-5, 5), max_size=40), max_size=30)


@given(BLOCKS)
def test_it_has_what_was_added_and_nothing_else(blocks: list[list[int]]) -> None:
    seen, added = NumberSet(), set[int]()
    for block in blocks:
        numbers = np.array(block, np.int64)
        asked = np.concatenate((numbers, numbers[::-1] // 2))
        assert seen.has(asked).tolist() == [number in added for number in asked.tolist()]
        seen.add(numbers)
        added.update(block)
        assert seen.has(numbers).all()


def test_few_arrays_hold_many_blocks() -> None:
    """What is asked is looked up in as many arrays as the number of blocks has digits."""
    seen = NumberSet()
    for block in range(1000):
        seen.add(np.arange(512 * block, 512 * (block + 1)))
    lengths = [len(array) for array in seen._arrays]
    assert sum(lengths) == 512_000
    assert len(lengths) <= 10
    assert seen.has(np.array([0, 511_999, 512_000])).tolist() == [True, True, False]
