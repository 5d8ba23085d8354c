"""What `supervise` changes of the fine stage: points of a patch, and coarse matches that are one cell off."""

import csv
import dataclasses
import math
from pathlib import Path

import pytest
import torch

from hm_sfm.config import NetworkConfig
from hm_sfm.errors import ConfigError
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.network.fine import FineEstimate
from hm_sfm.network.homography import apply_homography, homography_from_corners, make_corners
from hm_sfm.network.homonet import HomoNet
from hm_sfm.training import objectives
from hm_sfm.training.loop import train
from hm_sfm.training.losses import SCALE_WEIGHT, measure_errors, measure_loss
from hm_sfm.training.objectives import measure_objective
from hm_sfm.training.supervision import PatchSupervision, draw_point_patches

HALF = 4.0
CENTRE = torch.zeros(1, 2)
GRIDS = LightBackbone.coarse_grid, LightBackbone.fine_grid


def make_supervision() -> PatchSupervision:
    """Six patches that do not move."""
    where = torch.zeros(6, 2, dtype=torch.int64)
    shift = torch.zeros(6, 4, 2)
    still = torch.eye(3).expand(6, 3, 3)
    return PatchSupervision(where[:, 0], where, where, still, shift, torch.ones(6, dtype=torch.bool))


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
        return measure_objective(net, make_batch(), "fine", 400, "fp32", torch.device("cpu"), generator, *supervise)

    default, suppressed, _, _ = (measure(*name) for name in ((), ("suppressed",), ("dense",), ("centre",)))
    off = [apply_homography(t.homography, CENTRE)[t.correct].norm(dim=-1).flatten() for t in supervisions]
    assert default == suppressed and torch.equal(off[0], off[1])
    assert 0.1 < (off[1] > 3.9).float().mean() < 0.4
    assert len(off[2]) == len(off[3]) > 150 and max(off[2].max(), off[3].max()) < 1e-4
    # The same patches are drawn, whatever is supervised.
    assert torch.equal(supervisions[2].cell0, supervisions[3].cell0)


def test_points_of_real_photos_are_not_shifted_either():
    points = torch.rand(1, 300, 2, generator=torch.Generator().manual_seed(2)) * 250
    points = points.repeat(1, 1, 2)
    apart = []
    for share in (0.0, 0.5):
        generator = torch.Generator().manual_seed(4)
        supervision = draw_point_patches(points, (256, 256), 300, *GRIDS, HALF, generator, share)
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
