"""Persistent keypoints against LoFTR-style matches: same photos, pairs, network, verification and mapper.

Every method leaves its database and model in OUT/<method>, with RESULT_FILE once it has finished. Started again, a
comparison keeps the methods that finished with the same settings, and goes on from the matches that are there.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from tqdm import tqdm

from hm_sfm.colmap.cameras import Cameras, make_cameras
from hm_sfm.colmap.database import open_database, write_database
from hm_sfm.colmap.mapping import MappingTask, map_images, summarise_models
from hm_sfm.colmap.models import read_tracks
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import Config, fingerprint
from hm_sfm.errors import ConfigError, InputError, NoModelError
from hm_sfm.evaluation.loftr import LoftrMatcher
from hm_sfm.evaluation.loftr_style import make_keypoints
from hm_sfm.evaluation.poses import score_model
from hm_sfm.formats.hloc import read_features, read_matches
from hm_sfm.formats.pairs_files import write_pairs
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.locks import release_locks
from hm_sfm.keypoints.tracks import build_tracks, label_tracks
from hm_sfm.matching.masked_store import MaskedStore
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.providers.choice import check_coarse
from hm_sfm.matching.run import match_pairs
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.photos.images import list_images
from hm_sfm.photos.masks import NO_MASKS, Masks, read_masks
from hm_sfm.pipeline.reconstruction import (
    choose_pairs,
    claim_folder,
    describe_matching,
    measure_px_scales,
    reconstruct,
    stopwatch,
)
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, PinholeView, Tracks

CELLS_PX = (1, 2, 4, 8)
"""Cells that LoFTR-style matches are snapped to."""
AUC_SHOWN_DEG = (0.25, 0.5, 1, 3)
RESULT_FILE = "result.json"
SECONDS_FILE = "seconds.json"
HEAD_FIELDS = ("head", "window", "radius", "iterations", "margin", "spacing")
"""Of NetworkConfig: what networks with different heads may differ in."""


@dataclass(frozen=True, kw_only=True)
class MethodResult:
    """What became of one method. Figures are of its largest model, 0 where there is none."""

    name: str
    registered: int
    models: int
    matched_tracks: int
    """Tracks of the verified matches: what the mapper is given. It ignores those of two images."""
    mean_matched_track_length: float
    points: int
    points_in_3_images: int
    """Points that at least three distinct images see."""
    observations: int
    observations_per_image: float
    """Per registered image."""
    mean_track_length: float
    """In distinct images, as everywhere here."""
    median_track_length: float
    track_length_histogram: dict[int, int]
    """Track length -> number of points."""
    mean_reprojection_px: float
    auc_percent: dict[float, float] | None
    """Threshold in degrees -> pose AUC over all pairs of images; None without ground truth."""
    seconds: dict[str, float | None]
    """match, keypoints, verify, map; None where another program did it. Methods that share matches share `match`."""


@dataclass(frozen=True)
class Comparison:
    """The methods on one collection."""

    num_images: int
    skipped_images: int
    """Files that are named like images but cannot be used."""
    num_pairs: int
    methods: tuple[MethodResult, ...]
    config_fingerprint: str


@dataclass(frozen=True)
class Run:
    """What all methods share."""

    image_folder: Path
    out: Path
    config: Config
    quiet: bool
    images: tuple[ImageRef, ...]
    pairs: tuple[ImagePair, ...]
    cameras: Cameras
    digests: dict[str, str]
    """Image name -> digest of the photo."""
    truth: dict[str, PinholeView] | None
    masks: Masks = NO_MASKS


@dataclass(frozen=True)
class Matching:
    """Matches that one or several methods start from, in a folder of their own."""

    folder: Path
    matcher: HomoMatcher | LoftrMatcher
    store: MatchStore


@dataclass(frozen=True)
class Method:
    """One way from matches to a model."""

    name: str
    made_by: Any
    """What the result depends on beside what all methods share."""
    build: Callable[[], dict[str, float | None]]
    """Leaves the database and the models, if any, in OUT/name; returns the seconds of each stage."""


@release_locks()
def compare(
    image_folder: Path,
    out: Path,
    config: Config,
    *,
    expectation_model: str = "light_expectation",
    ground_truth: Path | None = None,
    loftr: Path | None = None,
    hloc: tuple[Path, Path] | None = None,
    quiet: bool = False,
) -> Comparison:
    """Reconstruct the photos by several methods, each into OUT/<method>, and measure them.

    `persistent` is what reconstruct does. `loftr_style_raw` and `loftr_style_<cell>px` are matches of the expectation
    head, weights `expectation_model`, see hm_sfm.evaluation.loftr_style. A checkpoint `loftr` adds the same of LoFTR's own
    matches, `loftr_raw` and `loftr_<cell>px`, and the files `hloc`, features.h5 and matches.h5, add `hloc`.
    ground_truth: a folder of <image name>.camera files, see read_strecha_cameras.

    Only persistence selects matches before the mapping stages, by two-view geometry and by `verification.min_score`.
    The others use all that their matcher gives, as LoFTR's users do: the score of the expectation head comes from the
    spread of its distribution, that of LoFTR from its coarse stage, and neither says how likely a match is wrong by a
    pixel. All databases are then verified and mapped in the same way.

    Raises InputError, ConfigError, WeightsError, MissingPackageError on unusable input and StaleResultError where OUT
    holds matches of other photos or settings, all before anything is computed.
    """
    listed = list_images(image_folder)
    names = [image.name for image in listed.images]
    pairs = choose_pairs(listed.images, out, config, quiet)
    check_coarse(config.matching, pairs)
    cameras = make_cameras(listed.images, config.cameras)
    masks = read_masks(listed.images, config.masks)
    truth = read_truth(ground_truth, names) if ground_truth else None
    matchers = {"persistent": (load_matcher(config), describe_matching(config))}
    matchers["loftr_style"] = load_expectation(expectation_model, config)
    if loftr:
        matcher = LoftrMatcher(loftr, config.matching, config.images)
        matchers["loftr"] = (matcher, matcher.made_by)

    out = Path(out)
    digests = {image.name: digest_image(image) for image in listed.images}
    run = Run(Path(image_folder), out, config, quiet, listed.images, pairs, cameras, digests, truth, masks)
    imported = import_hloc(run, *hloc) if hloc else None
    claim_folder(out)
    write_pairs(out / "pairs.txt", pairs)
    methods = []
    for name, (matcher, made_by) in matchers.items():
        claim_folder(out / name)
        matching = Matching(out / name, matcher, MatchStore(out / name / "matches.h5", made_by, digests))
        methods += [plan_persistent(run, matching)] if name == "persistent" else plan_loftr_style(run, matching)
    if imported:
        methods.append(imported)
    results = [finish_method(run, method) for method in tqdm(methods, desc="methods", unit="method", disable=quiet)]
    return Comparison(len(names), len(listed.skipped), len(pairs), tuple(results), fingerprint(config))


def read_truth(folder: Path, names: Sequence[str]) -> dict[str, PinholeView]:
    """The true cameras of the photos. Raises InputError where there are fewer than two."""
    truth = read_strecha_cameras(folder)
    known = {name: truth[name] for name in names if name in truth}
    if len(known) < 2:
        raise InputError(
            f"{folder} has the ground truth of {len(known)} of {len(names)} photos ({min(truth)!r}, but not "
            f"{names[0]!r}): at least 2 are needed"
        )
    return known


def load_matcher(config: Config) -> HomoMatcher:
    """The matcher of the configuration. Raises what HomoMatcher.from_pretrained raises."""
    return HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )


def load_expectation(model: str, config: Config) -> tuple[HomoMatcher, dict[str, object]]:
    """The matcher of the expectation head, and what its matches depend on.

    Raises WeightsError where the weights are unusable, ConfigError where they are of another head, or of other
    features than those of the configuration.
    """
    matcher = HomoMatcher.from_pretrained(model, config=config.matching, images=config.images)
    network = matcher.net.config
    if network.head != "expectation":
        raise ConfigError(f"model {model!r} has the head {network.head!r}: LoFTR-style matches need 'expectation'")
    for field in dataclasses.fields(network):
        found, expected = getattr(network, field.name), getattr(config.network, field.name)
        if field.name not in HEAD_FIELDS and found != expected:
            raise ConfigError(
                f"model {model!r} has network.{field.name} {found!r}, the configuration {expected!r}: the methods must "
                "share their features"
            )
    matching = dataclasses.replace(config.matching, model=model)
    return matcher, describe_matching(dataclasses.replace(config, network=network, matching=matching))


def plan_persistent(run: Run, matching: Matching) -> Method:
    """The method `persistent`."""

    def build() -> dict[str, float | None]:
        match = complete_matches(run, matching)
        try:
            reconstruct(run.image_folder, matching.folder, run.config, run.quiet)
        except NoModelError:
            pass  # a result like others
        spent = json.loads((matching.folder / "summary.json").read_text())["seconds"]
        return {"match": match, **{stage: spent[stage] for stage in ("keypoints", "verify", "map")}}

    return Method("persistent", [matching.store.made_by, run.config.keypoints], build)


def plan_loftr_style(run: Run, matching: Matching) -> list[Method]:
    """The methods that take the points of matches as they are, and snapped to each of CELLS_PX."""

    def plan(cell_px: int | None) -> Method:
        name = f"{matching.folder.name}_{f'{cell_px}px' if cell_px else 'raw'}"
        budget = run.config.keypoints.max_keypoints

        def build() -> dict[str, float | None]:
            seconds: dict[str, float | None] = {"match": complete_matches(run, matching)}
            with stopwatch(seconds, "keypoints"):
                px_scale = measure_px_scales(run.images, run.config)
                read = MaskedStore(matching.store, run.masks).read
                keypoints, matches = make_keypoints(run.images, run.pairs, read, px_scale, cell_px, budget)
            return map_keypoints(run, name, keypoints, matches, seconds)

        return Method(name, [matching.store.made_by, budget], build)

    return [plan(cell_px) for cell_px in (None, *CELLS_PX)]


def import_hloc(run: Run, features: Path, matches: Path) -> Method:
    """The method `hloc`: the keypoints and matches of two files. Raises InputError where they are unusable.

    Photos in no pair need not be in the files.
    """
    paired = {name for pair in run.pairs for name in (pair.name0, pair.name1)}
    found = read_features(features, [image for image in run.images if image.name in paired])
    keypoints_of = {keypoints.name: keypoints for keypoints in found}
    keypoints = [keypoints_of.get(i.name, Keypoints(i.name, np.zeros((0, 2)), [], [])) for i in run.images]
    index_matches = read_matches(matches, run.pairs, keypoints)

    def build() -> dict[str, float | None]:
        return map_keypoints(run, "hloc", keypoints, index_matches, {"match": None, "keypoints": None})

    return Method("hloc", [hashlib.sha256(path.read_bytes()).hexdigest() for path in (features, matches)], build)


def complete_matches(run: Run, matching: Matching) -> float:
    """Match the pairs that the store lacks. Returns the seconds that matching took in this run and earlier ones."""
    spent = matching.folder / SECONDS_FILE
    missing = [pair for pair in run.pairs if pair not in matching.store]
    if len(missing) == len(run.pairs):
        spent.unlink(missing_ok=True)
    if missing:
        with add_seconds(spent):
            match_pairs(run.images, run.pairs, matching.matcher, matching.store, run.quiet)
    return read_seconds(spent)


@contextmanager
def add_seconds(path: Path) -> Iterator[None]:
    """Add the seconds of the block to those in a file, also where the block is interrupted."""
    spent = {"match": read_seconds(path)}
    try:
        with stopwatch(spent, "match"):
            yield
    finally:
        with replace_file(path) as temporary:
            temporary.write_text(json.dumps(spent) + "\n")


def read_seconds(path: Path) -> float:
    """What add_seconds wrote, 0 where it never did."""
    return json.loads(path.read_text())["match"] if path.exists() else 0.0


def map_keypoints(
    run: Run, name: str, keypoints: Sequence[Keypoints], matches: Sequence[IndexMatches],
    seconds: dict[str, float | None],
) -> dict[str, float | None]:  # fmt: skip
    """Database, verification and mapping, as reconstruct does them, in OUT/name. Returns `seconds` with theirs."""
    database = run.out / name / "database.db"
    checks = run.config.verification
    with stopwatch(seconds, "verify"):
        write_database(database, run.images, run.cameras, keypoints, matches)
        verify_database(database, checks, max(measure_px_scales(run.images, run.config).values()))
    with (
        stopwatch(seconds, "map"),
        tqdm(total=len(run.images), desc=f"mapping {name}", unit="image", disable=run.quiet) as progress,
    ):
        task = MappingTask(
            database,
            run.image_folder,
            database.with_name("sparse"),
            run.config.mapping,
            checks.max_error_px,
            on_image=progress.update,
        )
        map_images(task, run.images, run.cameras)
    return seconds


def finish_method(run: Run, method: Method) -> MethodResult:
    """The figures of a method: of the model that an earlier run left, if it was made in the same way, or of a new one.

    Raises what the method raises.
    """
    folder = run.out / method.name
    config = run.config
    shared = [version("hm_sfm"), run.digests, list(map(str, run.pairs)), run.masks.digest()]
    # What files that the configuration only names have said.
    shared += [[camera.params.tolist() for camera in run.cameras.cameras], run.cameras.camera_index]
    shared += [[pose.matrix().tolist() for pose in run.cameras.cam_from_world]]
    shared += map(str, run.cameras.rigs)
    made_by = fingerprint(*shared, config.cameras, config.verification, config.mapping, method.made_by)
    finished = read_finished(folder, made_by)
    if finished is None:
        folder.mkdir(exist_ok=True)
        (folder / RESULT_FILE).unlink(missing_ok=True)
        seconds = {stage: spent if spent is None else round(spent, 2) for stage, spent in method.build().items()}
        # Opening the database changes the file: it is read once.
        matched = np.diff(read_matched_tracks(folder / "database.db").offsets)
        finished = {
            "made_by": made_by,
            "models": count_models(folder),
            "seconds": seconds,
            "matched_tracks": len(matched),
            "mean_matched_track_length": float(matched.mean()) if len(matched) else 0.0,
        }
        with replace_file(folder / RESULT_FILE) as temporary:
            temporary.write_text(json.dumps(finished, indent=2) + "\n")
    return measure_method(run, method.name, finished)


def read_finished(folder: Path, made_by: str) -> dict[str, Any] | None:
    """The content of RESULT_FILE; None where it is missing, unreadable, of other settings, or without its models."""
    try:
        finished = json.loads((folder / RESULT_FILE).read_text())
        same = (finished["made_by"], finished["models"]) == (made_by, count_models(folder))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return finished if same else None


def count_models(folder: Path) -> int:
    """Models in `folder`/sparse."""
    return len(list((folder / "sparse").glob("*/points3D.bin")))


def measure_method(run: Run, name: str, finished: Mapping[str, Any]) -> MethodResult:
    """The figures of OUT/name/sparse/0, all 0 where there are no models; `finished` is the content of RESULT_FILE."""
    models = finished["models"]
    model = pycolmap.Reconstruction(run.out / name / "sparse" / "0") if models else pycolmap.Reconstruction()
    figures = summarise_models((model,) if models else (), len(run.images))
    length = np.diff(read_tracks(model).offsets)
    score = score_model(model, run.truth) if run.truth else None
    return MethodResult(
        name=name,
        registered=figures.registered,
        models=models,
        matched_tracks=finished["matched_tracks"],
        mean_matched_track_length=finished["mean_matched_track_length"],
        points=figures.points,
        points_in_3_images=int(np.count_nonzero(length >= 3)),
        observations=figures.observations,
        observations_per_image=figures.observations / max(1, figures.registered),
        mean_track_length=figures.mean_track_length,
        median_track_length=float(np.median(length)) if len(length) else 0.0,
        track_length_histogram=dict(zip(*(column.tolist() for column in np.unique(length, return_counts=True)))),
        mean_reprojection_px=figures.mean_reprojection_px,
        auc_percent={limit: score.auc_percent[limit] for limit in AUC_SHOWN_DEG} if score else None,
        seconds=finished["seconds"],
    )


def read_matched_tracks(database_path: Path) -> Tracks:
    """The tracks of a database's verified matches; images are numbered in the order of their ids.

    Tracks that would hold two keypoints of one image are split. Raises InputError where there is no database.
    """
    with open_database(database_path) as database:
        image_ids = sorted(image.image_id for image in database.read_all_images())
        counts = np.array([database.num_keypoints_for_image(image_id) for image_id in image_ids], np.int64)
        pair_ids, geometries = database.read_two_view_geometries()
    first = dict(zip(image_ids, np.concatenate([[0], np.cumsum(counts)]).tolist()))
    links = [np.zeros((0, 2), np.int64)]
    for pair_id, geometry in zip(pair_ids, geometries):
        id0, id1 = pycolmap.pair_id_to_image_pair(pair_id)
        links.append(geometry.inlier_matches.astype(np.int64).reshape(-1, 2) + [first[id0], first[id1]])
    source, target = np.concatenate(links).T
    image = np.repeat(np.arange(len(image_ids)), counts)
    keypoint = np.arange(len(image)) - np.repeat(np.cumsum(counts) - counts, counts)
    label = label_tracks(len(image), source, target, np.ones(len(source)), image)
    return build_tracks(label, image, keypoint)
