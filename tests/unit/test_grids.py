"""Where the cells of the feature maps sit: half a pixel of error anywhere must fail here.

Symmetric kernels show where the layers put their cells; the bundled weights show it end to end, on images rendered
exactly from a sum of waves. A trained network has a bias of its own of about 0.1 px; opposite motions tell it from an
error of the grid, because the bias stays and the error turns with the motion.
"""

import math

import numpy as np
import pytest
import torch
from torch import nn

from hm_sfm import HomoMatcher
from hm_sfm.config import ImageConfig
from hm_sfm.geometry.frames import Grid
from hm_sfm.matching.patches import fine_cell_of, patch_to_px
from hm_sfm.network.backbone import FineBranch, LightBackbone, XFeatTrunk
from hm_sfm.network.coarse import CosineCoarse, match_by_similarity
from hm_sfm.photos.images import prepare_array
from hm_sfm.training.supervision import patch_homography

COARSE, FINE = LightBackbone.coarse_grid, LightBackbone.fine_grid
SIZE_WH = (352, 288)
OFFSET_LIMIT_PX = 0.2
"""Well below the half pixel that a wrong frame would be off by."""


def make_averaging(module: nn.Module) -> nn.Module:
    """All kernels ones, no biases, identity batch norms: what is left is where the layers look."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.ones_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return module.eval().requires_grad_(False)


def find_centroid(weights: torch.Tensor, grid: Grid) -> tuple[float, float]:
    """(x, y) px of the weights (H, W) on the cells of a grid."""
    weights = weights.double()
    x, y = (grid.to_px(torch.arange(n, dtype=torch.float64)) for n in (weights.shape[1], weights.shape[0]))
    return float((weights.sum(0) * x).sum() / weights.sum()), float((weights.sum(1) * y).sum() / weights.sum())


PIXELS = Grid(stride=1, offset=0.5)


@pytest.mark.parametrize("cell", [(16, 16), (20, 13)])
def test_a_fine_cell_sees_pixels_symmetrically(cell):
    branch = make_averaging(FineBranch())
    image = torch.ones(1, 1, 64, 64, requires_grad=True)
    fine = branch(image, torch.zeros(1, 24, 16, 16), torch.zeros(1, 64, 8, 8))
    (seen,) = torch.autograd.grad(fine[0, 0, cell[1], cell[0]], image)
    assert find_centroid(seen[0, 0], PIXELS) == pytest.approx((FINE.to_px(cell[0]), FINE.to_px(cell[1])))


def test_a_pixel_lights_fine_cells_around_it():
    """The mean over the four pixels of a cell: a pixel alone is not at the centre of any cell."""
    branch = make_averaging(FineBranch())
    image = torch.zeros(1, 1, 64, 64)
    image[..., 24:26, 30:32] = 1.0
    fine = branch(image, torch.zeros(1, 24, 16, 16), torch.zeros(1, 64, 8, 8))
    assert find_centroid(fine[0, 0], FINE) == pytest.approx((31.0, 25.0))


@pytest.mark.parametrize(("level", "stride"), [("quarter", 4), ("eighth", 8)])
def test_context_lands_on_the_fine_cells_of_its_place(level, stride):
    branch = make_averaging(FineBranch())
    maps = {"quarter": torch.zeros(1, 24, 32, 32), "eighth": torch.zeros(1, 64, 16, 16)}
    maps[level][..., 7, 8] = 1.0
    fine = branch(torch.zeros(1, 1, 128, 128), **maps)
    pooled = Grid(stride, stride / 2)
    assert find_centroid(fine[0, 0], FINE) == pytest.approx((pooled.to_px(8), pooled.to_px(7)))


def test_maps_have_the_size_of_their_grids():
    net = LightBackbone().eval()
    with torch.inference_mode():
        maps = net(torch.randn(2, 1, 64, 96))
        quarter, eighth = XFeatTrunk().eval()(torch.randn(1, 1, 64, 96))
    assert maps.coarse.shape == (2, 64, 8, 12) and maps.fine.shape == (2, 48, 32, 48)
    assert quarter.shape == (1, 24, 16, 24) and eighth.shape == (1, 64, 8, 12)
    torch.testing.assert_close(CosineCoarse().describe(maps.coarse).norm(dim=1), torch.ones(2, 8, 12))


@pytest.mark.parametrize("grid", [COARSE, FINE], ids=["coarse", "fine"])
def test_counted_cells_are_those_whose_centre_is_in_the_image(grid):
    for size in range(32, 100):
        assert grid.count_cells(size) == sum(grid.to_px(i) < size for i in range(size))


def test_the_fine_cell_of_a_coarse_one_is_the_nearest():
    cells = torch.stack(torch.meshgrid(torch.arange(5), torch.arange(7), indexing="ij"), dim=-1).reshape(-1, 2)
    fine = fine_cell_of(cells, COARSE, FINE)
    assert fine.dtype == torch.int64
    apart = FINE.to_px(fine.double()) - COARSE.to_px(cells.double())
    # Four fine cells surround a coarse centre at equal distance: the same one is taken everywhere.
    assert torch.equal(apart, torch.ones_like(apart))


def test_patch_frames_agree_between_training_and_matching():
    rng = np.random.default_rng(0)
    b_from_a = np.array([[1.1, -0.2, 7.0], [0.15, 0.9, -4.0], [2e-4, -1e-4, 1.0]])
    cell0, cell1 = rng.integers(10, 100, (2, 6, 2))
    frame0, frame1 = patch_to_px(cell0, FINE), patch_to_px(cell1, FINE)
    patches = patch_homography(torch.tensor(b_from_a).repeat(6, 1, 1), torch.tensor(cell0), torch.tensor(cell1), FINE)
    there_and_back = frame1 @ patches.numpy().astype(np.float64) @ np.linalg.inv(frame0)
    there_and_back /= there_and_back[:, 2:, 2:]
    np.testing.assert_allclose(there_and_back, np.tile(b_from_a, (6, 1, 1)), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(frame0[:, :2, 2], 2 * cell0 + 1)


class Waves:
    """An image that is known at every point: a sum of plane waves of 8 to 150 px."""

    def __init__(self, seed: int, count: int = 80) -> None:
        rng = np.random.default_rng(seed)
        length = np.exp(rng.uniform(np.log(8), np.log(150), count))
        angle, self.phase = rng.uniform(0, 2 * np.pi, (2, count))
        self.frequency = 2 * np.pi / length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.amplitude = 45 * np.sqrt(2 * length / length.sum())

    def render(self, size_wh: tuple[int, int], image_from_waves: np.ndarray) -> np.ndarray:
        """(H, W) uint8: the values at the pixel centres, seen through an affine map."""
        x, y = np.meshgrid(np.arange(size_wh[0]) + 0.5, np.arange(size_wh[1]) + 0.5)
        points = np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        angle = self.frequency @ (np.linalg.inv(image_from_waves) @ points)[:2] + self.phase[:, None]
        value = 128 + self.amplitude @ np.sin(angle)
        return np.clip(np.round(value), 0, 255).astype(np.uint8).reshape(size_wh[::-1])


def about_centre(linear: np.ndarray, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """(3, 3): a linear map about the middle of the image, then a shift."""
    centre = np.array(SIZE_WH) / 2
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = linear, centre + shift - linear @ centre
    return matrix


def rotation(angle_deg: float) -> np.ndarray:
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[cosine, -sine], [sine, cosine]])


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    return HomoMatcher.from_pretrained("light", images=ImageConfig(long_edge_px=max(SIZE_WH)))


@pytest.fixture(scope="module")
def waves() -> Waves:
    return Waves(3)


@pytest.fixture(scope="module")
def image(waves) -> np.ndarray:
    return waves.render(SIZE_WH, np.eye(3))


def measure_offset(matcher: HomoMatcher, image0: np.ndarray, image1: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(2,) px of image 1: the median signed error of the matches of two images."""
    matches = matcher.match(image0, image1)
    assert len(matches) > 300
    expected = np.c_[matches.xy0, np.ones(len(matches))] @ motion[:2].T
    return np.median(matches.xy1 - expected, axis=0)


