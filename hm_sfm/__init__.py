"""Structure from Motion from detector-free matches with homographies and persistent keypoints."""

import zlib  # noqa: F401  before pycolmap 4.2.1, whose copy of it would be mixed with the system's: that crashes
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hm_sfm.config import Config, load_config
    from hm_sfm.matching.matcher import HomoMatcher
    from hm_sfm.pipeline.reconstruction import export_database, match_photos, reconstruct
    from hm_sfm.types import ImagePair, IndexMatches, Keypoints, MappingResult, PairMatches, PatchMatches, Tracks

__all__ = [
    "Config",
    "HomoMatcher",
    "ImagePair",
    "IndexMatches",
    "Keypoints",
    "MappingResult",
    "PairMatches",
    "PatchMatches",
    "Tracks",
    "export_database",
    "load_config",
    "match_photos",
    "reconstruct",
]

_EXPORTS = {
    "hm_sfm.config": ("Config", "load_config"),
    "hm_sfm.matching.matcher": ("HomoMatcher",),
    "hm_sfm.pipeline.reconstruction": ("export_database", "match_photos", "reconstruct"),
    "hm_sfm.types": (
        "ImagePair", "IndexMatches", "Keypoints", "MappingResult", "PairMatches", "PatchMatches", "Tracks",
    ),
}  # fmt: skip
"""The imports above, for those that are made at run time. A test keeps the two equal."""


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: `hm-sfm --help` need not wait for PyTorch."""
    for module, names in _EXPORTS.items():
        if name in names:
            return getattr(import_module(module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *__all__]
