"""Keypoints as detector-free matching makes them without persistence: from each match's two points alone.

*Raw*: every point of a match is a keypoint; only exact duplicates are one. A point in the image that LoFTR starts from
is the centre of a cell, the same in every pair; in the other image it lies anywhere, so most tracks end there.

*Snapped*, as hloc's match_dense does it: the points that all pairs of an image have in a square cell vote for the
position of one keypoint, which stands for all of them. Votes go to positions rounded to VOTE_PX. The keypoints with
most votes are kept, and every point then joins the nearest keypoint within VOTE_PX. (hloc calls the two `cell_size` and
`max_error`; its configuration for LoFTR has 1 px for both. It counts px of the stored photo; here they are px of the
matching resolution: the same for photos that are not reduced, and kinder to the matches of those that are.)
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from hm_sfm.geometry.nearest import find_nearest
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, PairMatches

VOTE_PX = 1.0


def make_keypoints(
    images: Sequence[ImageRef],
    pairs: Sequence[ImagePair],
    read: Callable[[ImagePair], PairMatches],
    px_scale: Mapping[str, float],
    cell_px: float | None,
    max_keypoints: int,
) -> tuple[tuple[Keypoints, ...], tuple[IndexMatches, ...]]:
    """Keypoints from matches: raw where cell_px is None, else snapped to cells of that size.

    read: gives the matches of a pair; all are used, best or not, as LoFTR's are. px_scale: by image name, px of the
    stored image per px of the matching resolution, which is that of cell_px. max_keypoints: per image, of snapped ones.
    Returns the Keypoints of every image, in the order of `images`, none for an image without a match, and the
    IndexMatches of every pair. A keypoint's score is its votes, its sigma_px VOTE_PX.
    """
    xy: dict[str, list[np.ndarray]] = {image.name: [np.zeros((0, 2), np.float32)] for image in images}
    score: dict[str, list[np.ndarray]] = {image.name: [np.zeros(0, np.float32)] for image in images}
    for pair in pairs:
        matches = read(pair)
        for name, points in ((pair.name0, matches.xy0), (pair.name1, matches.xy1)):
            xy[name].append(points)
            score[name].append(matches.score)

    keypoints = []
    index_of: dict[str, list[np.ndarray]] = {}
    for image in images:
        points, votes = np.concatenate(xy[image.name]), np.concatenate(score[image.name])
        scale = px_scale[image.name]
        if cell_px is None:
            position, votes, index = merge_duplicates(points, votes)
        else:
            points = points / scale
            position, votes, _ = snap_points(points, votes, cell_px, VOTE_PX)
            position, votes = keep_most_voted(position, votes, max_keypoints)
            index, _ = find_nearest(points, position, VOTE_PX)
            position = position * scale
        keypoints.append(Keypoints(image.name, position, np.full(len(position), VOTE_PX * scale), votes))
        ends = np.cumsum([len(part) for part in xy[image.name]])
        index_of[image.name] = np.split(index, ends[:-1])

    part = dict.fromkeys(xy, 0)
    matches = []
    for pair in pairs:
        part[pair.name0] += 1
        part[pair.name1] += 1
        indices = np.stack([index_of[name][part[name]] for name in (pair.name0, pair.name1)], axis=1)
        strength = score[pair.name0][part[pair.name0]]
        placed = np.all(indices >= 0, axis=1)
        matches.append(IndexMatches.of_best(pair, indices[placed], strength[placed]))
    return tuple(keypoints), tuple(matches)


def merge_duplicates(xy: np.ndarray, score: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (N, 2) float32 that are equal to the last bit become one.

    score: (N,). Returns positions (K, 2) float32, the sum of scores at each (K,), and each point's position (N,) int64.
    """
    # One 64-bit key a point: sorting rows would take ten times as long. Adding 0 turns -0 into 0.
    key = np.ascontiguousarray(xy.astype(np.float32) + 0).view(np.uint64)[:, 0]
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return xy[first], np.bincount(index, score, len(first)), index


def snap_points(
    xy: np.ndarray, score: np.ndarray, cell_px: float, vote_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One position for all points of a cell: the one with the highest sum of scores, the first seen of equal ones.

    xy: (N, 2) px, not negative; score: (N,). Cell (i, j) is what rounds to cell_px * (i, j): squares around multiples
    of the cell size, in COLMAP's frame. Positions that compete are the points rounded to multiples of vote_px.
    Returns positions (K, 2) float32, their votes (K,), and each point's position (N,) int64.
    """
    _, cell = np.unique(number_squares(xy, cell_px), return_inverse=True)
    _, spot = np.unique(number_squares(xy, vote_px), return_inverse=True)
    # A spot at the border of two cells stands in the election of each.
    _, first, spot = np.unique(cell * len(xy) + spot, return_index=True, return_inverse=True)
    votes = np.bincount(spot, score, len(first))
    order = np.lexsort((first, -votes, cell[first]))
    _, best = np.unique(cell[first][order], return_index=True)
    winner = order[best]
    return (np.round(xy[first[winner]] / vote_px) * vote_px).astype(np.float32), votes[winner], cell


def number_squares(xy: np.ndarray, side_px: float) -> np.ndarray:
    """(N,) int64: a number for the square, around multiples of side_px, that each point (N, 2) lies in."""
    column, row = np.round(xy / side_px).astype(np.int64).T
    return row * 2**32 + column


def keep_most_voted(position: np.ndarray, votes: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """The `most` positions (K, 2) with most votes (K,), the first of equal ones, in their order; and their votes."""
    kept = np.sort(np.argsort(-votes, kind="stable")[:most])
    return position[kept], votes[kept]
