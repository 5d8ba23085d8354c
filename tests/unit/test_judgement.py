"""Pairs and matches judged by loops: planted wrong ones are given up, and nothing is where no loop speaks."""

import itertools

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hm_sfm.colmap.verification import VerifiedPair
from hm_sfm.config import VerificationConfig
from hm_sfm.judgement.beliefs import choose_believed, weigh_pairs
from hm_sfm.judgement.judgement import judge_pairs
from hm_sfm.judgement.matches import map_patches, vote_on_matches
from hm_sfm.judgement.rotations import measure_rotation_loops
from hm_sfm.judgement.triangles import find_triangles
from hm_sfm.types import ImagePair, PairMatches

WH = (640, 480)
CAMERA = pycolmap.Camera(model="PINHOLE", width=WH[0], height=WH[1], params=[500, 500, 320, 240])


def all_pairs(count: int) -> np.ndarray:
    return np.array(list(itertools.combinations(range(count), 2)), np.int64).reshape(-1, 2)


def relate(rotations: np.ndarray, ends: np.ndarray) -> np.ndarray:
    return rotations[ends[:, 1]] @ np.swapaxes(rotations[ends[:, 0]], 1, 2)


@given(st.integers(0, 9), st.integers(0, 1000))
def test_triangles_are_those_of_the_graph(count, seed):
    ends = all_pairs(count)
    ends = ends[np.random.default_rng(seed).random(len(ends)) < 0.6]
    pair_of = {tuple(end): i for i, end in enumerate(ends.tolist())}
    expected = {
        (pair_of[a, b], pair_of[b, c], pair_of[a, c])
        for a, b, c in itertools.combinations(range(count), 3)
        if {(a, b), (b, c), (a, c)} <= pair_of.keys()
    }
    triangles = find_triangles(ends)
    assert set(map(tuple, triangles.pairs.tolist())) == expected
    assert len(triangles) == len(expected)


def test_the_rotations_of_a_triangle_close_and_a_planted_error_is_what_is_missing():
    ends = all_pairs(5)
    rotations = relate(Rotation.random(5, random_state=0).as_matrix(), ends)
    triangles = find_triangles(ends)
    assert measure_rotation_loops(rotations, triangles) == pytest.approx(np.zeros(10), abs=1e-5)
    rotations[0] = Rotation.from_rotvec([0, np.radians(25), 0]).as_matrix() @ rotations[0]
    loop_deg = measure_rotation_loops(rotations, triangles)
    assert loop_deg == pytest.approx(np.where((triangles.pairs == 0).any(axis=1), 25, 0), abs=1e-5)
    rotations[0] = np.nan
    assert np.isnan(measure_rotation_loops(rotations, triangles)).sum() == 3


