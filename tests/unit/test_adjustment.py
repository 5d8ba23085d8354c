"""Joint keypoint adjustment on exact problems with planted noise and outliers."""

import numpy as np
import pytest

from hm_sfm.config import KeypointConfig
from hm_sfm.keypoints.adjustment import Anchors, adjust_keypoints, measure_residuals, predict_targets
from hm_sfm.keypoints.graph import FlatGraph

ROUNDS = KeypointConfig().adjustment_rounds


def make_graph(xy, source, target, predicted, jacobian, score=1.0) -> FlatGraph:
    """Keypoints and edges; the images don't matter here."""
    return FlatGraph(
        image=np.zeros(len(xy), np.int64),
        xy=xy,
        source=source,
        target=target,
        predicted=predicted,
        jacobian=jacobian,
        score=np.broadcast_to(np.array(score, float), len(source)),
    )


def connect(expected, source, target, jacobian, xy, predicted_noise=0.0, rng=None, score=1.0) -> FlatGraph:
    """Keypoints at first positions `xy`, with predictions that hold where they are at `expected`."""
    predicted = expected[target] + np.einsum("eij,ej->ei", jacobian, xy[source] - expected[source])
    predicted += rng.normal(0, predicted_noise, predicted.shape) if predicted_noise else 0
    return make_graph(xy, source, target, predicted, jacobian, score)


def list_pairs(count):
    source, target = np.nonzero(~np.eye(count, dtype=bool))
    return source, target


def test_agreeing_edges_move_nothing():
    rng = np.random.default_rng(0)
    expected = rng.uniform(0, 100, (6, 2))
    source, target = list_pairs(6)
    jacobian = np.eye(2) + rng.uniform(-0.3, 0.3, (len(source), 2, 2))
    graph = connect(expected, source, target, jacobian, expected)
    moved, sigma = adjust_keypoints(graph, ROUNDS)
    np.testing.assert_allclose(moved, expected, atol=1e-9)
    assert sigma.shape == (6,) and (sigma >= 0).all()
    np.testing.assert_allclose(measure_residuals(graph, moved), 0, atol=1e-9)


@pytest.mark.parametrize("backward", [False, True], ids=["as target", "as source"])
def test_a_misplaced_keypoint_returns_where_its_edges_agree(backward):
    """Eight exact neighbours that are themselves held by each other pull one keypoint back."""
    expected = np.random.default_rng(1).uniform(0, 100, (9, 2))
    xy = expected.copy()
    xy[8] += (0.6, -0.4)
    source, target = list_pairs(8)
    others, last = np.arange(8), np.full(8, 8)
    ends = (last, others) if backward else (others, last)
    source, target = np.concatenate([source, ends[0]]), np.concatenate([target, ends[1]])
    jacobian = np.tile(np.array([[1.2, 0.1], [-0.2, 0.9]]), (len(source), 1, 1))
    # Edges are predictions from the first positions: exact ones do not hold where xy is off.
    graph = connect(expected, source, target, jacobian, xy)
    moved, _ = adjust_keypoints(graph, ROUNDS)
    assert np.linalg.norm(xy[8] - expected[8]) > 0.7
    assert np.linalg.norm(moved[8] - expected[8]) < 0.06
    assert np.linalg.norm(moved[:8] - expected[:8], axis=1).max() < 0.05


def test_averaging_reduces_noise():
    rng = np.random.default_rng(2)
    tracks, length, noise = 200, 6, 0.3
    expected = rng.uniform(0, 500, (tracks * length, 2))
    source, target = list_pairs(length)
    first = np.repeat(np.arange(tracks) * length, len(source))
    source, target = first + np.tile(source, tracks), first + np.tile(target, tracks)
    jacobian = np.eye(2) + rng.uniform(-0.1, 0.1, (len(source), 2, 2))
    xy = expected + rng.normal(0, noise, expected.shape)
    graph = connect(expected, source, target, jacobian, xy, noise, rng)
    moved, sigma = adjust_keypoints(graph, ROUNDS)

    def disagreement(positions):
        """Without the shift that all keypoints of a track share: edges cannot know it."""
        off = (positions - expected).reshape(tracks, length, 2)
        return (off - off.mean(axis=1, keepdims=True)).std()

    assert disagreement(moved) < 0.55 * disagreement(xy)
    assert 0.02 < np.median(sigma) < noise


