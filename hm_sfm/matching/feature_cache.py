"""Photos matched by their features, which are kept up to a limit of memory."""

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar

from hm_sfm.errors import ConfigError
from hm_sfm.matching.hypotheses import Sketch, retry_hypotheses
from hm_sfm.matching.interfaces import PairMatcher
from hm_sfm.photos.hypotheses import IDENTITY, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import PreparedImage, prepare_image
from hm_sfm.types import ImagePair, ImageRef, PairMatches, PatchMatches

Key = TypeVar("Key", bound=Hashable)


class FeatureCache(Generic[Key]):
    """Features of the photos used last, up to matching.feature_cache_mb; photos are encoded on demand.

    Photos are known by keys: their names, or their paths.
    """

    def __init__(
        self,
        matcher: PairMatcher,
        prepare: Callable[[Key], PreparedImage],
        report: Callable[[], object] = lambda: None,
    ) -> None:
        """prepare: reads a photo. report: called when a photo has been encoded for the first time."""
        self.matcher, self.prepare, self.report = matcher, prepare, report
        self.limit_bytes = matcher.config.feature_cache_mb * 1_000_000
        self.cached: OrderedDict[tuple[Key, Hypothesis | None], Any] = OrderedDict()
        """Features by photo and hypothesis, and sketches, whose hypothesis is None; those used last come last."""
        self.seen: set[Key] = set()
        self.seconds = 0.0
        """Spent on reading and encoding photos."""

    def match(self, key0: Key, key1: Key) -> PatchMatches:
        """Match two photos, also under rotation and scale hypotheses where the matcher compares these.

        Raises ConfigError where the features of the two alone exceed the limit, and what `prepare` raises.
        """
        keys = (key0, key1)
        return retry_hypotheses(
            self.matcher,
            self._match_upright(key0, key1),
            lambda side, hypothesis: self.encode(keys[side], hypothesis),
            lambda side: self._sketch(keys[side]),
        )

    def encode(self, key: Key, hypothesis: Hypothesis = IDENTITY) -> Any:
        """Features of a photo. Raises what `prepare` raises."""
        return self._keep(key, hypothesis, lambda image: self.matcher.encode(apply_hypothesis(image, hypothesis)))

    def _sketch(self, key: Key) -> Sketch:
        return self._keep(key, None, Sketch)

    def _keep(self, key: Key, hypothesis: Hypothesis | None, make: Callable[[PreparedImage], Any]) -> Any:
        """What was made of a photo earlier, or is made now. hypothesis: None for its sketch."""
        at = (key, hypothesis)
        if at in self.cached:
            self.cached.move_to_end(at)
            return self.cached[at]
        started = time.monotonic()
        made = self.cached[at] = make(self.prepare(key))
        # Two photos are always held: a pair needs both.
        while len(self.cached) > 2 and sum(held.size_bytes for held in self.cached.values()) > self.limit_bytes:
            self.cached.popitem(last=False)
        self.seconds += time.monotonic() - started
        if key not in self.seen:
            self.seen.add(key)
            self.report()
        return made

    def _match_upright(self, key0: Key, key1: Key) -> PatchMatches:
        """The matches of two photos as they are. Raises as match does."""
        if (key1, IDENTITY) in self.cached:
            self.encode(key1)  # so that it is not dropped for the other
        features = self.encode(key0), self.encode(key1)
        size_bytes = sum(image.size_bytes for image in features)
        if size_bytes > self.limit_bytes:
            raise ConfigError(
                f"matching.feature_cache_mb is {self.limit_bytes // 1_000_000}, but {key0} and {key1} "
                f"alone take {math.ceil(size_bytes / 1_000_000)} MB: allow more, or reduce images.long_edge_px"
            )
        return self.matcher.match_features(*features)


def cache_features(
    images: Sequence[ImageRef], matcher: PairMatcher, report: Callable[[], object] = lambda: None
) -> FeatureCache[str]:
    """A cache of listed photos, by their names. Its `match` raises InputError on an undecodable photo."""
    image_of = {image.name: image for image in images}
    return FeatureCache(matcher, lambda name: prepare_image(image_of[name], matcher.images.long_edge_px), report)


def match_pair(cache: FeatureCache[str], pair: ImagePair) -> PairMatches:
    """The matches of a pair of listed photos. Raises as FeatureCache.match does."""
    return PairMatches(pair=pair, **vars(cache.match(pair.name0, pair.name1)))
