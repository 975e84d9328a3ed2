"""Values of a launch as columns: rows of several values, batches of whole rows, blocks by launch."""

from __future__ import annotations

import numpy as np

from s2a_bench.stats.batches import Blocks, LaunchValues, Rows


def test_rows_are_joined_without_the_empty_ones() -> None:
    rows = Rows.of([np.array([3.0, 1.0]), np.empty(0), np.array([7.0])])
    assert (len(rows), rows.values.tolist(), rows.levels.tolist()) == (2, [3, 1, 7], [2, 7])
    assert not Rows.of([])


def test_batches_are_whole_rows_in_order_of_time() -> None:
    rows = Rows(np.arange(24.0), np.array([2] * 12))
    assert [len(batch) for batch in LaunchValues(rows).batches] == [4, 4] + [2] * 8
    assert np.concatenate(LaunchValues(rows).batches).tolist() == list(range(24))


def test_blocks_are_sorted_by_launch_and_block_and_keep_the_order_within() -> None:
    values, launch, block = np.array([1.0, 2, 3, 4, 5]), np.array([1, 0, 1, 0, 1]), np.array([1, 0, 0, 3, 1])
    launches = Blocks.by_launch(values, launch, block)
    assert {key: (each.values.tolist(), each.block.tolist()) for key, each in launches.items()} == {
        0: ([2, 4], [0, 3]),
        1: ([3, 1, 5], [0, 1, 1]),
    }
    assert launches[1].shared(launches[0]).values.tolist() == [3]
    assert Blocks.by_launch(np.empty(0), np.empty(0, np.int64), np.empty(0, np.int64)) == {}
