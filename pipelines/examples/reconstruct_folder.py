"""A folder of photos -> a COLMAP model, one call a stage: what `hm-sfm reconstruct` does, to copy and change.

    python pipelines/examples/reconstruct_folder.py PHOTOS OUT

Writes OUT/matches.h5, OUT/database.db and OUT/sparse. Started again, it keeps the matches that are there.
"""

import sys
from pathlib import Path

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_incrementally, summarise_models
from hm_sfm.colmap.verification import rank_pairs, verify_database, verify_pairs
from hm_sfm.config import Config
from hm_sfm.judgement.judgement import judge_pairs
from hm_sfm.keypoints.persistence import persist_keypoints
from hm_sfm.matching.run import match_pairs
from hm_sfm.photos.images import list_images
from hm_sfm.pipeline.collection import choose_pairs, measure_px_scales
from hm_sfm.pipeline.output_folder import claim_folder, open_store
from hm_sfm.pipeline.run import load_matcher, make_refiner, seed_photos


def reconstruct_folder(photos: Path, out: Path) -> None:
    config = Config()
    claim_folder(out)

    # The images, and which of them to match with which.
    images = list_images(photos).images
    matcher = load_matcher(config)
    pairs = choose_pairs(images, out, config, lambda: matcher)
    cameras = make_cameras(images, config.cameras)

    # Dense matches, each with the homography of its patch.
    store = open_store(out / "matches.h5", images, config)
    match_pairs(images, pairs, matcher, store)

    # Only matches that agree with the two-view geometry of their pair may propagate keypoints.
    camera_of = {image.name: cameras.cameras[index] for image, index in zip(images, cameras.camera_index)}
    px_scale = measure_px_scales(images, config)
    verified = verify_pairs(images, pairs, store.read, camera_of, px_scale, config.verification)

    # Third photos refute pairs of places that only look alike, and matches that two photos cannot.
    verified = judge_pairs(verified, store.read, camera_of, px_scale, config.verification).pairs

    # Keypoints that persist from image to image, and their matches.
    keypoints, matches = persist_keypoints(
        seed_photos(images, config),
        rank_pairs(verified),
        lambda pair: store.read(pair).select(verified[pair].inliers),
        config.keypoints,
        make_refiner(matcher, images, config, store),
    )

    # From here on it is COLMAP.
    database = out / "database.db"
    write_database(database, images, cameras, keypoints, matches)
    verify_database(database, config.verification, px_scale)
    task = MappingTask(database, photos, out / "sparse", config.mapping, config.verification.max_error_px, px_scale)
    models = map_incrementally(task)

    result = summarise_models(models, len(images))
    print(f"{result.registered} of {result.num_images} images registered, {result.points} points")
    print(f"mean track length {result.mean_track_length:.2f} images")
    print(f"mean reprojection error {result.mean_reprojection_px:.3f} px")


if __name__ == "__main__":
    reconstruct_folder(Path(sys.argv[1]), Path(sys.argv[2]))
