"""What the mappers are asked for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pycolmap

from hm_sfm.config import MappingConfig, VerificationConfig


@dataclass(frozen=True)
class MappingTask:
    """A verified database to build models from, and how."""

    database: Path
    image_folder: Path
    """For the colours of the points."""
    sparse_folder: Path
    """The models go to its subfolders 0, 1, ..., as COLMAP binary, see replace_models."""
    config: MappingConfig = field(default_factory=MappingConfig)
    max_error_px: float = VerificationConfig().max_error_px
    """Px of the matching resolution: observations farther than this from their point are dropped. COLMAP's own 4 px are
    meant for keypoints that are less exact. Calibration before global mapping allows the same error in photos of 1000
    px, and as much more as photos are larger."""
    px_scale: Mapping[str, float] = field(default_factory=dict)
    """By image name, px of the stored image per px of the matching resolution; 1 where it is left out. All limits of
    the mappers that count px count them at the matching resolution."""
    fix_intrinsics: bool = False
    """Keep all cameras as the database has them."""
    split_cameras: bool = True
    """Photos that share a camera may get one each, where a model is impossible otherwise."""
    on_image: Callable[[], object] | None = None
    """Called once per registered image, of a rig once per frame."""


# Makes models, given a task, whose database is px of the matching resolution, and a new folder to work in.
Build = Callable[[MappingTask, Path], list[pycolmap.Reconstruction]]
