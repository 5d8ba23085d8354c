"""Weights files, and matching two images from the outside."""

import dataclasses
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from hm_sfm import HomoMatcher
from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig, load_config
from hm_sfm.errors import ConfigError, InputError, WeightsError
from hm_sfm.matching.patches import scale_from_score, score_from_scale
from hm_sfm.network import checkpoints
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.network.checkpoints import digest_weights, load_parts, load_weights, save_weights
from hm_sfm.network.device import pick_device
from hm_sfm.network.homonet import HomoNet
from hm_sfm.types import PatchMatches


def make_texture(width: int, height: int, seed: int = 0) -> np.ndarray:
    """(H, W) uint8: smoothed noise of two scales."""
    noise = np.random.default_rng(seed).normal(size=(2, height, width))
    layers = [cv2.GaussianBlur(layer, (0, 0), sigma) for layer, sigma in zip(noise, (1.5, 6.0))]
    mixed = sum(layer / layer.std() for layer in layers)
    return np.clip(128 + 40 * mixed, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def matcher() -> HomoMatcher:
    return HomoMatcher.from_pretrained("light")


@pytest.fixture
def small_net() -> HomoNet:
    torch.manual_seed(0)
    return HomoNet(NetworkConfig(window=5, iterations=1, margin=0))


# Weights files


def test_weights_survive_writing_and_reading(tmp_path, small_net):
    path = tmp_path / "weights.pt"
    save_weights(path, small_net)
    read = load_weights(str(path))
    assert read.config == small_net.config
    assert all(torch.equal(value, read.state_dict()[name]) for name, value in small_net.state_dict().items())
    assert [p.name for p in tmp_path.iterdir()] == ["weights.pt"]


def test_unknown_names_are_refused_and_the_bundled_ones_named():
    with pytest.raises(WeightsError, match="'lihgt'.*light"):
        HomoMatcher.from_pretrained("lihgt")


def test_a_folder_is_no_weights_file(tmp_path):
    with pytest.raises(WeightsError, match="neither a file"):
        HomoMatcher.from_pretrained(str(tmp_path))


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda data: b"", id="empty"),
        pytest.param(lambda data: b"no weights at all", id="text"),
        pytest.param(lambda data: data[: len(data) // 2], id="cut short"),
        pytest.param(lambda data: data[:-20], id="end missing"),
    ],
)
def test_damaged_files_are_refused(tmp_path, small_net, spoil):
    path = tmp_path / "weights.pt"
    save_weights(path, small_net)
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(WeightsError, match="weights.pt is damaged or no hm_sfm weights file"):
        HomoMatcher.from_pretrained(str(path))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param({}, id="nothing in it"),
        pytest.param([1, 2], id="a list"),
        pytest.param({"conv.weight": torch.zeros(3)}, id="another network's"),
        pytest.param({"network": {"depth": 3}, "state_dict": {}}, id="an unknown configuration"),
        pytest.param({"network": {}, "state_dict": {}}, id="no tensors"),
        pytest.param({"network": {}, "state_dict": [1]}, id="tensors are no dict"),
        pytest.param({"network": {}, "state_dict": {"head.corners.weight": torch.zeros(1)}}, id="other tensors"),
    ],
)
def test_foreign_files_are_refused(tmp_path, content):
    path = tmp_path / "foreign.pt"
    torch.save(content, path)
    with pytest.raises(WeightsError, match="foreign.pt"):
        HomoMatcher.from_pretrained(str(path))


def test_files_with_code_are_not_run(tmp_path):
    path = tmp_path / "code.pt"
    torch.save({"network": print}, path)
    with pytest.raises(WeightsError, match="code.pt"):
        load_weights(str(path))


@pytest.mark.parametrize(
    ("field", "value"), [("window", 17), ("radius", 3), ("margin", 0), ("head", "expectation"), ("backbone", "loftr")]
)
def test_weights_of_another_network_are_refused_and_the_field_is_named(field, value):
    network = NetworkConfig(**{field: value})
    with pytest.raises(WeightsError, match=f"network.{field} .*{value!r}"):
        HomoMatcher.from_pretrained("light", network=network)


