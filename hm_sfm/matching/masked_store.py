"""Stored matches as they are read with masks."""

from dataclasses import dataclass

from hm_sfm.matching.store import MatchStore
from hm_sfm.photos.masks import Masks
from hm_sfm.types import ImagePair, PairMatches


@dataclass(frozen=True)
class MaskedStore:
    """Reads the stored matches that do not lie in masked pixels."""

    store: MatchStore
    masks: Masks

    def read(self, pair: ImagePair) -> PairMatches:
        """The matches of one pair. Raises KeyError where they were never stored."""
        return self.masks.drop_hidden(self.store.read(pair))
