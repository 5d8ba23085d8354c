"""Keypoints: where they are, to the pixel, and what describes them."""

import pytest
import torch
import torch.nn.functional as F

from hm_sfm.network.checkpoints import load_weights
from hm_sfm.network.detector import (
    SUPPRESSION_PX,
    describe_keypoints,
    detect_keypoints,
    find_largest_around,
    sample_map,
)


def make_probability(peaks: dict[tuple[int, int], float], size_wh=(64, 48)) -> torch.Tensor:
    probability = torch.zeros(size_wh[1], size_wh[0])
    for (x, y), value in peaks.items():
        probability[y, x] = value
    return probability


def test_a_keypoint_is_at_the_centre_of_its_pixel_and_the_best_come_first():
    probability = make_probability({(10, 20): 0.3, (40, 8): 0.9, (63, 47): 0.5})
    xy, score = detect_keypoints(probability, torch.ones(6, 8), (64, 48), 10)
    assert xy.tolist() == [[40.5, 8.5], [63.5, 47.5], [10.5, 20.5]]
    assert score.tolist() == pytest.approx([0.9, 0.5, 0.3])


def test_only_the_most_likely_of_a_window_and_only_likely_ones():
    probability = make_probability({(10, 20): 0.3, (12, 22): 0.4, (13, 22): 0.2, (30, 30): 0.04})
    xy, _ = detect_keypoints(probability, torch.ones(6, 8), (64, 48), 10)
    assert xy.tolist() == [[12.5, 22.5]]
    assert len(detect_keypoints(probability * 0, torch.ones(6, 8), (64, 48), 10)[0]) == 0


def test_reliability_counts():
    probability = make_probability({(4, 4): 0.5, (60, 4): 0.6})
    reliability = torch.ones(6, 8)
    reliability[0, 7] = 0.1
    xy, score = detect_keypoints(probability, reliability, (64, 48), 1)
    assert xy.tolist() == [[4.5, 4.5]] and score[0] == pytest.approx(0.5)


def test_no_keypoint_lies_in_the_padding():
    probability = make_probability({(50, 10): 0.9, (10, 40): 0.9, (10, 10): 0.5})
    xy, _ = detect_keypoints(probability, torch.ones(6, 8), (40, 30), 10)
    assert xy.tolist() == [[10.5, 10.5]]


def test_maps_are_sampled_where_their_cells_sit():
    """The centre of cell i is at 8 i + 4 px, so a ramp of cells is a ramp of px."""
    ramp = torch.arange(8.0).expand(6, 8)
    xy = torch.tensor([[4.0, 20.0], [12.0, 20.0], [30.0, 8.0], [35.2, 44.0]])
    values = sample_map(torch.stack([ramp, ramp * 2]), xy)
    torch.testing.assert_close(values, torch.stack([(xy[:, 0] - 4) / 8, (xy[:, 0] - 4) / 4], dim=1))


def test_descriptors_have_unit_length_and_are_the_maps_at_cell_centres():
    coarse = torch.randn(16, 6, 8, generator=torch.Generator().manual_seed(0))
    descriptors = describe_keypoints(coarse, torch.tensor([[20.0, 12.0], [33.0, 17.0]]))
    torch.testing.assert_close(descriptors[0], F.normalize(coarse[:, 1, 2], dim=0))
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(2))


def test_a_bright_dot_is_detected_where_it_is():
    """The bundled heads, on an impulse: half a pixel off would be another pixel."""
    net = load_weights("light").eval()
    image = torch.zeros(1, 1, 96, 128)
    image[..., 44:47, 70:73] = torch.tensor([[1.0, 2.0, 1.0], [2.0, 4.0, 2.0], [1.0, 2.0, 1.0]])
    image = (image - image.mean()) / image.std()
    with torch.inference_mode():
        coarse = net.backbone(image, want_fine=False).coarse
        xy, _ = detect_keypoints(*net.detector(image, coarse), (128, 96), 1)
    assert (xy[0] - torch.tensor([71.5, 45.5])).abs().max() <= 1.0


@pytest.mark.parametrize("size_hw", [(1, 1), (2, 9), (40, 24)])
def test_the_largest_value_around_a_pixel_is_that_of_its_window(size_hw):
    values = torch.randint(0, 9, size_hw, generator=torch.Generator().manual_seed(0)).float()
    expected = F.max_pool2d(values[None], SUPPRESSION_PX, stride=1, padding=SUPPRESSION_PX // 2)[0]
    assert torch.equal(find_largest_around(values), expected)