@pytest.mark.parametrize(
    "motion",
    [
        pytest.param(about_centre(np.eye(2), (3.3, -2.6)), id="shift"),
        pytest.param(about_centre(np.array([[1.08, -0.2], [0.15, 0.95]]), (1.3, 2.1)), id="affine"),
    ],
)
def test_matches_are_not_off(matcher, waves, image, motion):
    offset = measure_offset(matcher, image, waves.render(SIZE_WH, motion), motion)
    assert np.abs(offset).max() < OFFSET_LIMIT_PX


def measure_grid_error(matcher, waves, image) -> float:
    """Px by which the fine grid is off along both axes, from turns to the left and to the right.

    An error d of both axes shows as (I - R) d: for opposite turns, what differs is 2 sin(angle) (d, -d).
    """
    offsets = []
    for angle_deg in (25.0, -25.0):
        motion = about_centre(rotation(angle_deg), (1.3, 2.1))
        offsets.append(measure_offset(matcher, image, waves.render(SIZE_WH, motion), motion))
    difference = offsets[0] - offsets[1]
    return float(difference[0] - difference[1]) / (4 * math.sin(math.radians(25.0)))


@pytest.mark.slow
def test_the_fine_grid_is_where_it_says(matcher, waves, image):
    assert abs(measure_grid_error(matcher, waves, image)) < OFFSET_LIMIT_PX