def judge_planted(count: int, wrong: list[int], inliers: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Which pairs are kept where those of `wrong` have random rotations."""
    rotations = relate(Rotation.random(count, random_state=1).as_matrix(), ends)
    if wrong:
        rotations[wrong] = Rotation.random(len(wrong), random_state=2).as_matrix()
    triangles = find_triangles(ends)
    closed = np.exp(-0.5 * (measure_rotation_loops(rotations, triangles) / 3) ** 2)
    return choose_believed(ends, *weigh_pairs(inliers, triangles, closed))


def test_planted_wrong_pairs_are_given_up_also_where_they_are_strong():
    ends = all_pairs(9)
    wrong = [0, 5, 12, 13, 20, 27, 35]
    inliers = np.full(len(ends), 300)
    inliers[wrong] = 500
    kept = judge_planted(9, wrong, inliers, ends)
    assert np.flatnonzero(~kept).tolist() == wrong


@pytest.mark.parametrize(
    "ends",
    [[], [(0, 1)], [(0, 1), (1, 2)], [(0, i) for i in range(1, 8)], [(i, i + 1) for i in range(9)]],
    ids=["nothing", "a pair", "three photos without a loop", "a star", "a chain"],
)
def test_without_loops_nothing_is_given_up(ends):
    ends = np.array(ends, np.int64).reshape(-1, 2)
    wrong = list(range(0, len(ends), 2))
    assert judge_planted(10, wrong, np.full(len(ends), 30), ends).all()


def test_of_an_open_triangle_the_weakest_pair_goes_and_no_photo_is_cut_off():
    ends = all_pairs(3)
    assert judge_planted(3, [1], np.array([800, 40, 700]), ends).tolist() == [True, False, True]
    # A photo with two doubtful pairs keeps the better one.
    assert judge_planted(3, [1], np.array([800, 35, 30]), ends).sum() == 2


@settings(deadline=None)
@given(st.integers(2, 8), st.integers(0, 1000))
def test_the_graph_never_falls_apart(count, seed):
    rng = np.random.default_rng(seed)
    ends = all_pairs(count)
    belief, against = rng.random(len(ends)), rng.random(len(ends))
    kept = choose_believed(ends, belief, against)
    parts = {i: {i} for i in range(count)}
    for a, b in ends[kept].tolist():
        merged = parts[a] | parts[b]
        parts.update(dict.fromkeys(merged, merged))
    assert parts[0] == set(range(count))


def make_matches(pair: ImagePair, xy0: np.ndarray, xy1: np.ndarray) -> PairMatches:
    """Matches whose patches move without turning."""
    homography = np.tile(np.eye(3), (len(xy0), 1, 1))
    homography[:, :2, 2] = xy1 - xy0
    score = np.linspace(1, 0.8, len(xy0))
    return PairMatches(pair=pair, xy0=xy0, xy1=xy1, score=score, homography=homography, patch_radius_px=8.0)


def test_a_loop_of_matches_that_misses_is_denied_and_one_that_nobody_sees_is_not():
    a = np.array([[20.0, 20.0], [100.0, 40.0], [200.0, 100.0], [300.0, 300.0]])
    b, c = a + (10, 5), a + (-7, 12)
    b_wrong = b.copy()
    b_wrong[1] += (0, 30)
    ab = make_matches(ImagePair("a", "b"), a, b_wrong)
    ac = make_matches(ImagePair("a", "c"), a[:3], c[:3])
    # What b shows where the wrong match ends goes to c as its surroundings do.
    bc = make_matches(ImagePair("b", "c"), np.vstack([b, b_wrong[1:2]]), np.vstack([c, c[1:2] + (0, 30)]))
    votes = vote_on_matches(map_patches(ab, 1, 1)[0], map_patches(bc, 1, 1)[0], map_patches(ac, 1, 1)[0], 3.0)
    assert votes.tolist() == [1, -1, 1, 0]


def test_votes_do_not_depend_on_the_size_of_the_photos():
    a = np.array([[20.0, 20.0], [100.0, 40.0]])
    b, c = a + (10, 5), a + (-7, 12)
    c[1] += (0, 2)

    def vote(a_scale: float, b_scale: float, c_scale: float) -> list[int]:
        scale = {"a": a_scale, "b": b_scale, "c": c_scale}
        maps = []
        for (name0, xy0), (name1, xy1) in ((("a", a), ("b", b)), (("b", b), ("c", c)), (("a", a), ("c", a + (-7, 12)))):
            moved = np.diag([scale[name1], scale[name1], 1]) @ np.linalg.inv(np.diag([scale[name0], scale[name0], 1]))
            matches = make_matches(ImagePair(name0, name1), xy0 * scale[name0], xy1 * scale[name1])
            homography = np.tile(moved, (len(xy0), 1, 1))
            homography[:, :2, 2] = xy1 * scale[name1] - xy0 * scale[name1]
            matches = PairMatches(
                pair=matches.pair, xy0=matches.xy0, xy1=matches.xy1, score=matches.score, homography=homography,
                patch_radius_px=8.0,
            )  # fmt: skip
            maps.append(map_patches(matches, scale[name0], scale[name1])[0])
        return vote_on_matches(*maps, 1.5).tolist()

    assert vote(1, 1, 1) == vote(6, 0.25, 2) == [1, -1]


@pytest.fixture(scope="module")
def ring() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Seven photos of a wavy wall that is full of points: cam_from_world (3, 4) and the points (N, 2) px, by name."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-1, 1, 45), np.linspace(-0.8, 0.8, 36)))
    points = np.column_stack([x, y, 0.3 * np.sin(4 * x) * np.cos(3 * y)])
    points = points[np.random.default_rng(3).permutation(len(points))]  # matches come best first, wherever they are
    poses, seen = {}, {}
    for number in range(7):
        rotation = Rotation.from_euler("yx", [5 * (number - 3), 3 * (number % 2)], degrees=True).as_matrix()
        pose = np.column_stack([rotation, [0, 0, 4]])
        rays = points @ rotation.T + pose[:, 3]
        poses[f"{number}.jpg"] = pose
        seen[f"{number}.jpg"] = np.asarray(CAMERA.img_from_cam(rays))
    return poses, seen


def collect_pairs(seen, wrong=(), spoilt=None):
    """Verified pairs and their matches; those of `wrong` match points of a rotated scene instead."""
    stored, verified = {}, {}
    for number, (name0, name1) in enumerate(itertools.combinations(sorted(seen), 2)):
        pair = ImagePair(name0, name1)
        xy0, xy1 = seen[name0], seen[name1].copy()
        if number in wrong:
            other = sorted(seen)[(sorted(seen).index(name1) + 3) % len(seen)]
            xy1 = seen[other]
        if pair == spoilt:
            xy1[:40] += (15, 0)
        inside = ((xy0 > 0) & (xy0 < WH) & (xy1 > 0) & (xy1 < WH)).all(axis=1)
        stored[pair] = make_matches(pair, xy0[inside], xy1[inside])
        verified[pair] = VerifiedPair(pair, np.ones(inside.sum(), bool), 100.0)
    return stored, verified


def judge(seen, stored, verified):
    cameras, px_scale = dict.fromkeys(seen, CAMERA), dict.fromkeys(seen, 1.0)
    return judge_pairs(verified, stored.get, cameras, px_scale, VerificationConfig(), quiet=True)


def test_right_pairs_are_kept_as_they_are(ring):
    _, seen = ring
    stored, verified = collect_pairs(seen)
    judgement = judge(seen, stored, verified)
    assert judgement.given_up == ()
    assert list(judgement.pairs) == sorted(verified)
    kept = sum(np.count_nonzero(checked.inliers) for checked in judgement.pairs.values())
    total = sum(np.count_nonzero(checked.inliers) for checked in verified.values())
    # Patches do not turn here, so that at their edges some miss.
    assert kept + judgement.denied_matches == total and judgement.denied_matches < 0.02 * total


def test_pairs_of_other_views_are_given_up_the_least_believed_first(ring):
    _, seen = ring
    wrong = (1, 8, 16)
    stored, verified = collect_pairs(seen, wrong)
    judgement = judge(seen, stored, verified)
    pairs = sorted(verified)
    assert {lost.verified.pair for lost in judgement.given_up} == {pairs[i] for i in wrong}
    assert [lost.belief for lost in judgement.given_up] == sorted(lost.belief for lost in judgement.given_up)
    assert set(judgement.pairs) == set(pairs) - {pairs[i] for i in wrong}


def test_wrong_matches_of_a_right_pair_are_denied(ring):
    _, seen = ring
    spoilt = ImagePair("2.jpg", "3.jpg")
    stored, verified = collect_pairs(seen, spoilt=spoilt)
    judgement = judge(seen, stored, verified)
    assert spoilt in judgement.pairs
    inliers = judgement.pairs[spoilt].inliers
    assert inliers[:40].mean() < 0.2 and inliers[40:].mean() > 0.98
    assert judgement.denied_matches >= np.count_nonzero(~inliers)
    assert judgement.pairs[spoilt].strength == pytest.approx(100 * inliers.mean())


def test_copies_of_one_photo_and_two_scenes_apart_lose_nothing(ring):
    _, seen = ring
    copies = {f"copy {number}.jpg": seen["3.jpg"] for number in range(6)}
    stored, verified = collect_pairs(seen | copies)
    apart = [pair for pair in verified if ("copy" in pair.name0) == ("copy" in pair.name1)]
    judgement = judge(seen | copies, stored, {pair: verified[pair] for pair in apart})
    assert judgement.given_up == () and set(judgement.pairs) == set(apart)
    # The rotation between equal photos is not determined by their essential matrix, and the loops close all the same.
    assert judgement.denied_matches < 0.02 * sum(len(stored[pair]) for pair in apart)


def test_no_pairs_and_pairs_without_loops(ring):
    _, seen = ring
    assert judge(seen, {}, {}).pairs == {}
    stored, verified = collect_pairs({name: seen[name] for name in ("0.jpg", "1.jpg")})
    judgement = judge(seen, stored, verified)
    assert judgement.given_up == () and judgement.denied_matches == 0
    assert all(np.array_equal(judgement.pairs[pair].inliers, verified[pair].inliers) for pair in verified)
