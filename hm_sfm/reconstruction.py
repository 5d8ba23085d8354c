"""The whole chain: a folder of photos -> matches -> keypoints -> database -> models, with everything in one folder OUT.

Each function runs the chain up to its stage and picks up what an earlier run left in OUT.
"""

import dataclasses
import json
import time
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tqdm import tqdm

from hm_sfm.atomic import replace_file
from hm_sfm.config import Config, fingerprint
from hm_sfm.database import Cameras, make_cameras, write_database
from hm_sfm.errors import InputError, NoModelError
from hm_sfm.hloc import write_features, write_matches
from hm_sfm.images import list_images, prepare_image
from hm_sfm.keypoints import Photo, find_seeds, persist_keypoints
from hm_sfm.mapping import VerifiedPair, map_incrementally, summarise_models, verify_database, verify_pairs
from hm_sfm.matching import match_pairs
from hm_sfm.network.model import HomoMatcher, digest_weights
from hm_sfm.pairs import select_pairs, write_pairs
from hm_sfm.store import MatchStore, digest_image
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, MappingResult

MARKER = ".hm_sfm"
"""File by which a folder is known as the output of a run."""


@dataclass(frozen=True)
class Matched:
    """A run that has come as far as its matches."""

    images: tuple[ImageRef, ...]
    skipped: int
    """Files that are named like images but cannot be used."""
    pairs: tuple[ImagePair, ...]
    cameras: Cameras
    store: MatchStore
    seconds: dict[str, float]


def match_photos(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Matched:
    """Photos -> OUT/pairs.txt and OUT/matches.h5.

    Raises InputError on unusable photos, pairs, or OUT, StaleResultError where OUT holds another run's matches,
    WeightsError and ConfigError on an unusable model or setting; nothing in OUT is lost then.
    """
    out = Path(out)
    listed = list_images(image_folder)
    images = listed.images
    pairs = select_pairs([image.name for image in images], config.pairs)
    cameras = make_cameras(images, config.cameras)
    claim_folder(out)
    matcher = HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )
    store = open_store(out / "matches.h5", images, config)
    write_pairs(out / "pairs.txt", pairs)
    times = match_pairs(images, pairs, matcher, store, quiet)
    return Matched(images, len(listed.skipped), pairs, cameras, store, dataclasses.asdict(times))


