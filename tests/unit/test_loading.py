"""Batches: each pair's own shuffle, and one batch made ahead."""

import contextlib
import threading

import numpy as np
import pytest
import torch
from test_training import toy_pairs

from dine.data.loading import Batches
from dine.errors import DataError

CPU = torch.device("cpu")


def test_targets_are_shuffled_and_truth_is_not():
    pairs = toy_pairs()
    batch, truth = Batches(pairs, CPU).get([2], [(0,)])
    assert not np.array_equal(batch.target[0].numpy(), pairs.target[2])
    assert {tuple(p) for p in batch.target[0].tolist()} == {
        tuple(p) for p in pairs.target[2].tolist()
    }
    assert np.array_equal(truth[0].numpy(), pairs.target[2] - pairs.source[2])


def test_a_pairs_shuffle_does_not_depend_on_its_batch():
    batches = Batches(toy_pairs(), CPU)
    together, _ = batches.get([0, 3], [(1, 2), (5, 6)])
    alone, _ = batches.get([3], [(5, 6)])
    assert torch.equal(together.target[1], alone.target[0])


def test_other_targets_stand_in_for_the_clean_ones():
    pairs = toy_pairs()
    batch, truth = Batches(pairs, CPU, pairs.target[:, :7] + 1).get([1])
    assert np.array_equal(batch.target[0].numpy(), pairs.target[1, :7] + 1)
    assert np.array_equal(truth[0].numpy(), pairs.target[1] - pairs.source[1])


def loaders():
    return [thread for thread in threading.enumerate() if thread.name.startswith("batches")]


def test_a_stream_gives_what_was_asked_for_in_order():
    batches = Batches(toy_pairs(), CPU)
    requests = [([i, i], [(i, 0), (i, 1)]) for i in range(5)]
    for (batch, truth), request in zip(batches.stream(requests), requests, strict=True):
        expected, expected_truth = batches.get(*request)
        assert torch.equal(batch.source, expected.source)
        assert torch.equal(batch.target, expected.target)
        assert torch.equal(batch.graph.head, expected.graph.head)
        assert torch.equal(truth, expected_truth)
    assert list(batches.stream([])) == []
    assert not loaders()


def test_a_stream_is_one_batch_ahead_and_stops_with_its_user():
    asked = []

    def requests():
        for index in range(5):
            asked.append(index)
            yield [index], None

    with contextlib.closing(Batches(toy_pairs(), CPU).stream(requests())) as stream:
        next(stream)
        assert asked == [0, 1]
        next(stream)
        assert asked == [0, 1, 2]
        assert loaders()
    assert asked == [0, 1, 2]
    assert not loaders()


def test_a_fault_in_the_thread_reaches_the_user():
    pairs = toy_pairs()
    pairs.target[1, 0, 0] = np.nan
    stream = Batches(pairs, CPU).stream(([index], None) for index in range(5))
    next(stream)
    with pytest.raises(DataError, match="NaN"):
        next(stream)
    assert not loaders()


def test_parts_are_pieces_of_the_source_in_their_own_frame():
    pairs = toy_pairs()
    batches = Batches(pairs, CPU, parts=1.0)
    sizes = set()
    for index in range(5):
        batch, truth = batches.get([index], [(7, index)])
        size = batch.source.shape[1]
        sizes.add(size)
        assert 0.29 * pairs.source.shape[1] <= size < pairs.source.shape[1]
        assert batch.target.shape[1] == pairs.target.shape[1]
        assert batch.source[0].norm(dim=1).max() == pytest.approx(1, abs=1e-5)
        assert batch.source[0].mean(dim=0).abs().max() < 1e-5
        # Every moved point is one of the target's.
        moved = batch.source[0] + truth[0]
        assert torch.cdist(moved.double(), batch.target[0].double()).amin(dim=1).max() < 1e-5
        assert int(batch.graph.tail.max()) < size
    assert len(sizes) > 1
    whole, _ = Batches(pairs, CPU, parts=0.0).get([0], [(7, 0)])
    assert whole.source.shape[1] == pairs.source.shape[1]


def test_some_parts_share_a_batch_with_wholes():
    pairs = toy_pairs()
    batches = Batches(pairs, CPU, parts=0.5)
    batch, truth = batches.get(range(5), [(8, index) for index in range(5)])
    sizes = batch.source_mask.sum(dim=1)
    assert sizes.min() < sizes.max() == pairs.source.shape[1]
    assert (truth[~batch.source_mask] == 0).all()
