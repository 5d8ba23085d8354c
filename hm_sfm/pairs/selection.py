"""Stage 2: which images to match with which."""

import itertools
import logging
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from hm_sfm.config import PairConfig
from hm_sfm.errors import ConfigError, InputError
from hm_sfm.formats.pairs_files import read_pairs
from hm_sfm.io.colmap_log import quiet_colmap
from hm_sfm.types import ImagePair, Position

logger = logging.getLogger(__name__)

MODES = ("auto", "exhaustive", "sequential", "retrieval", "spatial")
LOOP_WINDOWS = 4
"""A sequence closes a loop where it comes back after more than so many windows."""

FindSimilar = Callable[[Sequence[str], int, int], np.ndarray]
"""(names, top, gap) -> (N, top) int64: for each name the positions in `names` of the `top` images most like it that
are more than `gap` places away, best first; -1 where there are no more."""


def select_pairs(
    names: Sequence[str],
    config: PairConfig,
    find_similar: FindSimilar | None = None,
    positions: Mapping[str, Position] | None = None,
) -> tuple[ImagePair, ...]:
    """The pairs to match among the images `names`, as `config.mode` says; each pair once.

    auto takes all pairs of up to `config.exhaustive_limit` images. Of more it takes each image with those most like
    it, those taken nearest to it, and, where the images are a sequence, its followers: where their names are numbered
    and most of the next ones are alike. Images without position have no neighbours by position.

    find_similar: called only where the mode needs to know which images are similar in appearance.

    Raises InputError where there are fewer than two images, no pair at all, no positions for the mode spatial, or the
    pairs file is unusable, ConfigError where the mode or a setting is impossible, ValueError where the mode needs
    find_similar and there is none.
    """
    if len(names) < 2:
        raise InputError(f"at least 2 images are needed to make a pair, found {len(names)}")
    for key in ("window", "retrieval_top", "spatial_top"):
        if getattr(config, key) < 1:
            raise ConfigError(f"pairs.{key} must be at least 1, found {getattr(config, key)}")
    if config.mode not in MODES and not Path(config.mode).exists():
        modes = f"{', '.join(MODES[:-1])} or {MODES[-1]}"
        raise InputError(f"pairs {config.mode!r} is neither {modes} nor a file that exists")
    if config.mode not in MODES:
        return read_pairs(Path(config.mode), names)
    if config.mode == "exhaustive" or (config.mode == "auto" and len(names) <= config.exhaustive_limit):
        return pair_exhaustively(names)

    ordered = sorted(names, key=_natural_key)
    pairs: list[ImagePair] = []
    if config.mode in ("auto", "retrieval"):
        pairs += _pair_similar(ordered, find_similar, config.retrieval_top)
    if config.mode == "auto" and _is_numbered(ordered):
        followers = _pair_at_distances(ordered, [1])
        if 2 * len(set(followers).intersection(pairs)) >= len(followers):
            pairs += _pair_at_distances(ordered, range(1, config.window + 1))
    if config.mode == "sequential":
        pairs += pair_sequentially(names, config.window)
        if config.loop_top:
            pairs += _pair_similar(ordered, find_similar, config.loop_top, LOOP_WINDOWS * config.window)
    positions = positions or {}
    if config.mode == "spatial" and not positions:
        raise InputError(f"pairs mode 'spatial' needs photos with a GPS position in EXIF, found none in {len(names)}")
    if config.mode == "spatial" and len(positions) < len(names):
        lacking = len(names) - len(positions)
        logger.warning("%d of %d photos have no GPS position in EXIF: they are in no pair", lacking, len(names))
    if config.mode in ("auto", "spatial") and positions:
        pairs += pair_spatially(positions, config.spatial_top, config.spatial_distance_m)
    if not pairs:
        raise InputError(f"pairs mode {config.mode!r} finds no pair among {len(names)} images: use another mode")
    return tuple(dict.fromkeys(pairs))


def pair_exhaustively(names: Sequence[str]) -> tuple[ImagePair, ...]:
    """All pairs of different images, in the order of `names`."""
    return tuple(ImagePair.of(a, b) for a, b in itertools.combinations(names, 2))


