"""Persistent keypoints against LoFTR-style matches: same photos, pairs, network, verification and mapper.

Every method leaves its database and model in OUT/<method>, with a result file once it has finished. Started again, a
comparison keeps the methods that finished with the same settings, and goes on from the matches that are there.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from hm_sfm.config import Config, fingerprint
from hm_sfm.errors import ConfigError, InputError, NoModelError
from hm_sfm.evaluation.compared_methods import ComparisonTask, Method, MethodResult, finish_method
from hm_sfm.evaluation.loftr import LoftrMatcher
from hm_sfm.evaluation.loftr_style import make_keypoints
from hm_sfm.formats.hloc import read_features, read_matches
from hm_sfm.formats.pairs_files import write_pairs
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.locks import release_locks
from hm_sfm.matching.interfaces import PairMatcher
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.network.checkpoints import find_weights
from hm_sfm.pipeline.collection import collect_photos, measure_px_scales
from hm_sfm.pipeline.output_folder import MATCHES_FILE, claim_folder, describe_matching
from hm_sfm.pipeline.reconstruction import build_model
from hm_sfm.pipeline.run import Run, load_matcher, map_database, write_verified
from hm_sfm.pipeline.timings import Timings
from hm_sfm.types import IndexMatches, Keypoints, PinholeView

CELLS_PX = (1, 2, 4, 8)
"""Cells that LoFTR-style matches are snapped to."""
SECONDS_FILE = "seconds.json"
HEAD_FIELDS = ("head", "window", "radius", "iterations", "margin", "spacing")
"""Of NetworkConfig: what networks with different heads may differ in."""


@dataclass(frozen=True)
class Comparison:
    """The methods on one collection."""

    num_images: int
    skipped_images: int
    """Files that are named like images but cannot be used."""
    num_pairs: int
    methods: tuple[MethodResult, ...]
    config_fingerprint: str


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
    head, weights `expectation_model`, see hm_sfm.evaluation.loftr_style. A checkpoint `loftr` adds the same of LoFTR's
    own matches, `loftr_raw` and `loftr_<cell>px`, and the files `hloc`, features.h5 and matches.h5, add `hloc`.
    ground_truth: a folder of <image name>.camera files, see read_strecha_cameras.

    Only persistence selects matches before the mapping stages, by two-view geometry and by `verification.min_score`.
    The others use all that their matcher gives, as LoFTR's users do: the score of the expectation head comes from the
    spread of its distribution, that of LoFTR from its coarse stage, and neither says how likely a match is wrong by a
    pixel. All databases are then verified and mapped in the same way.

    Raises InputError, ConfigError, WeightsError, MissingPackageError on unusable input and StaleResultError where OUT
    holds matches of other photos or settings, all before anything is computed.
    """
    out = Path(out)
    get_matcher = cache(partial(load_matcher, config))
    collection = collect_photos(image_folder, out, config, get_matcher, quiet)
    names = [image.name for image in collection.images]
    cameras = read_ground_truth(ground_truth, names) if ground_truth else None
    matchers: dict[str, tuple[PairMatcher, dict[str, object]]] = {
        "persistent": (get_matcher(), describe_matching(config)),
        "loftr_style": load_expectation(expectation_model, config),
    }
    if loftr:
        matcher = LoftrMatcher(loftr, config.matching, config.images)
        matchers["loftr"] = (matcher, matcher.made_by)

    digests = {image.name: digest_image(image) for image in collection.images}
    task = ComparisonTask(collection, out, config, digests, cameras, quiet)
    imported = [import_hloc(task, *hloc)] if hloc else []
    claim_folder(out, photos=Path(image_folder))
    write_pairs(out / "pairs.txt", collection.pairs)
    methods: list[Method] = []
    for name, (matcher, made_by) in matchers.items():
        claim_folder(out / name)
        store = MatchStore(out / name / MATCHES_FILE, made_by, digests)
        run = Run(collection, out / name, config, matcher, store=store, quiet=quiet)
        methods += [plan_persistent(run)] if name == "persistent" else plan_loftr_style(task, run)
    methods += imported
    results = [finish_method(task, method) for method in tqdm(methods, desc="methods", unit="method", disable=quiet)]
    return Comparison(len(names), collection.skipped, len(collection.pairs), tuple(results), fingerprint(config))


def read_ground_truth(folder: Path, names: Sequence[str]) -> dict[str, PinholeView]:
    """The true cameras of the photos. Raises InputError where there are fewer than two."""
    cameras = read_strecha_cameras(folder)
    known = {name: cameras[name] for name in names if name in cameras}
    if len(known) < 2:
        raise InputError(
            f"{folder} has the ground truth of {len(known)} of {len(names)} photos ({min(cameras)!r}, but not "
            f"{names[0]!r}): at least 2 are needed"
        )
    return known


