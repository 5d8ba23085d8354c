"""Structure from Motion from detector-free matches with homographies and persistent keypoints."""

from hm_sfm.config import Config, load_config
from hm_sfm.network.model import HomoMatcher
from hm_sfm.reconstruction import export_database, match_photos, reconstruct
from hm_sfm.types import ImagePair, IndexMatches, Keypoints, PairMatches, PatchMatches, Tracks

__all__ = [
    "Config",
    "HomoMatcher",
    "ImagePair",
    "IndexMatches",
    "Keypoints",
    "PairMatches",
    "PatchMatches",
    "Tracks",
    "export_database",
    "load_config",
    "match_photos",
    "reconstruct",
]
