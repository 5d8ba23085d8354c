"""Keypoints and matches in the files of hloc (cvg/Hierarchical-Localization): features.h5 and matches.h5.

features.h5 has a group per image, at the image's name (folders become groups): `keypoints` (K, 2), with hloc's
attribute `uncertainty`, `scores` (K,) and `image_size` (2,). matches.h5 has a group per pair, `name0/name1` with every
"/" inside a name replaced by "-": `matches0` (K0,), for each keypoint of image 0 its partner in image 1 or -1, and
`matching_scores0` (K0,). hloc counts the centre of the top-left pixel as (0, 0) and adds the half pixel when it writes
its COLMAP database; here it is added on reading and taken off on writing.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from hm_sfm.errors import InputError
from hm_sfm.geometry.frames import pixel_index_from_px, px_from_pixel_index
from hm_sfm.io.arrays import open_group, read_array, read_attributes
from hm_sfm.io.atomic import replace_file
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

SEPARATORS = ("/", "_")
"""Between the two names of a pair: now, and in the files of early versions."""


def write_features(
    path: Path, images: Sequence[ImageRef], keypoints: Sequence[Keypoints], px_scale: Mapping[str, float]
) -> None:
    """Write features.h5, atomically. keypoints: one per image, in the order of the images.

    px_scale: by image name, px of the stored image per px of the matching resolution; it becomes the
    `uncertainty`, which is what hloc scales its error limits with. The keypoints' own standard deviations are in a
    further dataset, `sigma_px`, which hloc ignores. Creates the folder.
    """
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary, h5py.File(temporary, "w") as h5:
        for image, points in zip(images, keypoints, strict=True):
            group = h5.create_group(image.name)
            group["keypoints"] = pixel_index_from_px(points.xy)
            group["keypoints"].attrs["uncertainty"] = px_scale[image.name]
            group["scores"] = points.score
            group["sigma_px"] = points.sigma_px
            group["image_size"] = np.array(image.size_wh)


def write_matches(
    path: Path, pairs: Sequence[ImagePair], keypoints: Sequence[Keypoints], matches: Sequence[IndexMatches]
) -> None:
    """Write matches.h5, atomically. hloc wants every pair of its pairs file: those without matches get empty ones.

    matches: of some of the pairs, as indices into `keypoints`. Creates the folder. Raises InputError where two image
    names become one in hloc's names of pairs.
    """
    check_names([points.name for points in keypoints])
    count_of = {points.name: len(points) for points in keypoints}
    matches_of = {some.pair: some for some in matches}
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary, h5py.File(temporary, "w") as h5:
        for pair in pairs:
            partner = np.full(count_of[pair.name0], -1, np.int32)
            score = np.zeros(count_of[pair.name0], np.float32)
            if pair in matches_of:
                first, second = matches_of[pair].indices.T
                partner[first], score[first] = second, matches_of[pair].score
            group = h5.create_group(name_group(pair.name0, pair.name1))
            group["matches0"] = partner
            group["matching_scores0"] = score


def read_features(path: Path, images: Sequence[ImageRef]) -> tuple[Keypoints, ...]:
    """The Keypoints of the images, in their order; the file may hold those of further ones.

    sigma_px is the dataset of that name, else the `uncertainty`, else 1; score is `scores` (`score` in files of
    hloc's match_dense), else 1.

    Raises InputError where the file cannot be read, lacks an image, or holds keypoints that are malformed, outside of
    their image, or of an image of another size.
    """
    with open_h5(path) as h5:
        missing = [image.name for image in images if image.name not in h5]
        if missing:
            raise InputError(
                f"{path} has no keypoints of {len(missing)} of {len(images)} images, for example {missing[0]!r} (it "
                f"has some of {min(h5, default='nothing')!r}): it belongs to other photos, or to another list of pairs"
            )
        return tuple(read_keypoints(h5[image.name], path, image) for image in images)


def read_keypoints(group: object, path: Path, image: ImageRef) -> Keypoints:
    """The keypoints of one image. Raises InputError as read_features does."""
    if not isinstance(group, h5py.Group) or not isinstance(group.get("keypoints"), h5py.Dataset):
        raise InputError(f"{path} has no keypoints in its group {image.name!r}: expected a features file of hloc")
    data = read_array(group, "keypoints")
    if data.ndim != 2 or data.shape[1] != 2:
        raise InputError(f"the keypoints of {image.name!r} in {path} must have shape (K, 2), found {data.shape}")
    size_wh = tuple(map(int, read_array(group, "image_size"))) if "image_size" in group else image.size_wh
    if size_wh != tuple(image.size_wh):
        width, height = size_wh
        raise InputError(
            f"{path} has the keypoints of an image {image.name!r} of {width} x {height} px, the photo has "
            f"{image.size_wh[0]} x {image.size_wh[1]} px: it belongs to other photos, or to photos rotated as EXIF says"
        )
    xy = px_from_pixel_index(data.astype(np.float32))
    # Half precision rounds to whole pixels from 1024 on: a point at the edge may come to lie a bit outside.
    if not np.all((xy >= -1) & (xy <= np.array(image.size_wh) + 1)):
        raise InputError(f"{path} has keypoints outside of {image.name!r}: it belongs to other photos")
    uncertainty = read_attributes(group["keypoints"]).get("uncertainty", 1.0)
    sigma = read_array(group, "sigma_px") if "sigma_px" in group else np.full(len(xy), uncertainty)
    score = next((read_array(group, name) for name in ("scores", "score") if name in group), np.ones(len(xy)))
    if not sigma.shape == score.shape == (len(xy),):
        raise InputError(f"{path} has {len(xy)} keypoints of {image.name!r} but scores of shape {score.shape}")
    return Keypoints(image.name, xy, sigma, score)


def read_matches(path: Path, pairs: Sequence[ImagePair], keypoints: Sequence[Keypoints]) -> tuple[IndexMatches, ...]:
    """The IndexMatches of the pairs, in their order; the file may hold a pair in either order.

    Of several matches of one keypoint the best-scored is taken. Raises InputError where the file cannot be read,
    lacks a pair, is malformed, or has matches of keypoints that are not there, as those of another run do.
    """
    check_names([points.name for points in keypoints])
    count_of = {points.name: len(points) for points in keypoints}
    with open_h5(path) as h5:
        groups = [find_group(h5, pair) for pair in pairs]
        missing = [pair for pair, group in zip(pairs, groups) if group is None]
        if missing:
            raise InputError(
                f"{path} lacks {len(missing)} of {len(pairs)} pairs, for example {missing[0].name0!r} and "
                f"{missing[0].name1!r}: it belongs to another run, or was made from another list of pairs"
            )
        return tuple(read_pair(h5, path, pair, *group, count_of) for pair, group in zip(pairs, groups) if group)


def find_group(h5: h5py.File, pair: ImagePair, dataset: str = "matches0") -> tuple[str, bool] | None:
    """Where the file has a pair with this dataset, and whether with the images in the other order."""
    for separator in SEPARATORS:
        for swapped, names in ((False, (pair.name0, pair.name1)), (True, (pair.name1, pair.name0))):
            group = name_group(*names, separator)
            if group in h5 and dataset in open_group(h5, group):
                return group, swapped
    return None


def read_pair(
    h5: h5py.File, path: Path, pair: ImagePair, group: str, swapped: bool, count_of: Mapping[str, int]
) -> IndexMatches:
    """The matches of one pair. Raises InputError as read_matches does."""
    data = open_group(h5, group)
    partner = read_array(data, "matches0").astype(np.int64)
    score = read_array(data, "matching_scores0") if "matching_scores0" in data else np.ones(len(partner))
    if partner.ndim != 1 or partner.shape != score.shape:
        raise InputError(f"{path} has {partner.shape} matches but {score.shape} scores in its group {group!r}")
    first = np.flatnonzero(partner >= 0)
    indices, score = np.stack([first, partner[first]], axis=1), score[first]
    if swapped:
        indices = indices[:, ::-1]
    for side, name in enumerate((pair.name0, pair.name1)):
        if len(indices) and indices[:, side].max() >= count_of[name]:
            raise InputError(
                f"{path} matches keypoint {indices[:, side].max()} of {name!r}, which has {count_of[name]}: it is not "
                "of the same run as the keypoints"
            )
    return IndexMatches.of_best(pair, indices, score)


def name_group(name0: str, name1: str, separator: str = "/") -> str:
    """Hloc's name of a pair."""
    return f"{name0.replace('/', '-')}{separator}{name1.replace('/', '-')}"


def check_names(names: Sequence[str]) -> None:
    """Raises InputError where two image names become one in hloc's names of pairs."""
    taken: dict[str, str] = {}
    for name in names:
        other = taken.setdefault(name.replace("/", "-"), name)
        if other != name:
            raise InputError(f"hloc cannot tell the images {other!r} and {name!r} apart: rename one of them")


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open a file to read. Raises InputError where that fails, or reading in the block does."""
    if not Path(path).is_file():
        raise InputError(f"there is no file {path}")
    try:
        with h5py.File(path, "r") as h5:
            yield h5
    except OSError as error:
        raise InputError(f"{path} is damaged or no HDF5 file ({error})") from error