def test_the_number_of_iterations_may_differ_from_the_training():
    assert load_weights("light", NetworkConfig(iterations=1)).head.iterations == 1
    with pytest.raises(ConfigError, match="network.iterations"):
        load_weights("light", NetworkConfig(iterations=0))


def test_what_does_not_fit_is_named_by_its_keys(tmp_path, small_net):
    state = small_net.state_dict()
    names = [name for name in state if name.startswith("head.")]
    shape = " x ".join(map(str, state[names[0]].shape))
    changed = {name: value for name, value in state.items() if name not in names[1:6]}
    changed |= {names[0]: torch.zeros(7), "head.hidden": torch.zeros(1)}
    path = tmp_path / "changed.pt"
    torch.save({"network": dataclasses.asdict(small_net.config), "state_dict": changed}, path)
    with pytest.raises(WeightsError) as error:
        load_weights(str(path))
    assert str(error.value) == (
        f"{path} does not fit the network: missing: {', '.join(names[1:4])} and 2 more; unexpected: head.hidden; "
        f"of another shape: {names[0]} (7, expected {shape})"
    )


@pytest.mark.parametrize("coarse", ["attention", "cosine"])
def test_parts_that_do_not_fit_start_new(tmp_path, small_net, coarse):
    """From a network with another window to one with or without attention: the trunk, and what else fits, is kept."""
    source = HomoNet(NetworkConfig(coarse="attention", window=5, iterations=1, margin=0))
    state = source.state_dict()
    del state["backbone.fine.local.0.weight"]
    state["head.extra"] = torch.zeros(2)
    net = HomoNet(NetworkConfig(coarse=coarse, window=5, iterations=1, margin=0))
    before = {name: value.clone() for name, value in net.state_dict().items()}
    assert load_parts(net, {"state_dict": state}, tmp_path / "a.pt") == ["fine", "head"]
    for name, value in net.state_dict().items():
        kept = name.startswith(("backbone.trunk.", "coarse."))
        assert torch.equal(value, state[name] if kept else before[name])


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({}, "fits no part of the network: missing: backbone.trunk"),
        ({"fc.weight": torch.zeros(3)}, "missing: .* more; unexpected: fc.weight$"),
        ({"backbone.trunk.skip1.1.weight": 5}, r"of another shape: .*skip1.1.weight \(int, expected 24 x 1 x 1 x 1\)"),
        ([1], "it has no state_dict"),
    ],
)
def test_weights_of_which_nothing_fits_are_refused(tmp_path, small_net, state, message):
    with pytest.raises(WeightsError, match=f"a.pt.*{message}"):
        load_parts(small_net, {"state_dict": state}, tmp_path / "a.pt")


def test_one_flipped_byte_in_the_bundled_weights_is_noticed(tmp_path, monkeypatch):
    folder = tmp_path / "weights"
    shutil.copytree(checkpoints.WEIGHTS_FOLDER, folder)
    monkeypatch.setattr(checkpoints, "WEIGHTS_FOLDER", folder)
    load_weights("light")
    data = bytearray((folder / "light.pt").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "light.pt").write_bytes(data)
    with pytest.raises(WeightsError, match="light.pt is damaged: its sha256"):
        load_weights("light")


def test_the_digest_is_that_of_the_file(tmp_path):
    path = tmp_path / "a.pt"
    path.write_bytes(b"abc")
    assert digest_weights(str(path)) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA GPU")
def test_an_absent_device_is_refused():
    with pytest.raises(ConfigError, match="cuda"):
        pick_device("cuda")


# Matching


def test_a_shifted_image_matches_by_its_shift(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture[:, :288], texture[8:, 16:])
    assert len(found) > 300
    offset = found.xy1 - found.xy0
    assert (np.linalg.norm(offset - [-16, -8], axis=1) < 1).mean() > 0.9
    assert found.xy0.dtype == found.xy1.dtype == found.score.dtype == found.homography.dtype == np.float32


def test_the_fast_configuration_matches_a_shifted_image():
    config = load_config(Path(__file__).parents[2] / "configs" / "light_fast.yaml")
    fast = HomoMatcher.from_pretrained(config.matching.model, config=config.matching, network=config.network)
    texture = make_texture(260, 200)
    found = fast.match(texture[:, :240], texture[:, 20:])
    good = found.score >= config.verification.min_score
    assert good.sum() > 300
    assert np.mean(np.linalg.norm(found.xy1 - (found.xy0 - [20, 0]), axis=1)[good] < 1) > 0.9