def load_expectation(model: str, config: Config) -> tuple[HomoMatcher, dict[str, object]]:
    """The matcher of the expectation head, and what its matches depend on.

    Where the configuration's network has context, its coarse matches are taken: the heads share them. Raises
    WeightsError where the weights are unusable, ConfigError where they are of another head, or of other features than
    those of the configuration.
    """
    matching = dataclasses.replace(config.matching, model=model)
    shares_context = config.network.coarse == "context" and matching.coarse == "light" and not matching.coarse_matches
    if shares_context:
        matching = dataclasses.replace(matching, coarse=str(find_weights(config.matching.model)))
    matcher = HomoMatcher.from_pretrained(model, config=matching, images=config.images)
    network = matcher.net.config
    if network.head != "expectation":
        raise ConfigError(f"model {model!r} has the head {network.head!r}: LoFTR-style matches need 'expectation'")
    for field in dataclasses.fields(network):
        actual, expected = getattr(network, field.name), getattr(config.network, field.name)
        if field.name not in HEAD_FIELDS and actual != expected and not (field.name == "coarse" and shares_context):
            raise ConfigError(
                f"model {model!r} has network.{field.name} {actual!r}, the configuration {expected!r}: the methods "
                "must share their features"
            )
    return matcher, describe_matching(dataclasses.replace(config, network=network, matching=matching))


def plan_persistent(run: Run) -> Method:
    """The method `persistent`."""

    def build() -> dict[str, float | None]:
        match = complete_matches(run)
        write_pairs(run.out / "pairs.txt", run.pairs)
        with suppress(NoModelError):  # a result like others
            build_model(run)
        spent = run.timings.seconds
        verify = spent["verify"] + spent.get("judge", 0.0)
        return {"match": match, "keypoints": spent["keypoints"], "verify": verify, "map": spent["map"]}

    return Method("persistent", [run.store.made_by, run.config.keypoints], build)


def plan_loftr_style(task: ComparisonTask, run: Run) -> list[Method]:
    """The methods that take the points of matches as they are, and snapped to each of CELLS_PX.

    run: matches the pairs; its folder has the name that those of the methods begin with.
    """
    max_keypoints = task.config.keypoints.max_keypoints

    def plan(cell_px: int | None) -> Method:
        name = f"{run.out.name}_{f'{cell_px}px' if cell_px else 'raw'}"

        def build() -> dict[str, float | None]:
            match, timings = complete_matches(run), Timings()
            with timings.measure("keypoints"):
                px_scales = measure_px_scales(run.images, task.config)
                keypoints, matches = make_keypoints(run.images, run.pairs, run.read, px_scales, cell_px, max_keypoints)
            return {"match": match, **timings.seconds, **map_keypoints(task, name, keypoints, matches)}

        return Method(name, [run.store.made_by, max_keypoints], build)

    return [plan(cell_px) for cell_px in (None, *CELLS_PX)]


def import_hloc(task: ComparisonTask, features: Path, matches: Path) -> Method:
    """The method `hloc`: the keypoints and matches of two files. Raises InputError where they are unusable.

    Photos in no pair need not be in the files.
    """
    images, pairs = task.collection.images, task.collection.pairs
    paired = {name for pair in pairs for name in (pair.name0, pair.name1)}
    stored = read_features(features, [image for image in images if image.name in paired])
    keypoints_of = {keypoints.name: keypoints for keypoints in stored}
    keypoints = [
        keypoints_of.get(i.name, Keypoints(i.name, np.zeros((0, 2)), np.zeros(0), np.zeros(0))) for i in images
    ]
    index_matches = read_matches(matches, pairs, keypoints)

    def build() -> dict[str, float | None]:
        return {"match": None, "keypoints": None, **map_keypoints(task, "hloc", keypoints, index_matches)}

    return Method("hloc", [hashlib.sha256(path.read_bytes()).hexdigest() for path in (features, matches)], build)


def complete_matches(run: Run) -> float:
    """Match the pairs that the store lacks. Returns the seconds that matching took in this run and earlier ones."""
    spent = run.out / SECONDS_FILE
    missing = [pair for pair in run.pairs if pair not in run.store]
    if len(missing) == len(run.pairs):
        spent.unlink(missing_ok=True)
    if missing:
        with add_seconds(spent):
            run.match()
    return read_seconds(spent)


@contextmanager
def add_seconds(path: Path) -> Iterator[None]:
    """Add the seconds of the block to those in a file, also where the block is interrupted."""
    timings = Timings()
    timings.add({"match": read_seconds(path)})
    try:
        with timings.measure("match"):
            yield
    finally:
        with replace_file(path) as temporary:
            temporary.write_text(json.dumps(timings.seconds) + "\n")


def read_seconds(path: Path) -> float:
    """What add_seconds wrote, 0 where it never did."""
    return json.loads(path.read_text())["match"] if path.exists() else 0.0


def map_keypoints(
    task: ComparisonTask, name: str, keypoints: Sequence[Keypoints], matches: Sequence[IndexMatches]
) -> dict[str, float]:
    """Database, verification and mapping, as reconstruct does them, in OUT/name. Returns the seconds of each stage."""
    database, timings = task.out / name / "database.db", Timings()
    with timings.measure("verify"):
        write_verified(database, task.collection, task.config, keypoints, matches)
    with timings.measure("map"):
        map_database(database, task.collection, task.config, f"mapping {name}", task.quiet)
    return timings.seconds
