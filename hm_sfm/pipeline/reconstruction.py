"""The whole chain: a folder of photos -> matches -> keypoints -> database -> models, with everything in one folder OUT.

Each function runs the chain up to its stage and picks up what an earlier run left in OUT.
"""

import logging
from functools import cache, partial
from pathlib import Path

from hm_sfm.colmap.mapping import summarise_models
from hm_sfm.config import Config
from hm_sfm.errors import NoModelError
from hm_sfm.formats.hloc import write_features, write_matches
from hm_sfm.formats.pairs_files import read_pairs, write_pairs
from hm_sfm.io.locks import release_locks
from hm_sfm.matching.shards import Shard, merge_shards, refuse_shards
from hm_sfm.photos.images import list_images
from hm_sfm.pipeline.collection import collect_photos, measure_px_scales
from hm_sfm.pipeline.output_folder import MATCHES_FILE, claim_folder, open_store
from hm_sfm.pipeline.run import Run, load_matcher
from hm_sfm.pipeline.summary import write_summary
from hm_sfm.pipeline.timings import Timings
from hm_sfm.report.diagnosis import diagnose
from hm_sfm.report.gather import gather_report
from hm_sfm.report.page import write_report
from hm_sfm.types import MappingResult

logger = logging.getLogger(__name__)


@release_locks()
def match_photos(image_folder: Path, out: Path, config: Config, quiet: bool = False, shard: Shard | None = None) -> Run:
    """Photos -> OUT/pairs.txt and OUT/matches.h5.

    shard: match only its part of the pairs, into a file of its own, see Shard.locate; the result has these pairs only.
    Shards of one OUT may be matched at the same time, and merge_matches gathers them.

    Raises InputError on unusable photos, pairs, or OUT, StaleResultError where OUT holds another run's matches,
    WeightsError and ConfigError on an unusable model or setting; nothing in OUT is lost then.
    """
    out, timings = Path(out), Timings()
    get_matcher = cache(partial(load_matcher, config))
    collection = collect_photos(image_folder, out, config, get_matcher, quiet, shared=shard is not None)
    claim_folder(out, shard is not None, Path(image_folder))
    if shard:
        shard.lock(out)
    else:
        refuse_shards(out)
    run = Run(collection, out, config, get_matcher(), timings=timings, quiet=quiet)
    if shard:
        shard.write_pairs(out, run.pairs)
        run = run.take(shard)
    else:
        write_pairs(out / "pairs.txt", run.pairs)
    run.match()
    return run


@release_locks()
def merge_matches(image_folder: Path, out: Path, config: Config) -> int:
    """Gather the shards of OUT in OUT/matches.h5 and remove them; returns the number of pairs, those of OUT/pairs.txt.

    Raises InputError where OUT has no pairs, is in use, or a shard is missing or unfinished, StaleResultError where one
    was made by other settings or of other photos; nothing is changed then.
    """
    out = Path(out)
    images = list_images(image_folder).images
    pairs = read_pairs(out / "pairs.txt", [image.name for image in images])
    claim_folder(out, photos=Path(image_folder))
    merge_shards(open_store(out / MATCHES_FILE, images, config), pairs, out)
    return len(pairs)


@release_locks()
def export_database(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Run:
    """As match_photos, then OUT/database.db with persistent keypoints and verified matches."""
    run = match_photos(image_folder, out, config, quiet)
    run.write_database(*run.make_keypoints(run.verify().pairs))
    return run


@release_locks()
def export_hloc(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> Run:
    """As match_photos, then OUT/hloc/features.h5 and OUT/hloc/matches.h5 with persistent keypoints, as hloc reads them.

    The pairs are those of OUT/pairs.txt. Raises InputError where image names differ in "/" and "-" only.
    """
    run = match_photos(image_folder, out, config, quiet)
    keypoints, matches = run.make_keypoints(run.verify().pairs)
    folder = run.out / "hloc"
    write_features(folder / "features.h5", run.images, keypoints, measure_px_scales(run.images, config))
    write_matches(folder / "matches.h5", run.pairs, keypoints, matches)
    return run


@release_locks()
def reconstruct(image_folder: Path, out: Path, config: Config, quiet: bool = False) -> MappingResult:
    """As export_database, then OUT/sparse, OUT/summary.json and OUT/report.html.

    What kept images out of the model is logged as warnings, too. Raises NoModelError where the mapper builds no model;
    database, matches, summary.json and report.html are kept.
    """
    return build_model(match_photos(image_folder, out, config, quiet))


def build_model(run: Run) -> MappingResult:
    """What reconstruct does after its pairs are matched. Raises NoModelError as reconstruct does."""
    judgement = run.verify()
    database = run.write_database(*run.make_keypoints(judgement.pairs))
    models = run.map()
    result = summarise_models(models, len(run.images))
    diagnoses = diagnose(run.images, run.collection.cameras, run.pairs, run.read, database, models, run.config)
    write_summary(run, result, judgement, diagnoses)
    report = gather_report(run.out, run.images, len(run.pairs), models, judgement, run.read, diagnoses, run.config)
    write_report(run.out / "report.html", report)
    for diagnosis in diagnoses:
        logger.warning("%s", diagnosis)
    if not models:
        earlier = run.out / "sparse" / "0"
        also = f", and so is the model of an earlier run, {earlier}" if earlier.is_dir() else ""
        raise NoModelError(
            f"no model could be built from {len(run.images)} images; matches and database are kept in {run.out}{also}"
        )
    return result