def test_features_lie_channels_last_which_is_twice_as_fast(matcher):
    with torch.inference_mode():
        maps = matcher.net.backbone(torch.rand(1, 1, 64, 96))
    for features in (maps.coarse, maps.fine):
        assert features.is_contiguous(memory_format=torch.channels_last)


def test_matches_come_best_first(matcher):
    found = matcher.match(make_texture(160, 128), make_texture(192, 128)[:, 10:])
    assert len(found) > 20
    assert (np.diff(found.score) <= 0).all()
    assert found.score.max() <= 1 and found.score.min() >= 0 and found.score[0] > found.score[-1]


def test_homographies_put_the_centres_where_the_matches_are(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture, cv2.resize(texture, (290, 250)))
    centre = np.concatenate([found.xy0, np.ones((len(found), 1))], axis=1)
    mapped = np.einsum("nij,nj->ni", found.homography.astype(float), centre)
    np.testing.assert_allclose(mapped[:, 2], 1, atol=1e-4)
    np.testing.assert_allclose(mapped[:, :2], found.xy1, atol=0.02)


def test_homographies_know_the_scale(matcher):
    texture = make_texture(320, 240)
    found = matcher.match(texture, cv2.resize(texture, None, fx=0.8, fy=0.8, interpolation=cv2.INTER_AREA))
    # The derivative at the centre, where the denominator is 1.
    jacobian = found.homography[:, :2, :2] - found.xy1[:, :, None] * found.homography[:, 2:, :2]
    assert np.median(np.linalg.det(jacobian.astype(float))) == pytest.approx(0.64, abs=0.06)


@pytest.mark.parametrize("size_wh", [(37, 45), (64, 33), (101, 77), (32, 32)])
def test_matches_lie_in_images_of_any_size(matcher, size_wh):
    image = make_texture(*size_wh)
    found = matcher.match(image, image)
    for xy in (found.xy0, found.xy1):
        assert (xy >= 0).all() and (xy < size_wh).all()


def test_reduced_photos_give_matches_in_stored_pixels():
    images = ImageConfig(long_edge_px=160)
    matcher = HomoMatcher.from_pretrained("light", images=images)
    large = cv2.resize(make_texture(160, 120), (640, 480), interpolation=cv2.INTER_CUBIC)
    found = matcher.match(large, large)
    assert found.xy0.max() > 500
    assert found.patch_radius_px == pytest.approx(4 * 2 * 4)
    assert (np.linalg.norm(found.xy1 - found.xy0, axis=1) < 4).mean() > 0.9


def write_pair(folder: Path, texture: np.ndarray) -> tuple[list[np.ndarray], list[Path]]:
    """Two views of a texture, (H, W) grey or (H, W, 3) RGB, as arrays and as files."""
    arrays = [texture[:, :160], texture[:, 30:]]
    paths = [folder / "a.png", folder / "b.png"]
    for path, array in zip(paths, arrays):
        # OpenCV writes BGR.
        cv2.imwrite(str(path), array[..., ::-1] if array.ndim == 3 else array)
    return arrays, paths


def test_colour_arrays_are_rgb(matcher, tmp_path):
    """OpenCV's PNG reader rounds grey otherwise than its colour conversion: equal up to that."""
    layers = [make_texture(190, 120, seed) for seed in range(3)]
    arrays, paths = write_pair(tmp_path, np.stack(layers, axis=-1))
    by_array, by_path = matcher.match(*arrays), matcher.match(*paths)
    common, at_array, at_path = np.intersect1d(by_array.xy0 @ [1, 1000], by_path.xy0 @ [1, 1000], return_indices=True)
    assert len(common) > 0.9 * max(len(by_array), len(by_path)) > 50
    apart = np.linalg.norm(by_array.xy1[at_array] - by_path.xy1[at_path], axis=1)
    assert np.median(apart) < 0.05


