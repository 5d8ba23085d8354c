"""Stage 3: image pairs -> PairMatches, by the engine that the configuration names."""

from collections.abc import Sequence
from importlib.util import find_spec

from hm_sfm.errors import MissingPackageError
from hm_sfm.matching.interfaces import MatchingTimes, PairMatcher
from hm_sfm.matching.ray_engine import match_on_cluster
from hm_sfm.matching.serial_engine import match_serially
from hm_sfm.matching.store import MatchStore
from hm_sfm.types import ImagePair, ImageRef


def check_engine(name: str) -> None:
    """Raises MissingPackageError where the package of the engine `serial` or `ray` is not installed."""
    if name == "ray" and find_spec("ray") is None:
        raise MissingPackageError(
            'matching.engine ray needs the package ray, which is not installed: pip install "hm_sfm[ray]"'
        )


def match_pairs(
    images: Sequence[ImageRef], pairs: Sequence[ImagePair], matcher: PairMatcher, store: MatchStore, quiet: bool = False
) -> MatchingTimes:
    """Match the pairs that the store does not hold yet, and store them.

    Raises InputError on an undecodable photo or a full disk, and what check_engine, FeatureCache.match and
    match_on_cluster raise. Interrupted at any moment, what was stored stays; the same call goes on from there.
    """
    check_engine(matcher.config.engine)
    match = match_on_cluster if matcher.config.engine == "ray" else match_serially
    return match(images, pairs, matcher, store, quiet)
