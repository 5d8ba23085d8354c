"""Track lengths of the same photos with persistent keypoints, and with LoFTR-style matches.

    python pipelines/examples/compare_tracks.py PHOTOS OUT [GROUND_TRUTH]

Matches of two heads on the same features become keypoints in three ways: propagated by homographies; the expectation
head's points as they are; and its points snapped to 1 px, as hloc does it. Everything after that is the same.
`hm-sfm compare` does this with more methods; this script is to copy and change. GROUND_TRUTH holds <image name>.camera
files.
"""

import sys
from pathlib import Path

import numpy as np

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_incrementally, summarise_models
from hm_sfm.colmap.models import read_tracks
from hm_sfm.colmap.verification import rank_pairs, verify_database, verify_pairs
from hm_sfm.config import Config
from hm_sfm.evaluation.comparison import load_expectation
from hm_sfm.evaluation.loftr_style import make_keypoints
from hm_sfm.evaluation.poses import score_model
from hm_sfm.formats.strecha import read_strecha_cameras
from hm_sfm.judgement.judgement import judge_pairs
from hm_sfm.keypoints.persistence import persist_keypoints
from hm_sfm.matching.run import match_pairs
from hm_sfm.matching.store import MatchStore, digest_image
from hm_sfm.photos.images import list_images
from hm_sfm.pipeline.collection import choose_pairs, measure_px_scales
from hm_sfm.pipeline.output_folder import claim_folder, describe_matching
from hm_sfm.pipeline.run import load_matcher, make_refiner, seed_photos


def compare_tracks(photos: Path, out: Path, ground_truth: Path | None) -> None:
    config = Config()
    claim_folder(out)
    images = list_images(photos).images
    homography_matcher = load_matcher(config)
    pairs = choose_pairs(images, out, config, lambda: homography_matcher)
    cameras = make_cameras(images, config.cameras)
    px_scale = measure_px_scales(images, config)

    # Each head's matches of the same pairs, stored side by side.
    digests = {image.name: digest_image(image) for image in images}
    homographies = MatchStore(out / "homographies.h5", describe_matching(config), digests)
    match_pairs(images, pairs, homography_matcher, homographies)
    expectation_matcher, made_by = load_expectation("light_expectation", config)
    expectations = MatchStore(out / "expectations.h5", made_by, digests)
    match_pairs(images, pairs, expectation_matcher, expectations)

    # Three ways from matches to keypoints.
    camera_of = {image.name: cameras.cameras[index] for image, index in zip(images, cameras.camera_index)}
    verified = verify_pairs(images, pairs, homographies.read, camera_of, px_scale, config.verification)
    verified = judge_pairs(verified, homographies.read, camera_of, px_scale, config.verification).pairs
    max_keypoints = config.keypoints.max_keypoints
    keypoints_and_matches = {
        "persistent": persist_keypoints(
            seed_photos(images, config),
            rank_pairs(verified),
            lambda pair: homographies.read(pair).select(verified[pair].inliers),
            config.keypoints,
            make_refiner(homography_matcher, images, config, homographies),
        ),
        "raw": make_keypoints(images, pairs, expectations.read, px_scale, None, max_keypoints),
        "snapped": make_keypoints(images, pairs, expectations.read, px_scale, 1, max_keypoints),
    }

    # The same verification and mapping for all, and what became of the tracks.
    for name, (keypoints, matches) in keypoints_and_matches.items():
        (out / name).mkdir(exist_ok=True)
        database = out / name / "database.db"
        write_database(database, images, cameras, keypoints, matches)
        verify_database(database, config.verification, px_scale)
        models = map_incrementally(
            MappingTask(database, photos, out / name / "sparse", config.mapping, px_scale=px_scale)
        )
        result = summarise_models(models, len(images))
        print(f"{name}: {result.registered} of {len(images)} images, {result.points} points", end=", ")
        print(f"tracks of {result.mean_track_length:.2f} images, {result.mean_reprojection_px:.3f} px")
        if models:
            length, points = np.unique(np.diff(read_tracks(models[0]).offsets), return_counts=True)
            print("    " + ", ".join(f"{count} in {images_each}" for images_each, count in zip(length, points)))
        if models and ground_truth:
            auc = score_model(models[0], read_strecha_cameras(ground_truth)).auc_percent
            print(f"    AUC@0.5 deg {auc[0.5]:.1f}, AUC@1 deg {auc[1]:.1f}")


if __name__ == "__main__":
    compare_tracks(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]) if len(sys.argv) > 3 else None)
