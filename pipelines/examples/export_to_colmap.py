"""Matches of hm_sfm for a COLMAP workflow: a folder of photos -> a verified COLMAP database, mapped by COLMAP itself.

    python pipelines/examples/export_to_colmap.py PHOTOS OUT

OUT/database.db opens in COLMAP's GUI; `colmap mapper --database_path OUT/database.db --image_path PHOTOS
--output_path OUT/colmap` does the same as the last stage here, with COLMAP's own defaults.
"""

import sys
from pathlib import Path

import pycolmap

from hm_sfm.config import Config
from hm_sfm.pipeline.reconstruction import export_database


def export_to_colmap(photos: Path, out: Path) -> None:
    exported = export_database(photos, out, Config())

    with pycolmap.Database.open(out / "database.db") as database:
        print(f"{database.num_images()} images, {database.num_keypoints()} keypoints")
        print(f"{database.num_verified_image_pairs()} of {len(exported.pairs)} image pairs verified")

    (out / "colmap").mkdir(exist_ok=True)
    models = pycolmap.incremental_mapping(out / "database.db", photos, out / "colmap")
    for number, model in models.items():
        print(f"{out / 'colmap' / str(number)}: {model.num_reg_images()} images, {model.num_points3D()} points")


if __name__ == "__main__":
    export_to_colmap(Path(sys.argv[1]), Path(sys.argv[2]))
