"""In which order to match pairs, so that a cache of few photos seldom has to encode one again."""

from collections import OrderedDict
from collections.abc import Sequence
from itertools import islice

import numpy as np

from hm_sfm.types import ImagePair


def order_pairs(pairs: Sequence[ImagePair], capacity: int) -> tuple[ImagePair, ...]:
    """The same pairs, all different, in an order for a cache that holds the `capacity` images used last.

    The first image of the list is loaded first, then always the image that has most pairs left with the cached ones;
    all these pairs follow. The result never needs more loads than the order given: see count_loads.

    Raises ValueError where capacity is below 2: a pair needs both its images.
    """
    if capacity < 2:
        raise ValueError(f"capacity must be at least 2, got {capacity}")
    if not pairs:
        return ()
    order = _walk_greedily(pairs, capacity)
    ordered = tuple(pairs[at] for at in order)
    return min(ordered, tuple(pairs), key=lambda some: count_loads(some, capacity))


def count_loads(pairs: Sequence[ImagePair], capacity: int) -> int:
    """How often an image is loaded when the pairs are matched in this order, with the `capacity` last ones kept."""
    cached: OrderedDict[str, None] = OrderedDict()
    loads = 0
    for pair in pairs:
        names = (pair.name0, pair.name1)
        for name in names:
            if name in cached:
                cached.move_to_end(name)
        for name in names:
            if name not in cached:
                loads += 1
                cached[name] = None
                if len(cached) > capacity:
                    cached.popitem(last=False)
    return loads


def _walk_greedily(pairs: Sequence[ImagePair], capacity: int) -> list[int]:
    """Positions in `pairs`, in the order of order_pairs."""
    index: dict[str, int] = {}
    ends = np.array([[index.setdefault(name, len(index)) for name in (p.name0, p.name1)] for p in pairs])
    # One row per image, its partners and the positions of its pairs: partner[first[i] : first[i + 1]].
    near, partner = np.concatenate([ends, ends[:, ::-1]]).T
    by_image = np.argsort(near, kind="stable")
    first = np.searchsorted(near[by_image], np.arange(len(index) + 1))
    partner, position = partner[by_image], by_image % len(pairs)

    is_open = np.ones(len(pairs), bool)
    pairs_left = np.diff(first)
    is_cached = np.zeros(len(index), bool)
    needed = np.zeros(len(index), np.int64)  # open pairs with cached images, which have none among themselves
    weight = int(pairs_left.max()) + 1
    cached: OrderedDict[int, None] = OrderedDict()  # used longest ago first
    order: list[int] = []

    def count_partners(image: int, step: int) -> None:
        row = slice(first[image], first[image + 1])
        needed[partner[row][is_open[position[row]]]] += step

    image = 0
    while True:
        row = slice(first[image], first[image + 1])
        now = is_open[position[row]] & is_cached[partner[row]]
        others, places = partner[row][now], position[row][now]
        # The partners that are needed least come first: they are the first to be given up.
        turn = np.argsort(pairs_left[others], kind="stable")
        order.extend(places[turn].tolist())
        for other in others[turn].tolist():
            cached.move_to_end(other)
        is_open[places] = False
        pairs_left[others] -= 1
        pairs_left[image] -= len(others)
        needed[image] = 0
        cached[image] = None
        is_cached[image] = True
        count_partners(image, 1)
        if len(order) == len(pairs):
            return order

        if len(cached) == capacity:
            given_up, next_oldest = islice(cached, 2)
            count_partners(given_up, -1)
            if not needed.any():  # The next pair is one of the oldest image, which that keeps in the cache.
                count_partners(given_up, 1)
                given_up = next_oldest
                count_partners(given_up, -1)
            del cached[given_up]
            is_cached[given_up] = False
        if needed.any():
            image = int(np.argmax(needed * weight - pairs_left))
        else:
            image = int(np.argmin(np.where(pairs_left > 0, pairs_left, weight)))
