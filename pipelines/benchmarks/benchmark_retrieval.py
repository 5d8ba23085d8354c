"""How many of the truly overlapping pairs retrieval finds, measured against sparse models of the scenes.

    python pipelines/benchmarks/benchmark_retrieval.py PHOTOS [PHOTOS ...] --models MODELS --out OUT

MODELS/<scene>/sparse holds the COLMAP models of a scene, made from all its pairs; <scene> is the name of the folder of
its photos. Two images overlap if they share enough points. Each scene is searched alone, and among the photos of all
scenes. `true` counts the overlapping pairs; `recall` is the share of them that retrieval proposes, and `pairs` the
share of all possible pairs that it proposes, both in percent.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from tables import format_table

from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.matching.store import digest_image
from hm_sfm.network.checkpoints import digest_weights
from hm_sfm.pairs.retrieval import CellStore, describe_images, find_similar
from hm_sfm.photos.images import list_images
from hm_sfm.types import ImagePair, ImageRef


def find_overlapping(models: Path, prefix: str, min_points: int) -> set[ImagePair]:
    """The pairs of images that see at least `min_points` common points of one of the models in a folder."""
    overlapping = set()
    for folder in sorted(path for path in models.iterdir() if path.is_dir()):
        model = pycolmap.Reconstruction(folder)
        image_ids = sorted(model.reg_image_ids())
        row = {image_id: i for i, image_id in enumerate(image_ids)}
        sees = np.zeros((len(image_ids), model.num_points3D()), np.float32)
        for column, point in enumerate(model.points3D.values()):
            sees[[row[element.image_id] for element in point.track.elements], column] = 1
        names = [prefix + model.image(image_id).name for image_id in image_ids]
        first, second = np.nonzero(np.triu(sees @ sees.T >= min_points, 1))
        overlapping |= {ImagePair.of(names[a], names[b]) for a, b in zip(first, second)}
    return overlapping


def score(
    names: Sequence[str], descriptors: np.ndarray, overlapping: set[ImagePair], tops: Sequence[int]
) -> dict[str, float]:
    """Recall of the overlapping pairs, and the share of all pairs that are proposed, in percent, by `top`."""
    scores = {}
    for top in tops:
        similar = enumerate(find_similar(descriptors, top).tolist())
        pairs = {ImagePair.of(names[i], names[j]) for i, row in similar for j in row if j >= 0}
        scores[f"recall@{top}"] = 100 * len(overlapping & pairs) / max(1, len(overlapping))
        scores[f"pairs@{top}"] = 100 * len(pairs) / (len(names) * (len(names) - 1) / 2)
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", metavar="PHOTOS", type=Path, nargs="+", help="one folder of photos per scene")
    parser.add_argument("--models", type=Path, required=True, help="MODELS/<scene>/sparse: its COLMAP models")
    parser.add_argument("--out", type=Path, required=True, help="folder for the encoded photos")
    parser.add_argument("--top", type=int, nargs="+", default=[5, 10, 20], help="images proposed for each image")
    parser.add_argument("--min-points", type=int, default=30, help="that overlapping images share (default: 30)")
    options = parser.parse_args()

    matcher = HomoMatcher.from_pretrained("light")
    store = CellStore(options.out, digest_weights("light"))
    scenes: dict[str, tuple[list[ImageRef], set[ImagePair]]] = {}
    for folder in options.folders:
        images = [replace(image, name=f"{folder.name}/{image.name}") for image in list_images(folder).images]
        overlapping = find_overlapping(options.models / folder.name / "sparse", f"{folder.name}/", options.min_points)
        scenes[folder.name] = images, overlapping

    everything = [image for images, _ in scenes.values() for image in images]
    digests = {image.name: digest_image(image) for image in everything}
    rows = []
    for among in ("itself", "all") if len(scenes) > 1 else ("itself",):
        for scene, (own, overlapping) in scenes.items():
            images = own if among == "itself" else everything
            descriptors = describe_images(images, digests, matcher.encoder.encode_plain, store)
            scores = score([image.name for image in images], descriptors, overlapping, options.top)
            rows.append({"scene": scene, "among": among, "images": len(images), "true": len(overlapping), **scores})
    print(format_table(rows))


if __name__ == "__main__":
    main()