def test_arrays_and_files_give_the_same_matches(matcher, tmp_path):
    arrays, paths = write_pair(tmp_path, make_texture(190, 120))
    by_array, by_path, by_name = matcher.match(*arrays), matcher.match(*paths), matcher.match(*map(str, paths))
    assert len(by_array) > 50
    for other in (by_path, by_name):
        for field in dataclasses.fields(PatchMatches):
            assert np.array_equal(getattr(by_array, field.name), getattr(other, field.name)), field.name


def test_unreadable_images_are_refused(matcher, tmp_path):
    (tmp_path / "bad.png").write_bytes(b"no image")
    good = make_texture(64, 64)
    for bad in (tmp_path / "bad.png", tmp_path / "absent.png", np.zeros((64, 64)), np.zeros((8, 8), np.uint8)):
        with pytest.raises(InputError):
            matcher.match(good, bad)


@pytest.mark.parametrize("value", [0, 128, 255])
def test_flat_images_are_no_trouble(matcher, value):
    flat = np.full((96, 128), value, np.uint8)
    for other in (flat, make_texture(128, 96)):
        found = matcher.match(flat, other)
        assert found.xy0.shape == found.xy1.shape == (len(found), 2)
        assert np.isfinite(found.xy1).all() and np.isfinite(found.homography).all()


def test_no_matches_at_all():
    strict = HomoMatcher.from_pretrained("light", config=MatchingConfig(min_cosine=1.1))
    found = strict.match(make_texture(96, 64), make_texture(96, 64))
    assert len(found) == 0 and found.homography.shape == (0, 3, 3)
    xy1, valid = found.warp(np.array([[3.0, 4.0]]))
    assert not valid.any() and np.isnan(xy1).all()
    assert [dense.shape for dense in found.densify(2)] == [(0, 2), (0, 2)]


def test_max_matches_keeps_the_most_similar():
    image = make_texture(160, 128)
    few = HomoMatcher.from_pretrained("light", config=MatchingConfig(max_matches=9)).match(image, image)
    assert 0 < len(few) <= 9


def test_the_expectation_head_matches_too(tmp_path):
    torch.manual_seed(0)
    net = HomoNet(NetworkConfig(head="expectation"))
    net.backbone.load_state_dict(load_weights("light").backbone.state_dict())
    found = HomoMatcher.from_network(net, MatchingConfig(), ImageConfig()).match(*[make_texture(160, 128)] * 2)
    assert len(found) > 50
    assert (np.linalg.norm(found.xy1 - found.xy0, axis=1) < 12).all()


def test_scores_are_probabilities_of_less_than_a_pixel():
    score = score_from_scale(np.log([1e-3, 0.5, 50.0]), LightBackbone.fine_grid)
    np.testing.assert_allclose(score, [1.0, 1 - np.exp(-1), 0.01], atol=1e-3)


# Warping with the result


def two_patches() -> PatchMatches:
    """Patches around (10.5, 10.5), which shifts by (100, 0), and (20.5, 10.5), which doubles about its centre."""
    shift = np.array([[1, 0, 100], [0, 1, 0], [0, 0, 1]])
    double = np.array([[2, 0, -20.5], [0, 2, -10.5], [0, 0, 1]])
    return PatchMatches(
        xy0=[[10.5, 10.5], [20.5, 10.5]], xy1=[[110.5, 10.5], [20.5, 10.5]], score=[0.9, 0.8],
        homography=[shift, double], patch_radius_px=6.0,
    )  # fmt: skip


def test_warp_takes_the_nearest_patch():
    xy1, valid = two_patches().warp(np.array([[10.5, 10.5], [15.0, 10.5], [16.0, 10.5], [21.5, 12.5]]))
    assert valid.all()
    np.testing.assert_allclose(xy1, [[110.5, 10.5], [115.0, 10.5], [11.5, 10.5], [22.5, 14.5]])
    assert xy1.dtype == np.float32


def test_warp_says_where_it_cannot():
    xy1, valid = two_patches().warp(np.array([[10.5, 16.5], [10.5, 16.6], [500.0, -3.0], [np.nan, 0.0]]))
    assert valid.tolist() == [True, False, False, False]
    assert np.isfinite(xy1[0]).all() and np.isnan(xy1[1:]).all()
    xy1, valid = two_patches().warp(np.zeros((0, 2)))
    assert xy1.shape == (0, 2) and valid.shape == (0,)