def export_database(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Matched:
    """As match_photos, then OUT/database.db with persistent keypoints and verified matches."""
    matched = match_photos(image_folder, out, config, quiet)
    keypoints, matches = verify_and_carry(matched, config, quiet)
    with stopwatch(matched.seconds, "verify"):
        database = Path(out) / "database.db"
        write_database(database, matched.images, matched.cameras, keypoints, matches)
        verify_database(
            database,
            config.verification.max_error_px * max(measure_units(matched.images, config).values()),
            config.verification.min_inliers,
            config.verification.min_inlier_ratio,
        )
    return matched


def export_hloc(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Matched:
    """As match_photos, then OUT/hloc/features.h5 and OUT/hloc/matches.h5 with persistent keypoints, as hloc reads them.

    The pairs are those of OUT/pairs.txt. Raises InputError where image names differ in "/" and "-" only.
    """
    matched = match_photos(image_folder, out, config, quiet)
    keypoints, matches = verify_and_carry(matched, config, quiet)
    folder = Path(out) / "hloc"
    write_features(folder / "features.h5", matched.images, keypoints, measure_units(matched.images, config))
    write_matches(folder / "matches.h5", matched.pairs, keypoints, matches)
    return matched


def verify_and_carry(
    matched: Matched, config: Config, quiet: bool = False
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Persistent keypoints from matches: verify_pairs, then carry_keypoints; adds to the seconds of `matched`."""
    images = matched.images
    cameras = {image.name: matched.cameras.cameras[i] for image, i in zip(images, matched.cameras.camera_index)}
    with stopwatch(matched.seconds, "verify"):
        verified = verify_pairs(
            images,
            matched.pairs,
            matched.store.read,
            cameras,
            measure_units(images, config),
            config.verification,
            quiet,
        )
    with stopwatch(matched.seconds, "keypoints"):
        return carry_keypoints(images, verified, matched.store, config, quiet)


def reconstruct(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> MappingResult:
    """As export_database, then OUT/sparse and OUT/summary.json.

    Raises NoModelError where the mapper finds no model; database, matches and summary.json are kept.
    """
    started = time.monotonic()
    matched = export_database(image_folder, out, config, quiet)
    out = Path(out)
    with (
        stopwatch(matched.seconds, "map"),
        tqdm(total=len(matched.images), desc="mapping", unit="image", disable=quiet) as progress,
    ):
        models = map_incrementally(
            out / "database.db",
            Path(image_folder),
            out / "sparse",
            config.mapping,
            fix_intrinsics=bool(config.cameras.params),
            on_image=progress.update,
        )
    result = summarise_models(models, len(matched.images))
    matched.seconds["total"] = time.monotonic() - started
    write_summary(out / "summary.json", result, matched, config)
    if not models:
        raise NoModelError(
            f"no model could be built from {len(matched.images)} images; matches and database are kept in {out}"
        )
    return result


def claim_folder(out: Path) -> None:
    """Make OUT, or check that it is empty or an earlier run's. Raises InputError where it is not, or not writable."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        foreign = any(out.iterdir()) and not (out / MARKER).exists()
        if not foreign:
            (out / MARKER).touch()
    except OSError as error:
        raise InputError(f"cannot write to the output folder {out}: {error.strerror}") from error
    if foreign:
        raise InputError(f"the output folder {out} is not empty and holds no run of hm_sfm: name a new one")


def describe_matching(config: Config) -> dict[str, object]:
    """Every setting that the stored matches depend on, by name."""
    described: dict[str, object] = {"weights": digest_weights(config.matching.model)}
    for section in ("network", "images", "matching"):
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            if (section, key) not in {("matching", "device"), ("matching", "feature_cache_mb"), ("matching", "model")}:
                described[f"{section}.{key}"] = value
    return described


def open_store(path: Path, images: Sequence[ImageRef], config: Config) -> MatchStore:
    """The matches of a run, for these photos and settings. Raises what MatchStore raises."""
    return MatchStore(path, describe_matching(config), {image.name: digest_image(image) for image in images})


def measure_units(images: Sequence[ImageRef], config: Config) -> dict[str, float]:
    """Image name -> px of the stored image per px of the matching resolution."""
    return {image.name: max(1.0, max(image.size_wh) / config.images.long_edge_px) for image in images}


def carry_keypoints(
    images: Sequence[ImageRef],
    verified: Mapping[ImagePair, VerifiedPair],
    store: MatchStore,
    config: Config,
    quiet: bool = False,
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """persist_keypoints over the verified pairs, strongest first. Raises InputError on an undecodable photo.

    Returns the Keypoints of every image, in the order of `images`, and the IndexMatches of the pairs that share tracks.
    """
    px_per_unit = measure_units(images, config)
    photos = [
        Photo(
            image.name,
            image.size_wh,
            px_per_unit[image.name],
            find_seeds(prepare_image(image, config.images.long_edge_px)),
        )
        for image in tqdm(images, desc="seeds", unit="image", disable=quiet)
    ]
    ranked = sorted(verified.values(), key=lambda found: (-found.strength, found.pair))
    return persist_keypoints(
        photos,
        [found.pair for found in ranked],
        lambda pair: store.read(pair).select(verified[pair].inliers),
        config.keypoints,
        quiet,
    )


def write_summary(path: Path, result: MappingResult, matched: Matched, config: Config) -> None:
    """OUT/summary.json, atomically."""
    figures = {
        "num_images": result.num_images,
        "skipped_images": matched.skipped,
        "registered": result.registered,
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