@pytest.mark.slow
def test_a_fine_grid_half_a_pixel_off_would_be_seen(matcher, waves, image, monkeypatch):
    monkeypatch.setattr(LightBackbone, "fine_grid", Grid(FINE.stride, FINE.offset - 0.5))
    assert abs(measure_grid_error(matcher, waves, image)) > 0.3


def test_a_smaller_image_shows_no_offset_either(matcher, waves, image):
    """An error d of the grid shows as (1 - s) d one way, as (1 - 1 / s) d the other."""
    scale = 0.7
    motion = np.diag([scale, scale, 1.0])
    small = waves.render((int(scale * SIZE_WH[0]), int(scale * SIZE_WH[1])), motion)
    there = measure_offset(matcher, image, small, motion)
    back = measure_offset(matcher, small, image, np.linalg.inv(motion))
    assert np.abs(there).max() < OFFSET_LIMIT_PX
    assert abs((there - back).mean() / (1 / scale - scale)) < OFFSET_LIMIT_PX


@pytest.mark.slow
def test_a_photo_twice_as_large_as_the_matching_resolution(matcher, waves, image):
    """Both photos look the same to the network: what differs is the way back to stored pixels."""
    half = np.diag([0.5, 0.5, 1.0])
    large = waves.render((2 * SIZE_WH[0], 2 * SIZE_WH[1]), np.linalg.inv(half))
    there = measure_offset(matcher, large, image, half)
    back = measure_offset(matcher, image, large, np.linalg.inv(half))
    assert np.abs(there).max() < OFFSET_LIMIT_PX
    np.testing.assert_allclose(back, 2 * there, atol=0.05)


def test_the_coarse_grid_is_where_it_says(matcher, waves, image):
    """An offset d of the coarse grid shows as (1 - s) d between an image and its downscale.

    The trunk's odd strided convolutions alone would put cells at 8 i + 0.5 px: 1 px of difference here.
    """
    scale = 0.7
    small = waves.render((int(scale * SIZE_WH[0]), int(scale * SIZE_WH[1])), np.diag([scale, scale, 1.0]))
    features0, features1 = (matcher.encode(prepare_array(photo, max(SIZE_WH))) for photo in (image, small))
    index0, index1, _ = match_by_similarity(features0.coarse, features1.coarse, 0.8)
    assert len(index0) > 300
    error = COARSE.to_px(features1.cell[index1]) - scale * COARSE.to_px(features0.cell[index0])
    error = error[error.norm(dim=1) < 12]
    assert error.mean(dim=0).abs().max() < 0.5
