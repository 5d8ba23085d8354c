"""Stage 3 in one process: image pairs -> PairMatches, each photo encoded about once, resumable."""

import time
from collections.abc import Sequence

from tqdm import tqdm

from hm_sfm.io.batches import store_in_batches
from hm_sfm.matching.feature_cache import cache_features, match_pair
from hm_sfm.matching.interfaces import MatchingTimes, PairMatcher
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.store import MatchStore
from hm_sfm.types import ImagePair, ImageRef


def match_serially(
    images: Sequence[ImageRef], pairs: Sequence[ImagePair], matcher: PairMatcher, store: MatchStore, quiet: bool = False
) -> MatchingTimes:
    """As match_pairs, one pair after the other."""
    missing = [pair for pair in pairs if pair not in store]
    started = time.monotonic()
    names = {name for pair in missing for name in (pair.name0, pair.name1)}
    with (
        tqdm(total=len(names), desc="features", unit="image", disable=quiet or not names) as images_bar,
        tqdm(
            total=len(pairs), initial=len(pairs) - len(missing), desc="matches", unit="pair", disable=quiet
        ) as pairs_bar,
        store_in_batches(store.write) as keep,
    ):
        cache = cache_features(images, matcher, images_bar.update)
        if missing:
            capacity = cache.limit_bytes // cache.encode(missing[0].name0).size_bytes
            missing = order_pairs(missing, max(2, capacity))
        for pair in missing:
            keep([match_pair(cache, pair)])
            pairs_bar.update()
    store.merge()
    return MatchingTimes(features=cache.seconds, match=time.monotonic() - started - cache.seconds)
