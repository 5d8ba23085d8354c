"""Structure from Motion from detector-free matches with homographies and persistent keypoints."""

from importlib import import_module
from typing import Any

_MODULE_OF = {
    "Config": "config",
    "HomoMatcher": "matching.matcher",
    "ImagePair": "types",
    "IndexMatches": "types",
    "Keypoints": "types",
    "MappingResult": "types",
    "PairMatches": "types",
    "PatchMatches": "types",
    "Tracks": "types",
    "export_database": "pipeline.reconstruction",
    "load_config": "config",
    "match_photos": "pipeline.reconstruction",
    "reconstruct": "pipeline.reconstruction",
}

__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Import a public name when it is first asked for: `hm-sfm --help` need not wait for PyTorch."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
