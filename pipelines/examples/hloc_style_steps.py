"""Structure from motion in the steps of hloc, with its files between them: pairs, features, matches, reconstruction.

    python pipelines/examples/hloc_style_steps.py PHOTOS OUT

After step 3, hloc itself can take over, with the files that are in OUT/hloc by then:

    from hloc import reconstruction
    reconstruction.main(sfm, PHOTOS, OUT/hloc/pairs.txt, OUT/hloc/features.h5, OUT/hloc/matches.h5)

and step 4 takes files that hloc made with any features and matcher, if its pairs are in OUT/hloc/pairs.txt.
"""

import sys
from pathlib import Path

from hm_sfm.colmap.cameras import make_cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.mapping import MappingTask, map_incrementally, summarise_models
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import Config
from hm_sfm.formats.hloc import read_features, read_matches, write_features, write_matches
from hm_sfm.formats.pairs_files import read_pairs, write_pairs
from hm_sfm.photos.images import list_images
from hm_sfm.pipeline.collection import measure_px_scales
from hm_sfm.pipeline.reconstruction import match_photos


def run_hloc_style_steps(photos: Path, out: Path) -> None:
    config = Config()
    hloc = out / "hloc"

    # 1. Match: hm_sfm has matches first and keypoints afterwards.
    run = match_photos(photos, out, config)
    hloc.mkdir(exist_ok=True)
    write_pairs(hloc / "pairs.txt", run.pairs)

    # 2. Features: the keypoints that persist from image to image.
    keypoints, matches = run.make_keypoints(run.verify().pairs)
    px_scale = measure_px_scales(run.images, config)
    write_features(hloc / "features.h5", run.images, keypoints, px_scale)

    # 3. Matches, as indices into the features.
    write_matches(hloc / "matches.h5", run.pairs, keypoints, matches)

    # 4. Reconstruction, from nothing but the photos and the three files.
    images = list_images(photos).images
    pairs = read_pairs(hloc / "pairs.txt", [image.name for image in images])
    keypoints = read_features(hloc / "features.h5", images)
    matches = read_matches(hloc / "matches.h5", pairs, keypoints)
    print(f"{sum(map(len, keypoints))} keypoints, {sum(map(len, matches))} matches in {len(pairs)} pairs")
    database = hloc / "database.db"
    write_database(database, images, make_cameras(images, config.cameras), keypoints, matches)
    verify_database(database, config.verification, px_scale)
    models = map_incrementally(MappingTask(database, photos, hloc / "sparse", config.mapping, px_scale=px_scale))

    result = summarise_models(models, len(images))
    print(f"{result.registered} of {result.num_images} images registered, {result.points} points")
    print(f"mean track length {result.mean_track_length:.2f} images")


if __name__ == "__main__":
    run_hloc_style_steps(Path(sys.argv[1]), Path(sys.argv[2]))
