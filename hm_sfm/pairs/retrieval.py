"""Which photos are similar in appearance: a global descriptor per photo, from the network's plain coarse features.

Each photo is encoded once, at a small size, and a sample of its cells is kept on disk. In seconds the descriptors are
made of these samples: bags of visual words (Sivic and Zisserman, ICCV 2003), of a vocabulary learned from the
collection itself. A sample depends on nothing but its photo and the weights, so it stays valid when other photos come
and go.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
from tqdm import tqdm

from hm_sfm.config import fingerprint
from hm_sfm.io.arrays import read_array
from hm_sfm.io.atomic import replace_file
from hm_sfm.io.batches import store_in_batches
from hm_sfm.photos.hypotheses import ROTATIONS_DEG, Hypothesis, apply_hypothesis
from hm_sfm.photos.images import PreparedImage, prepare_image
from hm_sfm.types import ImageRef

logger = logging.getLogger(__name__)

VERSION = 1
LONG_EDGE_PX = 512
"""Size at which photos are encoded for this."""
CELLS_PER_IMAGE = 1024
"""Cells kept of each photo."""
WORDS = 1024
"""Size of the vocabulary."""
VOCABULARY_CELLS = 20_000
"""Cells of all photos together that the vocabulary is learned from."""
CELLS_PER_WORD = 20
"""Fewer cells make fewer words."""
NEAR_DUPLICATE = 0.9
"""Least similarity of photos of one burst. Neighbours on a walk around a building have 0.85 at most."""
BLOCK_ROWS = 512
"""Rows of the similarity matrix that are held at a time."""

EncodeCells = Callable[[PreparedImage], np.ndarray]
"""A photo -> (N, C) float32 of unit length: its cells as a network sees them, see Encoder.encode_plain."""


class CellStore:
    """Samples of cells on disk, by the digest of their photo: a folder of files that each appear whole or not at all.

    A file that was made by other weights or another version, or is damaged, is removed: its samples are made again.
    """

    def __init__(self, folder: Path, weights: str) -> None:
        """weights: the digest of the weights file."""
        self.folder = Path(folder)
        self.made_by = fingerprint(VERSION, LONG_EDGE_PX, CELLS_PER_IMAGE, weights)
        self._file_of: dict[str, Path] = {}
        for file in sorted(self.folder.glob("*.h5")):
            try:
                with h5py.File(file, "r") as h5:
                    if h5.attrs.get("made_by") == self.made_by:
                        self._file_of.update(dict.fromkeys(h5, file))
                        continue
            except OSError as error:
                logger.warning("%s is damaged, it is made again: %s", file, error)
            file.unlink()

    def __contains__(self, digest: str) -> bool:
        return digest in self._file_of

    def read(self, digests: Sequence[str], count: int = CELLS_PER_IMAGE) -> Iterable[np.ndarray]:
        """For each photo the first `count` cells of its sample, (<= count, C) float32. KeyError where there is none."""
        opened, file = None, None
        try:
            for digest in digests:
                if self._file_of[digest] != file:
                    if opened:
                        opened.close()
                    file = self._file_of[digest]
                    opened = h5py.File(file, "r")
                assert opened is not None
                yield read_array(opened, digest, count).astype(np.float32)
        finally:
            if opened:
                opened.close()

    def write(self, batch: Mapping[str, np.ndarray]) -> None:
        """Store samples, (N, C) floats by digest, as float16: after a crash either all of them are there or none."""
        if not batch:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        # Named after its content: processes that share the folder don't write different files of one name.
        path = self.folder / f"{fingerprint(self.made_by, sorted(batch))}.h5"
        with replace_file(path) as temporary, h5py.File(temporary, "w") as h5:
            h5.attrs["made_by"] = self.made_by
            for digest, cells in batch.items():
                h5[digest] = np.asarray(cells, np.float16)
        self._file_of.update(dict.fromkeys(batch, path))


def describe_images(
    images: Sequence[ImageRef],
    digests: Mapping[str, str],
    encode: EncodeCells,
    store: CellStore,
    quiet: bool = False,
    rotated: bool = False,
) -> np.ndarray:
    """Global descriptors (N, D) float32 of unit length, none of it negative, in the order of the images.

    digests: of the photos, by name. rotated: as they are and rotated clockwise, by each of ROTATIONS_DEG, (T, N, D);
    the words are then those of all rotations. Photos that the store lacks are encoded into it, in batches. Raises
    InputError on an undecodable photo; what was stored by then stays.
    """
    rotations_deg = ROTATIONS_DEG if rotated else (0,)
    encode_images(images, digests, encode, store, quiet, rotations_deg)
    keys = [name_sample(digests[image.name], rotation_deg) for rotation_deg in rotations_deg for image in images]
    vocabulary = learn_vocabulary(store.read(keys, max(1, VOCABULARY_CELLS // len(keys))))
    described = weigh_words(np.stack([count_words(cells, vocabulary) for cells in store.read(keys)]))
    return described.reshape(len(rotations_deg), len(images), -1) if rotated else described


def encode_images(
    images: Sequence[ImageRef],
    digests: Mapping[str, str],
    encode: EncodeCells,
    store: CellStore,
    quiet: bool = False,
    rotations_deg: Sequence[int] = (0,),
) -> None:
    """Put a sample of the cells of each photo, rotated clockwise by each angle, into the store, unless it is there."""
    missing = {
        digests[image.name]: image
        for image in images
        if any(name_sample(digests[image.name], rotation_deg) not in store for rotation_deg in rotations_deg)
    }

    def write(batch: Sequence[tuple[str, np.ndarray]]) -> None:
        store.write(dict(batch))

    with store_in_batches(write) as keep:
        for digest, image in tqdm(missing.items(), desc="retrieval", unit="image", disable=quiet or not missing):
            prepared = prepare_image(image, LONG_EDGE_PX)
            for rotation_deg in rotations_deg:
                key = name_sample(digest, rotation_deg)
                if key not in store:
                    cells = encode(apply_hypothesis(prepared, Hypothesis(rotation_deg)))
                    keep([(key, sample_cells(cells))])


def name_sample(digest: str, rotation_deg: int) -> str:
    """The name in a CellStore of the sample of a rotated photo; that of the photo as it is has its digest."""
    return f"{digest}-{rotation_deg}" if rotation_deg else digest


def sample_cells(cells: np.ndarray) -> np.ndarray:
    """At most CELLS_PER_IMAGE of the cells (N, C), the same ones each time, in an order of which any part is random."""
    return cells[np.random.default_rng(0).permutation(len(cells))[:CELLS_PER_IMAGE]]


def learn_vocabulary(cells: Iterable[np.ndarray]) -> np.ndarray:
    """Cluster centres (K, C) float32 of the cells (n, C) of several photos, at most WORDS; always the same ones."""
    cells = np.concatenate(list(cells))
    count = min(WORDS, max(1, len(cells) // CELLS_PER_WORD))
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 10, 1e-4)
    # OpenCV's own type hints lack that the labels to start from may be none.
    start: Any = None
    return cv2.kmeans(cells, count, start, stop, 1, cv2.KMEANS_PP_CENTERS)[2]


def count_words(cells: np.ndarray, vocabulary: np.ndarray) -> np.ndarray:
    """How many of one photo's cells (n, C) are nearest to each word (K, C): (K,) int64."""
    word = np.argmax(cells @ vocabulary.T - (vocabulary**2).sum(axis=1) / 2, axis=1)
    return np.bincount(word, minlength=len(vocabulary))


