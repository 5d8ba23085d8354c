"""Stage 3: image pairs -> PairMatches, each photo encoded about once, resumable."""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from tqdm import tqdm

from hm_sfm.errors import ConfigError, MissingPackageError
from hm_sfm.io.batches import store_in_batches
from hm_sfm.matching.hypotheses import Sketch, retry_hypotheses
from hm_sfm.matching.interfaces import ImageFeatures
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.order import order_pairs
from hm_sfm.matching.store import MatchStore
from hm_sfm.photos.hypotheses import IDENTITY, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import PreparedImage, prepare_image
from hm_sfm.types import ImagePair, ImageRef, PairMatches, PatchMatches


@dataclass(frozen=True)
class MatchingTimes:
    """Seconds spent reading and encoding photos, and matching pairs."""

    features: float
    match: float


class FeatureCache:
    """Features of the photos used last, up to a limit of memory; photos are encoded on demand."""

    def __init__(self, images: Sequence[ImageRef], matcher: HomoMatcher, limit_mb: int, progress: tqdm) -> None:
        self.images = {image.name: image for image in images}
        self.matcher, self.limit_bytes, self.progress = matcher, limit_mb * 1_000_000, progress
        self.cached: OrderedDict[tuple[str, Hypothesis | None], ImageFeatures | Sketch] = OrderedDict()
        self.seen: set[str] = set()
        self.seconds = 0.0

    def get(self, name: str, hypothesis: Hypothesis = IDENTITY) -> ImageFeatures:
        """Features of a photo. Raises InputError where it cannot be decoded."""
        return self._keep(name, hypothesis, lambda image: self.matcher.encode(apply_hypothesis(image, hypothesis)))

    def sketch(self, name: str) -> Sketch:
        """The sketch of a photo. Raises as get does."""
        return self._keep(name, None, Sketch)

    def _keep(
        self, name: str, hypothesis: Hypothesis | None, make: Callable[[PreparedImage], ImageFeatures | Sketch]
    ) -> ImageFeatures | Sketch:
        """What was made of a photo, or is now. hypothesis: None for its sketch."""
        key = (name, hypothesis)
        if key in self.cached:
            self.cached.move_to_end(key)
            return self.cached[key]
        started = time.monotonic()
        made = self.cached[key] = make(prepare_image(self.images[name], self.matcher.images.long_edge_px))
        # Two photos are always held: a pair needs both.
        while len(self.cached) > 2 and sum(f.size_bytes for f in self.cached.values()) > self.limit_bytes:
            self.cached.popitem(last=False)
        self.seconds += time.monotonic() - started
        if name not in self.seen:
            self.seen.add(name)
            self.progress.update()
        return made

    def match(self, pair: ImagePair) -> PairMatches:
        """Match two photos. Raises ConfigError where their features alone exceed the limit."""
        names = (pair.name0, pair.name1)
        found = retry_hypotheses(
            self.matcher,
            self._match_upright(pair),
            lambda side, hypothesis: self.get(names[side], hypothesis),
            lambda side: self.sketch(names[side]),
        )
        return PairMatches(pair=pair, **vars(found))

    def _match_upright(self, pair: ImagePair) -> PatchMatches:
        """The matches of two photos as they are. Raises as match does."""
        if (pair.name1, IDENTITY) in self.cached:
            self.get(pair.name1)  # it is not given up for the other
        features = self.get(pair.name0), self.get(pair.name1)
        size_bytes = sum(image.size_bytes for image in features)
        if size_bytes > self.limit_bytes:
            raise ConfigError(
                f"matching.feature_cache_mb is {self.limit_bytes // 1_000_000}, but {pair.name0} and {pair.name1} "
                f"alone take {math.ceil(size_bytes / 1_000_000)} MB: allow more, or reduce images.long_edge_px"
            )
        return self.matcher.match_features(*features)


def check_engine(name: str) -> None:
    """Raises ConfigError where there is no such engine, MissingPackageError where its package is not installed."""
    if name not in ("serial", "ray"):
        raise ConfigError(f"matching.engine must be serial or ray, found {name!r}")
    if name == "ray" and find_spec("ray") is None:
        raise MissingPackageError(
            'matching.engine ray needs the package ray, which is not installed: pip install "hm_sfm[ray]"'
        )


def match_pairs(
    images: Sequence[ImageRef], pairs: Sequence[ImagePair], matcher: HomoMatcher, store: MatchStore, quiet: bool = False
) -> MatchingTimes:
    """Match the pairs that the store does not hold yet, and store them, by the engine of the configuration.

    Raises InputError on an undecodable photo or a full disk, and what check_engine, FeatureCache.match and
    match_on_cluster raise. Interrupted at any moment, what was stored stays; the same call goes on from there.
    """
    check_engine(matcher.config.engine)
    if matcher.config.engine == "ray":
        from hm_sfm.matching.ray_engine import match_on_cluster

        return match_on_cluster(images, pairs, matcher, store, quiet)
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
        cache = FeatureCache(images, matcher, matcher.config.feature_cache_mb, images_bar)
        if missing:
            capacity = cache.limit_bytes // cache.get(missing[0].name0).size_bytes
            missing = order_pairs(missing, max(2, capacity))
        for pair in missing:
            keep([cache.match(pair)])
            pairs_bar.update()
    store.merge()
    return MatchingTimes(features=cache.seconds, match=time.monotonic() - started - cache.seconds)
