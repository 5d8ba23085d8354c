"""What `supervise` changes of the fine stage: points of a patch, and coarse matches that are one cell off."""

import csv
import dataclasses
import math
from pathlib import Path

import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError
from hm_sfm.network.backbone import FeatureMaps, LightBackbone
from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, homography_from_corners, make_corners
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training import objectives
from hm_sfm.training.loop import train
from hm_sfm.training.losses import SCALE_WEIGHT, measure_errors, measure_loss
from hm_sfm.training.objectives import measure_calibration, measure_objective, score_network
from hm_sfm.training.supervision import PatchSupervision, draw_point_patches

HALF = 4.0
CENTRE = torch.zeros(1, 2)
GRIDS = LightBackbone.coarse_grid, LightBackbone.fine_grid


def make_supervision() -> PatchSupervision:
    """Six patches that do not move."""
    where = torch.zeros(6, 2, dtype=torch.int64)
    shift = torch.zeros(6, 4, 2)
    still = torch.eye(3).expand(6, 3, 3)
    return PatchSupervision(where[:, 0], where, where, still, shift, torch.ones(6, dtype=torch.bool), shift)


def make_estimate(displacement: torch.Tensor) -> FineEstimate:
    return FineEstimate(displacement, homography_from_corners(displacement, HALF), torch.zeros(len(displacement)))


def turn_corners(degrees: float) -> torch.Tensor:
    """(6, 4, 2) cells: displacements that turn the patches about their centres."""
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    corners = make_corners(HALF)
    return (corners @ torch.tensor([[cosine, sine], [-sine, cosine]]) - corners).expand(6, 4, 2)


def test_centre_supervision_knows_the_centre_only():
    supervision, turned = make_supervision(), make_estimate(turn_corners(20.0))
    assert measure_errors(turned, supervision, dense=False).shape == (6, 1)
    assert measure_errors(turned, supervision, dense=False).max() < 1e-5
    assert measure_errors(turned, supervision).max() > 0.1
    parts = measure_loss([turned], supervision, HALF, dense=False)
    assert parts["dense"] < 1e-5
    torch.testing.assert_close(parts["loss"], SCALE_WEIGHT * parts["scale"], atol=1e-5, rtol=0)
    assert measure_loss([turned], supervision, HALF)["loss"] > parts["loss"] + 0.1
    moved = make_estimate(torch.full((6, 4, 2), 0.5))
    torch.testing.assert_close(measure_errors(moved, supervision, dense=False), torch.full((6, 1), 0.5**0.5))
    torch.testing.assert_close(
        measure_loss([moved], supervision, HALF, dense=False)["dense"], torch.tensor(0.5**0.5 / HALF)
    )


def make_batch(size_px: int = 64) -> dict[str, torch.Tensor]:
    """A pair of equal views without parallax."""
    image = torch.randint(256, (1, 1, size_px, size_px), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    return {
        "images": image.expand(1, 2, -1, -1),
        "b_from_a": torch.eye(3).view(1, 1, 3, 3),
        "surface": torch.zeros(1, size_px, size_px, dtype=torch.int64),
        "points": torch.full((1, 4, 4), torch.nan),
    }


def test_only_suppressed_supervision_has_matches_that_are_a_cell_off(monkeypatch):
    supervisions = []
    run_fine = objectives.run_fine
    monkeypatch.setattr(objectives, "run_fine", lambda *args: supervisions.append(args[2]) or run_fine(*args))
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(coarse="cosine", iterations=1)).eval()

    def measure(*supervise: str) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(3)
        return measure_objective(net, make_batch(128), "fine", 400, "fp32", torch.device("cpu"), generator, *supervise)

    default, suppressed, _, _ = (measure(*name) for name in ((), ("suppressed",), ("dense",), ("centre",)))
    off = [
        apply_homography(t.homography, CENTRE)[t.correct & ~t.start.any(dim=2).any(dim=1)].norm(dim=-1).flatten()
        for t in supervisions
    ]
    assert default == suppressed and torch.equal(off[0], off[1])
    assert 0.1 < (off[1] > 3.9).float().mean() < 0.4
    assert len(off[2]) == len(off[3]) > 80 and max(off[2].max(), off[3].max()) < 1e-4
    # The same patches are drawn, whatever is supervised.
    assert torch.equal(supervisions[2].cell0, supervisions[3].cell0)


def test_heads_start_where_their_patches_do(monkeypatch):
    """Only homography heads can; LoFTR's has no start."""
    starts = []
    for head in ("homography", "expectation"):
        torch.manual_seed(0)
        net = HomoNet(NetworkConfig(coarse="cosine", iterations=2, head=head)).eval()
        forward = net.head.forward
        monkeypatch.setattr(net.head, "forward", lambda *args, run=forward: starts.append(args[5:]) or run(*args))
        generator = torch.Generator().manual_seed(3)
        measure_objective(net, make_batch(128), "fine", 200, "fp32", torch.device("cpu"), generator)
    (start,), none = starts
    assert none == () and 0.2 < start.any(dim=2).any(dim=1).float().mean() < 0.4