def test_one_outlier_has_little_effect():
    expected = np.random.default_rng(3).uniform(0, 100, (6, 2))
    source, target = list_pairs(6)
    jacobian = np.tile(np.eye(2), (len(source), 1, 1))
    graph = connect(expected, source, target, jacobian, expected)
    graph.predicted[4] += (8.0, -6.0)
    moved, _ = adjust_keypoints(graph, ROUNDS)
    assert np.linalg.norm(moved - expected, axis=1).max() < 0.05
    residual = measure_residuals(graph, moved)
    assert residual[4] > 9 and np.delete(residual, 4).max() < 0.05


def test_a_heavier_edge_counts_more():
    xy = np.zeros((3, 2))
    source, target = np.array([0, 1]), np.array([2, 2])
    predicted = np.array([[0.3, 0.0], [-0.3, 0.0]])
    jacobian = np.tile(np.eye(2), (2, 1, 1))
    graph = make_graph(xy, source, target, predicted, jacobian, [1.0, 0.86])
    moved, _ = adjust_keypoints(graph, ROUNDS)
    assert moved[2, 0] > 0.01


def test_what_a_detector_saw_in_each_image_makes_up_for_errors_that_edges_share():
    rng = np.random.default_rng(4)
    expected = rng.uniform(0, 100, (6, 2))
    source, target = list_pairs(6)
    jacobian = np.tile(np.eye(2), (len(source), 1, 1))
    xy = expected + rng.normal(0, 0.2, expected.shape)
    graph = connect(expected, source, target, jacobian, xy, 0.3, rng, score=0.86)
    seen = Anchors(np.arange(1, 6), expected[1:] + rng.normal(0, 0.05, (5, 2)))
    free, _ = adjust_keypoints(graph, ROUNDS)
    held, _ = adjust_keypoints(graph, ROUNDS, seen)
    assert np.linalg.norm(held - expected, axis=1).mean() < 0.8 * np.linalg.norm(free - expected, axis=1).mean()


def test_a_detection_far_from_what_the_edges_say_hardly_counts():
    expected = np.random.default_rng(3).uniform(0, 100, (6, 2))
    source, target = list_pairs(6)
    jacobian = np.tile(np.eye(2), (len(source), 1, 1))
    graph = connect(expected, source, target, jacobian, expected)
    off = Anchors(np.array([2]), expected[[2]] + (6.0, 8.0))
    moved, _ = adjust_keypoints(graph, ROUNDS, off)
    assert np.linalg.norm(moved - expected, axis=1).max() < 0.05


def test_keypoints_without_edges_stay():
    xy = np.array([[3.0, 4.0], [5.0, 6.0]])
    none = np.zeros(0, np.int64)
    graph = make_graph(xy, none, none, np.zeros((0, 2)), np.zeros((0, 2, 2)))
    moved, sigma = adjust_keypoints(graph, ROUNDS)
    np.testing.assert_allclose(moved, xy)
    assert np.isfinite(sigma).all()


def test_nothing_to_adjust():
    none = np.zeros(0, np.int64)
    no_points, no_matrices = np.zeros((0, 2)), np.zeros((0, 2, 2))
    moved, sigma = adjust_keypoints(make_graph(no_points, none, none, no_points, no_matrices), ROUNDS)
    assert moved.shape == (0, 2) and sigma.shape == (0,)


def test_without_rounds_keypoints_stay_and_their_uncertainty_is_told():
    expected = np.random.default_rng(0).uniform(0, 100, (6, 2))
    xy = expected + [[0.4, 0.0], *[[0.0, 0.0]] * 5]
    source, target = list_pairs(6)
    jacobian = np.tile(np.eye(2), (len(source), 1, 1))
    graph = connect(expected, source, target, jacobian, xy)
    moved, sigma = adjust_keypoints(graph, 0)
    np.testing.assert_array_equal(moved, xy)
    assert sigma.argmax() == 0


def test_a_prediction_moves_with_its_source():
    xy = np.array([[10.0, 10.0], [20.0, 20.0]])
    moved = xy + [[1.0, 0.0], [0.0, 0.0]]
    jacobian = np.array([[[0.0, -2.0], [2.0, 0.0]]])
    graph = make_graph(xy, np.array([0]), np.array([1]), np.array([[20.0, 20.0]]), jacobian)
    np.testing.assert_allclose(predict_targets(graph, moved), [[20.0, 22.0]])
    np.testing.assert_allclose(measure_residuals(graph, moved), [2.0])