def test_densify_covers_the_squares_once():
    xy0, xy1 = two_patches().densify(2)
    assert len(xy0) == len(xy1) == 50
    expected = {(x + 0.5, y + 0.5) for y in range(8, 13) for x in [*range(8, 13), *range(18, 23)]}
    assert set(map(tuple, xy0.tolist())) == expected
    warped, valid = two_patches().warp(xy0)
    assert valid.all()
    np.testing.assert_allclose(xy1, warped)
    assert np.array_equal(xy0, xy0[np.lexsort(xy0.T)])


def test_densify_gives_overlaps_to_the_nearest_patch():
    xy0, xy1 = two_patches().densify(6)
    assert len(xy0) == len(np.unique(xy0, axis=0)) == 23 * 13
    by_shift = xy1[:, 0] - xy0[:, 0] == 100
    assert by_shift[xy0[:, 0] < 15].all() and not by_shift[xy0[:, 0] > 16].any()


@pytest.mark.parametrize("radius", [0, 1, 2, 4, 8])
def test_densify_uses_a_patch_for_its_own_pixels_wherever_its_centre_lies(radius):
    """Patch centres of the network lie on corners of pixels; the second patch is far away and maps elsewhere."""
    shift, elsewhere = np.array([[1, 0, 5], [0, 1, 7], [0, 0, 1]]), np.array([[1, 0, 9000], [0, 1, 9000], [0, 0, 1]])
    matches = PatchMatches(
        xy0=[[50.0, 50.0], [500.0, 500.0]], xy1=[[55.0, 57.0], [9500.0, 9500.0]], score=[0.9, 0.8],
        homography=[shift, elsewhere], patch_radius_px=8.0,
    )  # fmt: skip
    xy0, xy1 = matches.densify(radius)
    near = xy0[:, 0] < 100
    assert near.sum() == (2 * radius + 1) ** 2
    np.testing.assert_allclose(xy1[near] - xy0[near], np.tile([5.0, 7.0], (near.sum(), 1)))


@pytest.mark.parametrize("radius", [-1, 7])
def test_densify_refuses_what_the_homographies_do_not_cover(radius):
    with pytest.raises(ValueError, match="radius"):
        two_patches().densify(radius)


def test_the_scale_of_a_score_gives_the_score():
    grid = LightBackbone.fine_grid
    for score in (0.1, 0.5, 0.9):
        assert score_from_scale(np.array([scale_from_score(score, grid)]), grid)[0] == pytest.approx(score)


@pytest.mark.slow
def test_pairs_with_few_good_matches_grow_more():
    """A turn of 30 degrees, which the coarse features bear in places only."""
    image = make_texture(320, 256)
    turn = np.vstack([cv2.getRotationMatrix2D((160, 128), 30, 1), [0, 0, 1]])
    turned = cv2.warpAffine(image, turn[:2], (320, 256), flags=cv2.INTER_CUBIC)

    def match(grow_below: int) -> PatchMatches:
        matcher = HomoMatcher.from_pretrained("light", config=MatchingConfig(grow_below=grow_below))
        found = matcher.match(image, turned)
        return found.select(np.flatnonzero(found.score >= 0.5))

    few, many = match(0), match(10_000)
    assert len(few) >= 5 and len(many) > 1.5 * len(few)
    # OpenCV's frame has the centre of the first pixel at (0, 0).
    true = cv2.transform(many.xy0[None] - 0.5, turn[:2])[0] + 0.5
    assert np.median(np.linalg.norm(many.xy1 - true, axis=1)) < 0.5
    # Where there are enough good matches, nothing changes.
    enough = match(len(few))
    assert np.array_equal(enough.xy0, few.xy0) and np.array_equal(enough.xy1, few.xy1)


def test_weights_without_counters_of_batches_load():
    """Older PyTorch did not count them, and nothing uses them."""
    net = load_weights("light")
    state = {key: value for key, value in net.state_dict().items() if not key.endswith("num_batches_tracked")}
    assert len(state) < len(net.state_dict())
    checkpoints.fit_state(net, state, Path("old.pt"))
    with pytest.raises(WeightsError, match="missing: head.corners.weight"):
        checkpoints.fit_state(net, {k: v for k, v in state.items() if k != "head.corners.weight"}, Path("short.pt"))
