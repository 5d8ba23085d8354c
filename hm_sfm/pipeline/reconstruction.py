"""The whole chain: a folder of photos -> matches -> keypoints -> database -> models, with everything in one folder OUT.

Each function runs the chain up to its stage and picks up what an earlier run left in OUT.
"""

import dataclasses
import json
import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
from tqdm import tqdm

from hm_sfm.colmap.cameras import Cameras, make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_images, summarise_models
from hm_sfm.colmap.rigs import expand_pairs, read_rigs
from hm_sfm.colmap.verification import VerifiedPair, verify_database, verify_pairs
from hm_sfm.config import Config, fingerprint
from hm_sfm.errors import InputError, NoModelError
from hm_sfm.formats.hloc import write_features, write_matches
from hm_sfm.formats.pairs_files import read_pairs, write_pairs
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.locks import lock_file, release_locks, wait_in_line
from hm_sfm.keypoints.graph import Photo
from hm_sfm.keypoints.persistence import persist_keypoints
from hm_sfm.keypoints.refinement import KeypointRefiner
from hm_sfm.keypoints.seeds import find_seeds
from hm_sfm.matching.masked_store import MaskedStore
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.providers.choice import check_coarse, describe_coarse
from hm_sfm.matching.run import check_engine, match_pairs
from hm_sfm.matching.shards import Shard, merge_shards, refuse_shards
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.network.checkpoints import digest_weights
from hm_sfm.pairs.retrieval import CellStore, describe_images, find_similar
from hm_sfm.pairs.selection import select_pairs
from hm_sfm.photos.images import list_images, prepare_image
from hm_sfm.photos.masks import NO_MASKS, Masks, read_masks
from hm_sfm.report.diagnosis import Diagnosis, diagnose
from hm_sfm.report.gather import gather_report
from hm_sfm.report.page import write_report
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, MappingResult

logger = logging.getLogger(__name__)

MARKER = ".hm_sfm"
"""File by which a folder is known as the output of a run."""
UNDESCRIBED = {
    ("matching", key)
    for key in ("device", "feature_cache_mb", "model", "engine", "coarse", "coarse_matches", "coarse_features")
}
"""Settings that the matches do not depend on, and those that are described by what their names stand for."""


@dataclass(frozen=True)
class Matched:
    """A run that has come as far as its matches."""

    images: tuple[ImageRef, ...]
    skipped: int
    """Files that are named like images but cannot be used."""
    pairs: tuple[ImagePair, ...]
    cameras: Cameras
    store: MaskedStore
    """Reads the matches that are not masked."""
    seconds: dict[str, float]


@release_locks()
def match_photos(
    image_folder: Path, out: Path, config: Config, quiet: bool = False, shard: Shard | None = None
) -> Matched:
    """Photos -> OUT/pairs.txt and OUT/matches.h5.

    shard: match only its part of the pairs, into a file of its own, see Shard.locate; the result has these pairs only.
    Shards of one OUT may be matched at the same time, and merge_matches gathers them.

    Raises InputError on unusable photos, pairs, or OUT, StaleResultError where OUT holds another run's matches,
    WeightsError and ConfigError on an unusable model or setting; nothing in OUT is lost then.
    """
    out = Path(out)
    listed = list_images(image_folder)
    images = listed.images
    check_engine(config.matching.engine)
    pairs = choose_pairs(images, out, config, quiet, shared=shard is not None)
    check_coarse(config.matching, pairs)
    cameras = make_cameras(images, config.cameras)
    masks = read_masks(images, config.masks)  # all bad input is found before anything is computed
    claim_folder(out, shared=shard is not None)
    if shard:
        shard.lock(out)
    else:
        refuse_shards(out)
    matcher = HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )
    store = open_store(out / "matches.h5", images, config)
    if shard:
        shard.write_pairs(out, pairs)
        pairs = tuple(pair for pair in shard.take(pairs) if pair not in store)
        store = MatchStore(shard.locate(out), store.made_by, store.digests)
    else:
        write_pairs(out / "pairs.txt", pairs)
    times = match_pairs(images, pairs, matcher, store, quiet)
    seconds = dataclasses.asdict(times)
    return Matched(images, len(listed.skipped), pairs, cameras, MaskedStore(store, masks), seconds)


