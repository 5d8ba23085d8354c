"""One run over a collection of photos: the object that owns its matcher, matches, masks and timings."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import pycolmap
from tqdm import tqdm

from hm_sfm.colmap.camera_starts import correct_focal_lengths
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_images
from hm_sfm.colmap.overlays import Overlays, find_overlays
from hm_sfm.colmap.verification import VerifiedPair, rank_pairs, verify_database, verify_pairs
from hm_sfm.config import Config
from hm_sfm.judgement.judgement import Judgement, judge_pairs
from hm_sfm.keypoints.graph import Photo
from hm_sfm.keypoints.persistence import persist_keypoints
from hm_sfm.keypoints.refinement import KeypointRefiner
from hm_sfm.keypoints.seeds import find_seeds
from hm_sfm.matching.interfaces import PairMatcher
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.run import match_pairs
from hm_sfm.matching.shards import Shard
from hm_sfm.matching.store import MatchStore
from hm_sfm.network.fine import HomographyHead
from hm_sfm.photos.images import prepare_image
from hm_sfm.photos.masks import NO_MASKS, Masks
from hm_sfm.pipeline.collection import Collection, measure_px_scales
from hm_sfm.pipeline.output_folder import MATCHES_FILE, open_store
from hm_sfm.pipeline.timings import Timings
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, PairMatches


class Run:
    """A collection of photos on its way to a model, in the folder `out`.

    Its methods are the stages, in their order; each adds to `timings`.
    """

    def __init__(
        self,
        collection: Collection,
        out: Path,
        config: Config,
        matcher: PairMatcher,
        *,
        store: MatchStore | None = None,
        timings: Timings | None = None,
        quiet: bool = False,
    ) -> None:
        """Open the matches that an earlier run left in OUT, which is claimed already.

        store: of other matches than those that the configuration describes. Raises what open_store raises.
        """
        self.collection, self.out, self.config, self.matcher = collection, Path(out), config, matcher
        self.store = store or open_store(self.out / MATCHES_FILE, collection.images, config)
        self.timings = timings or Timings()
        self.quiet = quiet

    @property
    def images(self) -> tuple[ImageRef, ...]:
        """All photos, in the order of the results."""
        return self.collection.images

    @property
    def pairs(self) -> tuple[ImagePair, ...]:
        """The pairs that are matched."""
        return self.collection.pairs

    def take(self, shard: Shard) -> "Run":
        """The run of a shard: those of its pairs that are not in OUT/matches.h5, with a file of its own."""
        pairs = tuple(pair for pair in shard.take(self.pairs) if pair not in self.store)
        collection = dataclasses.replace(self.collection, pairs=pairs)
        store = MatchStore(shard.locate(self.out), self.store.made_by, self.store.digests)
        return Run(collection, self.out, self.config, self.matcher, store=store, timings=self.timings, quiet=self.quiet)

    def match(self) -> None:
        """Match the pairs that are not stored yet. Raises what match_pairs raises; what was stored stays."""
        times = match_pairs(self.images, self.pairs, self.matcher, self.store, self.quiet)
        self.timings.add(dataclasses.asdict(times))

    def read(self, pair: ImagePair) -> PairMatches:
        """The matches of a pair that are neither masked nor on an overlay. Raises KeyError if some are not matched."""
        return self._overlays.drop_still(self._read_unmasked(pair))

    def _read_unmasked(self, pair: ImagePair) -> PairMatches:
        return self.collection.masks.drop_hidden(self.store.read(pair))

    @cached_property
    def _overlays(self) -> Overlays:
        px_scales = measure_px_scales(self.images, self.config)
        return find_overlays(
            self.images, self.pairs, self._read_unmasked, px_scales, self.config.verification.min_score
        )

    def verify(self) -> Judgement:
        """The pairs that a two-view geometry and, where the configuration asks for it, other photos agree with."""
        cameras = self.collection.cameras
        camera_of = {image.name: cameras.cameras[i] for image, i in zip(self.images, cameras.camera_index, strict=True)}
        px_scales, config = measure_px_scales(self.images, self.config), self.config.verification
        with self.timings.measure("verify"):
            verified = verify_pairs(self.images, self.pairs, self.read, camera_of, px_scales, config, self.quiet)
        if not config.judge:
            return Judgement(verified, (), 0)
        with self.timings.measure("judge"):
            return judge_pairs(verified, self.read, camera_of, px_scales, config, self.quiet)

    def make_keypoints(
        self, verified: Mapping[ImagePair, VerifiedPair], seeds: Mapping[str, np.ndarray] | None = None
    ) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
        """Persistent keypoints of all photos, and the matches of the pairs that share tracks, from verified matches.

        seeds: as in seed_photos. Raises InputError on an undecodable photo.
        """
        with self.timings.measure("keypoints"):
            return persist_keypoints(
                seed_photos(self.images, self.config, self.collection.masks, seeds, self.quiet),
                rank_pairs(verified),
                lambda pair: self.read(pair).select(verified[pair].inliers),
                self.config.keypoints,
                make_refiner(self.matcher, self.images, self.config, self.store),
                self.quiet,
            )

    def write_database(self, keypoints: Sequence[Keypoints], matches: Sequence[IndexMatches]) -> Path:
        """OUT/database.db, see write_verified; its path."""
        path = self.out / "database.db"
        with self.timings.measure("verify"):
            write_verified(path, self.collection, self.config, keypoints, matches)
        return path

    def map(self) -> tuple[pycolmap.Reconstruction, ...]:
        """The models of OUT/database.db, largest first, also in OUT/sparse."""
        with self.timings.measure("map"):
            return map_database(self.out / "database.db", self.collection, self.config, "mapping", self.quiet)


def load_matcher(config: Config) -> HomoMatcher:
    """The matcher of the configuration. Raises what HomoMatcher.from_pretrained raises."""
    return HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )


def seed_photos(
    images: Sequence[ImageRef],
    config: Config,
    masks: Masks = NO_MASKS,
    seeds: Mapping[str, np.ndarray] | None = None,
    quiet: bool = False,
) -> tuple[Photo, ...]:
    """The photos with the points that keypoints may start at.

    masks: no keypoint will lie in a masked pixel. seeds: by image name, (N, 2) px of the stored image, best first and
    exact; None looks for corners. Raises InputError on an undecodable photo.
    """
    px_scales = measure_px_scales(images, config)
    return tuple(
        Photo(
            image.name,
            image.size_wh,
            px_scales[image.name],
            find_seeds(prepare_image(image, config.images.long_edge_px)) if seeds is None else seeds[image.name],
            partial(masks.hides, image.name) if image.name in masks.packed else None,
            seeds_are_exact=seeds is not None,
        )
        for image in tqdm(images, desc="seeds", unit="image", disable=quiet)
    )


def make_refiner(
    matcher: PairMatcher, images: Sequence[ImageRef], config: Config, matches: MatchStore
) -> KeypointRefiner | None:
    """What refines the keypoints of a run, at no less than the matching resolution.

    None where the configuration does without, and for matchers that estimate no homographies.
    """
    if not isinstance(matcher, HomoMatcher) or not isinstance(matcher.net.head, HomographyHead):
        return None
    if not config.keypoints.refine_long_edge_px:
        return None
    long_edge_px = max(config.keypoints.refine_long_edge_px, config.images.long_edge_px)
    return KeypointRefiner(matcher.encoder, images, long_edge_px, matches, config.matching.feature_cache_mb)


def write_verified(
    path: Path,
    collection: Collection,
    config: Config,
    keypoints: Sequence[Keypoints],
    matches: Sequence[IndexMatches],
) -> None:
    """A new database, see write_database, with the two-view geometries of all its pairs, see correct_focal_lengths."""
    write_database(path, collection.images, collection.cameras, keypoints, matches)
    verify_database(path, config.verification, measure_px_scales(collection.images, config))
    if not collection.cameras.known:
        correct_focal_lengths(path)


def map_database(
    path: Path, collection: Collection, config: Config, label: str, quiet: bool = False
) -> tuple[pycolmap.Reconstruction, ...]:
    """The models of a verified database, largest first, also in the folder `sparse` beside it. label: of the bar."""
    with tqdm(total=len(collection.images), desc=label, unit="image", disable=quiet) as progress:
        task = MappingTask(
            path,
            collection.folder,
            path.with_name("sparse"),
            config.mapping,
            config.verification.max_error_px,
            measure_px_scales(collection.images, config),
            split_cameras=config.cameras.mode == "auto",
            on_image=progress.update,
        )
        return map_images(task, collection.images, collection.cameras)