def pair_sequentially(names: Sequence[str], window: int) -> tuple[ImagePair, ...]:
    """Each image with its next `window` images and with those at distances of powers of two beyond.

    The sequence is the natural order of `names`: numbers compare as numbers, img2 before img10.

    Raises ConfigError where window is below 1.
    """
    if window < 1:
        raise ConfigError(f"pairs.window must be at least 1, found {window}")
    powers = [2**k for k in range(len(names).bit_length()) if 2**k > window]
    return _pair_at_distances(sorted(names, key=_natural_key), [*range(1, min(window, len(names)) + 1), *powers])


def pair_spatially(positions: Mapping[str, Position], top: int, distance_m: float) -> tuple[ImagePair, ...]:
    """Each image with the `top` images taken nearest to it, none farther away than `distance_m`, by COLMAP.

    positions: by image name; altitudes are ignored.
    """
    names = sorted(positions)
    with (
        tempfile.TemporaryDirectory() as folder,
        quiet_colmap(),
        pycolmap.Database.open(Path(folder) / "positions.db") as database,
    ):
        _write_positions(database, names, positions)
        options = pycolmap.SpatialPairingOptions(
            max_num_neighbors=top, max_distance=distance_m, ignore_z=True, num_threads=1
        )
        neighbours = pycolmap.SpatialPairGenerator(options, database).all_pairs()
    return tuple(dict.fromkeys(ImagePair.of(names[a - 1], names[b - 1]) for a, b in sorted(neighbours)))


def _pair_at_distances(ordered: Sequence[str], distances: Iterable[int]) -> tuple[ImagePair, ...]:
    distances = tuple(distances)
    return tuple(
        ImagePair.of(name, ordered[i + distance])
        for i, name in enumerate(ordered)
        for distance in distances
        if i + distance < len(ordered)
    )


def _pair_similar(
    ordered: Sequence[str], find_similar: FindSimilar | None, top: int, gap: int = 0
) -> tuple[ImagePair, ...]:
    """Each image with the `top` ones most like it: a pair that one of the two proposes is enough."""
    if find_similar is None:
        raise ValueError(f"to pair {len(ordered)} images by appearance, select_pairs needs find_similar")
    similar = find_similar(ordered, min(top, len(ordered) - 1), gap)
    return tuple(
        dict.fromkeys(
            ImagePair.of(ordered[i], ordered[int(j)]) for i, row in enumerate(similar.tolist()) for j in row if j >= 0
        )
    )


def _is_numbered(ordered: Sequence[str]) -> bool:
    """Whether most names differ from the next one in nothing but a number."""
    keys = [_natural_key(name)[0] for name in ordered]
    steps = [
        [(one, other) for one, other in zip(key, after) if one != other] if len(key) == len(after) else []
        for key, after in itertools.pairwise(keys)
    ]
    numbered = [len(step) == 1 and isinstance(step[0][0], int) for step in steps]
    return 2 * sum(numbered) > len(numbered)


def _write_positions(database: pycolmap.Database, names: Sequence[str], positions: Mapping[str, Position]) -> None:
    """Images 1, 2 ... with their positions, and a camera only because COLMAP wants one."""
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.SIMPLE_PINHOLE, 1.0, 1, 1)
    with pycolmap.DatabaseTransaction(database):
        database.write_camera(camera, use_camera_id=True)
        for image_id, name in enumerate(names, start=1):
            image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
            database.write_image(image, use_image_id=True)
            wgs84 = pycolmap.PosePriorCoordinateSystem.WGS84
            latitude, longitude, altitude = positions[name]
            prior = pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=np.array([latitude, longitude, altitude or 0.0]),
                coordinate_system=wgs84,
            )
            database.write_pose_prior(prior)


def _natural_key(name: str) -> tuple[list[str | int], str]:
    parts: list[str | int] = list(re.split("([0-9]+)", name))
    parts[1::2] = map(int, parts[1::2])
    return parts, name
