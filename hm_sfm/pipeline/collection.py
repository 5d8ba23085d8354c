"""The photos of a run, and all that is known of them before any two are matched."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hm_sfm.colmap.cameras import Cameras, make_cameras
from hm_sfm.colmap.rigs import expand_pairs, read_rigs
from hm_sfm.config import Config
from hm_sfm.io.locks import wait_in_line
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.providers.choice import check_coarse
from hm_sfm.matching.run import check_engine
from hm_sfm.matching.store import digest_image
from hm_sfm.network.checkpoints import digest_weights
from hm_sfm.pairs.retrieval import CellStore, describe_images, find_similar
from hm_sfm.pairs.selection import select_pairs
from hm_sfm.photos.images import list_images
from hm_sfm.photos.masks import NO_MASKS, Masks, read_masks
from hm_sfm.photos.sizes import measure_px_scale
from hm_sfm.pipeline.output_folder import claim_folder
from hm_sfm.types import ImagePair, ImageRef


@dataclass(frozen=True)
class Collection:
    """Photos, the pairs of them that are matched, and their cameras and masks."""

    folder: Path
    """Of the photos."""
    images: tuple[ImageRef, ...]
    pairs: tuple[ImagePair, ...]
    cameras: Cameras
    masks: Masks = NO_MASKS
    skipped: int = 0
    """Files that are named like images but cannot be used."""


def collect_photos(
    folder: Path,
    out: Path,
    config: Config,
    get_matcher: Callable[[], HomoMatcher],
    quiet: bool = False,
    shared: bool = False,
) -> Collection:
    """List the photos, choose their pairs, and read cameras and masks: all bad input is reported here.

    out, get_matcher, shared: as in choose_pairs. Raises InputError on unusable photos, pairs, masks or matches,
    ConfigError on an unusable setting, MissingPackageError on a missing package, and what choose_pairs raises.
    """
    listed = list_images(folder)
    check_engine(config.matching.engine)
    pairs = choose_pairs(listed.images, out, config, get_matcher, quiet, shared)
    check_coarse(config.matching, pairs)
    cameras = make_cameras(listed.images, config.cameras)
    masks = read_masks(listed.images, config.masks)
    return Collection(Path(folder), listed.images, pairs, cameras, masks, len(listed.skipped))


def choose_pairs(
    images: Sequence[ImageRef],
    out: Path,
    config: Config,
    get_matcher: Callable[[], HomoMatcher],
    quiet: bool = False,
    shared: bool = False,
) -> tuple[ImagePair, ...]:
    """select_pairs for these photos. Where it must know which look alike, OUT is claimed and they are encoded into it.

    Of a sequence that rigs took, the photos of all their cameras are paired, see expand_pairs. get_matcher: called
    only where photos are encoded. shared: OUT, as in claim_folder. Raises what select_pairs, claim_folder, get_matcher,
    read_rigs and expand_pairs raise, and InputError on an undecodable photo; those encoded by then stay encoded.
    """
    image_of = {image.name: image for image in images}

    def rank_by_appearance(names: Sequence[str], top: int, gap: int) -> np.ndarray:
        first = images[0]
        claim_folder(Path(out), shared, photos=first.path.parents[len(Path(first.name).parts) - 1])
        encode = get_matcher().encoder.encode_plain
        photos = [image_of[name] for name in names]
        digests = {image.name: digest_image(image) for image in photos}
        folder = Path(out) / "retrieval"
        with wait_in_line(folder / ".lock"):  # other shards then have the photos encoded
            store = CellStore(folder, digest_weights(config.matching.model))
            rotated = config.matching.try_hypotheses
            return find_similar(describe_images(photos, digests, encode, store, quiet, rotated), top, gap)

    positions = {image.name: image.gps for image in images if image.gps}
    names = [image.name for image in images]
    pairs = select_pairs(names, config.pairs, rank_by_appearance, positions)
    if config.cameras.rig and config.pairs.mode == "sequential":  # each camera of a rig is a sequence for itself
        pairs = expand_pairs(pairs, read_rigs(Path(config.cameras.rig)), names, Path(config.cameras.rig))
    return pairs


def measure_px_scales(images: Sequence[ImageRef], config: Config) -> dict[str, float]:
    """Image name -> px of the stored image per px at the matching resolution."""
    return {image.name: measure_px_scale(image.size_wh, config.images.long_edge_px) for image in images}