def weigh_words(counts: np.ndarray) -> np.ndarray:
    """Descriptors (N, K) float32 of unit length from the words' counts (N, K), a row a photo.

    A word weighs more the fewer photos have it, and its count less than in proportion: facades repeat themselves.
    """
    photos_with = np.count_nonzero(counts, axis=0)
    weighed = np.sqrt(counts) * np.log((len(counts) + 1) / np.maximum(photos_with, 1))
    return (weighed / np.linalg.norm(weighed, axis=1, keepdims=True)).astype(np.float32)


def find_similar(descriptors: np.ndarray, top: int, gap: int = 0) -> np.ndarray:
    """For each descriptor the `top` most similar others that are more than `gap` rows away, best first.

    Near-duplicates, as bursts of photos are, do not fill the list: only a quarter of it is of each group of them, as
    long as there are others. Without that, a burst of more than `top` photos would have no pair with anything else.

    descriptors: (N, D) float32, none of it negative, or (T, N, D): each photo as it is, the first of T ways, is then
    compared with the others in all ways, of which the most similar one counts. Returns (N, top) int64 rows, -1 where no
    more have anything in common with it. Of equally similar ones the lower row comes first.
    """
    rotated = descriptors[1:] if descriptors.ndim == 3 else []
    descriptors = descriptors[0] if descriptors.ndim == 3 else descriptors
    count = len(descriptors)
    group = group_near_duplicates(descriptors)
    similar = np.full((count, top), -1, np.int64)
    for start in range(0, count, BLOCK_ROWS):
        block = descriptors[start : start + BLOCK_ROWS]
        similarity = block @ descriptors.T
        for others in rotated:
            np.maximum(similarity, block @ others.T, out=similarity)
        rows = np.arange(start, start + len(similarity))
        similarity[np.abs(rows[:, None] - np.arange(count)) <= gap] = 0
        order = np.argsort(-similarity, axis=1, kind="stable")
        for row, ranked, num_similar in zip(rows, order, np.count_nonzero(similarity > 0, axis=1)):
            best = choose_from_groups(ranked[:num_similar], group, top)
            similar[row, : len(best)] = best
    return similar


def group_near_duplicates(descriptors: np.ndarray) -> np.ndarray:
    """(N,) int64: for each photo (N, D) the row of the earliest one that it nearly equals and that leads a group.

    A photo that nearly equals none leads a group of its own.
    """
    group = np.arange(len(descriptors))
    leaders = np.zeros(0, np.int64)
    for start in range(0, len(descriptors), BLOCK_ROWS):
        block = descriptors[start : start + BLOCK_ROWS]
        rows = np.arange(start, start + len(block))
        similarity = block @ descriptors[np.concatenate([leaders, rows])].T
        leads = np.concatenate([np.ones(len(leaders), bool), np.zeros(len(block), bool)])
        candidates = np.concatenate([leaders, rows])
        for number, row in enumerate(rows):
            equal = np.flatnonzero(leads & (similarity[number] >= NEAR_DUPLICATE))
            if len(equal):
                group[row] = candidates[equal[0]]
            else:
                leads[len(leaders) + number] = True
        leaders = candidates[leads]
    return group


def choose_from_groups(ranked: np.ndarray, group: np.ndarray, top: int) -> np.ndarray:
    """The first `top` of the rows `ranked`, of each group at most a quarter of them while there are others."""
    most = max(1, top // 4)
    of_group = group[ranked]
    order = np.argsort(of_group, kind="stable")
    place = np.empty(len(ranked), np.int64)  # of a row among those of its group
    place[order] = np.arange(len(ranked)) - np.searchsorted(of_group[order], of_group[order])
    return ranked[np.argsort(place >= most, kind="stable")][:top]
