import threading
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_info

from dine import threads
from dine.geometry import distance
from dine.geometry.interpolation import FittedDisplacement, FittedValues
from dine.priors.gaussian import covariance_root

pytestmark = pytest.mark.numerical


@pytest.fixture(params=[1, 3])
def count(request):
    """A number of threads, of all libraries as at the start of a process with so many."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def blas_threads():
    return [x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas"]


def test_results_come_in_the_order_of_the_items(count):
    assert threads.each(lambda x: x**2, range(20)) == [x**2 for x in range(20)]
    assert threads.together(lambda: "a", lambda: "b", lambda: "c") == ["a", "b", "c"]
    assert threads.each(abs, []) == []


def test_items_are_worked_on_at_the_same_time(count):
    meeting = threading.Barrier(count, timeout=20)
    threads.each(lambda _: meeting.wait(), range(count))  # alone they would wait in vain


def test_within_a_shared_piece_of_work_there_is_one_thread(count):
    before = blas_threads()

    def inner(_):
        return threads.available(), threading.get_ident(), set(blas_threads())

    def outer(_):
        return threads.available(), {ident for _, ident, _ in threads.each(inner, range(5))}

    found = threads.each(outer, range(4))
    assert {available for available, _ in found} == {1}
    assert all(len(idents) == 1 for _, idents in found)
    ranges = []
    threads.run(lambda first, last: ranges.append(threads.available()), 0, 9)
    assert ranges == [1] * count
    if count > 1:
        assert all(blas == {1} for _, _, blas in threads.each(inner, range(4)))
    assert threads.available() == torch.get_num_threads() == count
    assert blas_threads() == before


@pytest.mark.parametrize("wrong", [0, 1, 4])
def test_a_fault_reaches_the_caller_once_all_are_done(count, wrong):
    done = []

    def work(item):
        if item == wrong:
            raise ValueError(f"item {item}")
        done.append(item)

    with pytest.raises(ValueError, match=f"item {wrong}"):
        threads.each(work, range(5))
    assert wrong not in done
    assert threads.available() == torch.get_num_threads() == count
    assert threads.each(abs, [-1, -2]) == [1, 2]


def test_a_range_is_split_without_gaps(count):
    seen = np.zeros(10, int)

    def kernel(step, first, last):
        seen[first:last] += step

    threads.run(kernel, 2, 9, 5)
    assert seen.tolist() == [0, 0, *[5] * 7, 0]


@pytest.mark.parametrize("places", [5, 5000])
def test_nearest_points_are_those_of_the_tree(count, places):
    rng = np.random.default_rng(0)
    tree, asked = cKDTree(rng.normal(size=(300, 3))), rng.normal(size=(places, 3))
    for ranks in (1, [1, 2, 3], [2]):
        for found, expected in zip(
            distance.nearest(tree, asked, ranks), tree.query(asked, ranks), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
    apart, index = distance.nearest(tree, asked, within=0.1)
    assert (np.isinf(apart) == (index == 300)).all()
    assert 0 < np.isfinite(distance.nearest(tree, asked, within=0.5)[0]).sum() < places


def test_fields_everywhere_do_not_depend_on_the_number_of_threads():
    rng = np.random.default_rng(1)
    points, places = rng.normal(size=(200, 3)), rng.normal(size=(1000, 3))
    root = covariance_root(points, (1.0, 0.5), (0.5, 0.2), 0.3, rank=50)
    amplitudes = rng.normal(size=(root.root.shape[1], 3))
    fields = (
        FittedValues(points, rng.normal(size=(200, 1))),
        FittedDisplacement(points, rng.normal(size=(200, 3))),
        partial(root.field, amplitudes=amplitudes),
    )
    found = []
    before = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append([field(places) for field in fields])
    finally:
        torch.set_num_threads(before)
    for one, three in zip(*found, strict=True):
        np.testing.assert_array_equal(one, three)