def test_matches_are_judged_by_where_the_truth_is(monkeypatch):
    """Two views 16 px apart, whose cells differ; a head that says nothing but how sure it is."""
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(coarse="cosine")).eval()
    cells = torch.randn(1, 64, 8, 10, generator=torch.Generator().manual_seed(1))
    maps = FeatureMaps(torch.cat([cells[..., :8], cells[..., 2:]]), torch.zeros(2, 48, 32, 32))
    moved = torch.eye(3).repeat(1, 1, 1, 1)
    moved[..., 0, 2] = -16.0
    surface = torch.full((1, 64, 64), -1)
    surface[..., 16:] = 0
    surface[:, :16] = -1
    log_scale = torch.linspace(-2, 2, 48)

    def estimate(fine0, fine1, image_index, cell0, cell1):
        assert not image_index.any() and torch.equal(cell0[:, 0] - cell1[:, 0], torch.full((48,), 8))
        homography = torch.eye(3).repeat(48, 1, 1)
        homography[:, 0, 2] = (cell0[:, 1] >= 30) * 0.6  # 1.2 px off in the last row of cells
        homography[0, 2, 0] = 5.0  # of no use
        return [FineEstimate(torch.zeros(48, 4, 2), homography, log_scale)]

    monkeypatch.setattr(net.head, "forward", estimate)
    batch = {"b_from_a": moved, "surface": surface}
    actual, right = objectives.judge_matches(net, maps, batch, 0.5)
    torch.testing.assert_close(actual, log_scale[1:])
    # Two rows of eight that B does not show, of six cells each, and one row that is off.
    assert right.tolist() == [False] * 11 + [True] * 30 + [False] * 6
    nothing = objectives.judge_matches(net, maps, batch | {"surface": torch.full((1, 64, 64), -1)}, 0.5)
    assert [len(x) for x in nothing] == [0, 0]


def test_calibration_is_the_difference_between_score_and_share_right():
    score = torch.tensor([0.1, 0.1, 0.5, 0.5, 0.5, 0.5, 1.0, 1.0])
    right = torch.tensor([0, 0, 1, 0, 0, 0, 1, 1], dtype=torch.bool)
    values = measure_calibration(score, right)
    assert values["matches_right"] == pytest.approx(37.5)
    assert values["calibration_error"] == pytest.approx(10 * 2 / 8 + 25 * 4 / 8)
    assert [values[f"{name}@{low}"] for low in ("0", "0.4", "0.8") for name in ("score", "right")] == pytest.approx(
        [10, 0, 50, 25, 100, 100]
    )
    # A column for each bin, whatever was matched: they are those of validation.csv.
    assert math.isnan(values["score@0.2"]) and math.isnan(values["right@0.6"])
    assert list(measure_calibration(score[:0], right[:0])) == list(values)


def test_validation_tells_patches_that_start_near_the_truth(monkeypatch):
    """A head that keeps its start: patches that start there are better, those of the identity need not be."""
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(coarse="cosine", iterations=1)).eval()
    keep = lambda samples, target: (torch.zeros(len(target), 4, 2), torch.zeros(len(target)))  # noqa: E731
    monkeypatch.setattr(net.head, "decode", keep)
    batch = make_batch(128)
    batch["b_from_a"] = torch.tensor([[0.7, -0.7, 64.0], [0.7, 0.7, -20.0], [0, 0, 1]]).view(1, 1, 3, 3)
    generator = torch.Generator().manual_seed(0)
    scores = score_network(net, [batch], "fine", 200, 0.2, "fp32", torch.device("cpu"), generator)
    assert scores["started_median_px"] < 3 < scores["median_px"]
    assert 0 <= scores["calibration_error"] <= 100


def test_points_of_real_photos_are_not_shifted_either():
    points = torch.rand(1, 300, 2, generator=torch.Generator().manual_seed(2)) * 250
    points = points.repeat(1, 1, 2)
    apart = []
    for share in (0.0, 0.5):
        generator = torch.Generator().manual_seed(4)
        features = torch.ones(1, 2, 1, 32, 32)
        supervision = draw_point_patches(points, features, 300, *GRIDS, HALF, generator, share)
        apart.append((supervision.cell0 - supervision.cell1)[supervision.correct].abs().amax(dim=1))
    assert len(apart[0]) > 200 and apart[0].max() == 0
    assert (apart[1] == 4).float().mean() > 0.3


@pytest.mark.slow
def test_the_training_is_supervised_as_its_configuration_says(training):
    losses = {}
    for supervise in ("centre", "dense", "suppressed"):
        out = Path(training.out) / supervise
        train(dataclasses.replace(training, supervise=supervise, steps=1, out=str(out)), quiet=True)
        with (out / "log.csv").open() as file:
            losses[supervise] = next(csv.DictReader(file))["loss"]
    assert len(set(losses.values())) == 3
    with pytest.raises(ConfigError, match="supervise must be centre, dense or suppressed, found 'all'"):
        train(dataclasses.replace(training, supervise="all"), quiet=True)