@release_locks()
def merge_matches(image_folder: Path, out: Path, config: Config) -> int:
    """Gather the shards of OUT in OUT/matches.h5 and remove them; returns the number of pairs, those of OUT/pairs.txt.

    Raises InputError where OUT has no pairs, is in use, or a shard is missing or unfinished, StaleResultError where one
    was made by other settings or of other photos; nothing is changed then.
    """
    out = Path(out)
    images = list_images(image_folder).images
    pairs = read_pairs(out / "pairs.txt", [image.name for image in images])
    claim_folder(out)
    merge_shards(open_store(out / "matches.h5", images, config), pairs, out)
    return len(pairs)


@release_locks()
def export_database(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Matched:
    """As match_photos, then OUT/database.db with persistent keypoints and verified matches."""
    matched = match_photos(image_folder, out, config, quiet)
    keypoints, matches = verify_and_propagate(matched, config, quiet)
    write_verified(matched, keypoints, matches, Path(out) / "database.db", config)
    return matched


def write_verified(
    matched: Matched, keypoints: Sequence[Keypoints], matches: Sequence[IndexMatches], path: Path, config: Config
) -> None:
    """write_database, then the two-view geometries of all its pairs; adds to the seconds of `matched`."""
    with stopwatch(matched.seconds, "verify"):
        write_database(path, matched.images, matched.cameras, keypoints, matches)
        verify_database(path, config.verification, max(measure_px_scales(matched.images, config).values()))


@release_locks()
def export_hloc(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Matched:
    """As match_photos, then OUT/hloc/features.h5 and OUT/hloc/matches.h5 with persistent keypoints, as hloc reads them.

    The pairs are those of OUT/pairs.txt. Raises InputError where image names differ in "/" and "-" only.
    """
    matched = match_photos(image_folder, out, config, quiet)
    keypoints, matches = verify_and_propagate(matched, config, quiet)
    folder = Path(out) / "hloc"
    write_features(folder / "features.h5", matched.images, keypoints, measure_px_scales(matched.images, config))
    write_matches(folder / "matches.h5", matched.pairs, keypoints, matches)
    return matched


def verify_and_propagate(
    matched: Matched, config: Config, quiet: bool = False, seeds: Mapping[str, np.ndarray] | None = None
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Persistent keypoints from matches: verify_pairs, then persist_verified; adds to the seconds of `matched`.

    seeds: as in persist_verified.
    """
    images = matched.images
    cameras = {image.name: matched.cameras.cameras[i] for image, i in zip(images, matched.cameras.camera_index)}
    with stopwatch(matched.seconds, "verify"):
        verified = verify_pairs(
            images,
            matched.pairs,
            matched.store.read,
            cameras,
            measure_px_scales(images, config),
            config.verification,
            quiet,
        )
    with stopwatch(matched.seconds, "keypoints"):
        return persist_verified(images, verified, matched.store, config, quiet, matched.store.masks, seeds)


@release_locks()
def reconstruct(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> MappingResult:
    """As export_database, then OUT/sparse, OUT/summary.json and OUT/report.html.

    What kept images out of the model is logged as warnings, too. Raises NoModelError where the mapper finds no model;
    database, matches, summary.json and report.html are kept.
    """
    started = time.monotonic()
    matched = export_database(image_folder, out, config, quiet)
    out = Path(out)
    with (
        stopwatch(matched.seconds, "map"),
        tqdm(total=len(matched.images), desc="mapping", unit="image", disable=quiet) as progress,
    ):
        task = MappingTask(
            out / "database.db",
            Path(image_folder),
            out / "sparse",
            config.mapping,
            config.verification.max_error_px,
            on_image=progress.update,
        )
        models = map_images(task, matched.images, matched.cameras)
    result = summarise_models(models, len(matched.images))
    matched.seconds["total"] = time.monotonic() - started
    diagnoses = diagnose(
        matched.images, matched.cameras, matched.pairs, matched.store.read, out / "database.db", models, config
    )
    write_summary(out / "summary.json", Path(image_folder), result, diagnoses, matched, config)
    report = gather_report(out, matched.images, len(matched.pairs), models, diagnoses, config)
    write_report(out / "report.html", report)
    for diagnosis in diagnoses:
        logger.warning("%s", diagnosis)
    if not models:
        raise NoModelError(
            f"no model could be built from {len(matched.images)} images; matches and database are kept in {out}"
        )
    return result


def choose_pairs(
    images: Sequence[ImageRef], out: Path, config: Config, quiet: bool = False, shared: bool = False
) -> tuple[ImagePair, ...]:
    """select_pairs for these photos. Where it must know which look alike, OUT is claimed and they are encoded into it.

    Of a sequence that rigs took, the photos of all their cameras are paired, see expand_pairs. shared: OUT, as in
    claim_folder. Raises what select_pairs, claim_folder, HomoMatcher.from_pretrained, read_rigs and expand_pairs raise,
    and InputError on an undecodable photo; those encoded by then stay encoded.
    """
    image_of = {image.name: image for image in images}

    def rank_by_appearance(names: Sequence[str], top: int, gap: int) -> np.ndarray:
        claim_folder(Path(out), shared)
        matcher = HomoMatcher.from_pretrained(
            config.matching.model, config=config.matching, images=config.images, network=config.network
        )
        photos = [image_of[name] for name in names]
        digests = {image.name: digest_image(image) for image in photos}
        folder = Path(out) / "retrieval"
        with wait_in_line(folder / ".lock"):  # other shards find the photos encoded
            store = CellStore(folder, digest_weights(config.matching.model))
            turned = config.matching.try_hypotheses
            return find_similar(
                describe_images(photos, digests, matcher.encoder.encode_plain, store, quiet, turned), top, gap
            )

    positions = {image.name: image.gps for image in images if image.gps}
    names = [image.name for image in images]
    pairs = select_pairs(names, config.pairs, rank_by_appearance, positions)
    if config.cameras.rig and config.pairs.mode == "sequential":  # each camera of a rig is a sequence for itself
        pairs = expand_pairs(pairs, read_rigs(Path(config.cameras.rig)), names, Path(config.cameras.rig))
    return pairs


def claim_folder(out: Path, shared: bool = False) -> None:
    """Make OUT, or check that it is empty or an earlier run's, and lock it, see hm_sfm.io.locks.

    shared: with other processes that share it. Raises InputError where OUT is somebody else's, not writable, or in use.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        foreign = any(out.iterdir()) and not (out / MARKER).exists()
        if not foreign:
            (out / MARKER).touch()
            in_use = f"the output folder {out} is in use by another hm-sfm process: wait for it, or name another OUT"
            lock_file(out / MARKER, in_use, shared)
    except OSError as error:
        raise InputError(f"cannot write to the output folder {out}: {error.strerror}") from error
    if foreign:
        raise InputError(f"the output folder {out} is not empty and holds no run of hm_sfm: name a new one")


def describe_matching(config: Config) -> dict[str, object]:
    """Every setting that the stored matches depend on, by name."""
    described: dict[str, object] = {"weights": digest_weights(config.matching.model)}
    for section in ("network", "images", "matching"):
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            if (section, key) not in UNDESCRIBED:
                described[f"{section}.{key}"] = value
    return described | describe_coarse(config.matching)


def open_store(path: Path, images: Sequence[ImageRef], config: Config) -> MatchStore:
    """The matches of a run, for these photos and settings. Raises what MatchStore raises."""
    return MatchStore(path, describe_matching(config), {image.name: digest_image(image) for image in images})


def measure_px_scales(images: Sequence[ImageRef], config: Config) -> dict[str, float]:
    """Image name -> px of the stored image per px of the matching resolution."""
    return {image.name: max(1.0, max(image.size_wh) / config.images.long_edge_px) for image in images}


def persist_verified(
    images: Sequence[ImageRef],
    verified: Mapping[ImagePair, VerifiedPair],
    store: MatchStore | MaskedStore,
    config: Config,
    quiet: bool = False,
    masks: Masks = NO_MASKS,
    seeds: Mapping[str, np.ndarray] | None = None,
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """persist_keypoints over the verified pairs, strongest first. Raises InputError on an undecodable photo.

    store: what the pairs were verified with. masks: no keypoint lies in a masked pixel. seeds: by image name, (N, 2) px
    of the stored image, best first, the points that keypoints may start at, exact ones; None finds some in the photos.

    Returns the Keypoints of every image, in the order of `images`, and the IndexMatches of the pairs that share tracks.
    """
    px_scale = measure_px_scales(images, config)
    photos = [
        Photo(
            image.name,
            image.size_wh,
            px_scale[image.name],
            find_seeds(prepare_image(image, config.images.long_edge_px)) if seeds is None else seeds[image.name],
            partial(masks.hides, image.name) if image.name in masks.packed else None,
            seeds_are_exact=seeds is not None,
        )
        for image in tqdm(images, desc="seeds", unit="image", disable=quiet)
    ]
    ranked = sorted(verified.values(), key=lambda found: (-found.strength, found.pair))
    unmasked = store.store if isinstance(store, MaskedStore) else store
    return persist_keypoints(
        photos,
        [found.pair for found in ranked],
        lambda pair: store.read(pair).select(verified[pair].inliers),
        config.keypoints,
        make_refiner(images, unmasked, config),
        quiet,
    )


def make_refiner(images: Sequence[ImageRef], store: MatchStore, config: Config) -> KeypointRefiner | None:
    """What refines keypoints, where the configuration and the network can."""
    if not config.keypoints.refine_long_edge_px or config.network.head != "homography":
        return None
    # The coarse matches are made already, whoever made them.
    matching = dataclasses.replace(config.matching, coarse="light", coarse_matches="", coarse_features="")
    matcher = HomoMatcher.from_pretrained(matching.model, config=matching, images=config.images, network=config.network)
    return KeypointRefiner(
        matcher, images, max(config.keypoints.refine_long_edge_px, config.images.long_edge_px), store
    )


def write_summary(
    path: Path,
    image_folder: Path,
    result: MappingResult,
    diagnoses: Sequence[Diagnosis],
    matched: Matched,
    config: Config,
) -> None:
    """OUT/summary.json, atomically."""
    figures = {
        "image_folder": str(image_folder.resolve()),
        "num_images": result.num_images,
        "skipped_images": matched.skipped,
        "registered": result.registered,
        "unregistered": {
            name: f"{found.cause.value}: {reason}" for found in diagnoses for name, reason in found.reasons.items()
        },
        "models": len(result.models),
        "points": result.points,
        "observations": result.observations,
        "mean_track_length": round(result.mean_track_length, 4),
        "mean_reprojection_px": round(result.mean_reprojection_px, 4),
        "seconds": {stage: round(spent, 2) for stage, spent in matched.seconds.items()},
        "version": version("hm_sfm"),
        "config_fingerprint": fingerprint(config),
    }
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(figures, indent=2) + "\n")


@contextmanager
def stopwatch(seconds: dict[str, float], stage: str):
    """Add the time of the block to seconds[stage]."""
    started = time.monotonic()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.monotonic() - started
