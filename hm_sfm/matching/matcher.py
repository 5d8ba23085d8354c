"""The network as a whole, its weights files, and HomoMatcher: two images in, PatchMatches out."""

import dataclasses
import hashlib
import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hm_sfm.config import ImageConfig, MatchingConfig, NetworkConfig, parse_config
from hm_sfm.errors import ConfigError, WeightsError
from hm_sfm.geometry.frames import Grid
from hm_sfm.io.atomic import replace_file
from hm_sfm.matching.coarse_matches import PointPairs, make_provider
from hm_sfm.matching.hypotheses import Sketch, apply_hypothesis, retry_hypotheses
from hm_sfm.network.backbone import LightBackbone
from hm_sfm.network.coarse import AspanCoarse, AttentionCoarse, CosineCoarse, LoftrCoarse
from hm_sfm.network.fine import ExpectationHead, FineMap, HomographyHead, make_fine_map
from hm_sfm.network.growth import GridMatches, PatchGrid, grow_matches
from hm_sfm.network.homography import is_regular, make_corners
from hm_sfm.network.resnet import LoftrBackbone
from hm_sfm.photos.images import PreparedImage, prepare_array, prepare_image, read_ref
from hm_sfm.types import ImageRef, PatchMatches

WEIGHTS_FOLDER = Path(__file__).parents[1] / "network" / "weights"
FINE_CHUNK = 512
"""Patches per call of the fine head: bounds its memory to about 50 MB."""
FINE_STEP = 64
"""Calls with fewer are filled up to a multiple of this: PyTorch keeps memory for every number it was ever called with."""
GROWING_SCORE = 0.5
"""Matches at least as good as this spread to their neighbours."""
GROWING_ROUNDS = 8
"""How many cells far they spread."""


class HomoNet(nn.Module):
    """Backbone, coarse stage and fine head, called one by one: features once per image, the rest per pair.

    Raises ConfigError where the configuration names no known backbone or head, or an impossible size.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        if config.window < 5 or (config.window - 1) & (config.window - 2):
            raise ConfigError(f"network.window must be 5, 9, 17 ..., found {config.window}")
        for field, least in (("radius", 0), ("iterations", 1), ("margin", 0)):
            if getattr(config, field) < least:
                raise ConfigError(f"network.{field} must be at least {least}, found {getattr(config, field)}")
        spacing = config.spacing
        if spacing < 1 or spacing & (spacing - 1) or spacing > (config.window - 1) // 2:
            raise ConfigError(
                f"network.spacing must be a power of 2 up to {(config.window - 1) // 2}, half of network.window, found "
                f"{spacing}"
            )
        if config.backbone not in ("light", "loftr"):
            raise ConfigError(f"network.backbone must be light or loftr, found {config.backbone!r}")
        light = config.backbone == "light"
        self.backbone = LightBackbone() if light else LoftrBackbone()
        if config.coarse == "attention":
            self.coarse = AttentionCoarse() if light else LoftrCoarse()
        elif config.coarse == "aspan":
            self.coarse = AspanCoarse(channels=64, heads=4, blocks=2) if light else AspanCoarse()
        elif config.coarse == "cosine":
            self.coarse = CosineCoarse()
        else:
            raise ConfigError(f"network.coarse must be attention, aspan or cosine, found {config.coarse!r}")
        if config.head == "homography":
            self.head = HomographyHead(config.window, config.radius, config.iterations, config.margin, spacing)
        elif config.head == "expectation":
            self.head = ExpectationHead(config.window, config.margin)
        else:
            raise ConfigError(f"network.head must be homography or expectation, found {config.head!r}")


@dataclass(frozen=True)
class ImageFeatures:
    """Features of one image, ready to be matched with any other's."""

    coarse: Tensor
    """(N, C) float32, as the coarse stage describes them: the 1/8 cells whose centre lies in the image."""
    cell: Tensor
    """(N, 2) int64: their grid positions (x, y)."""
    fine: FineMap
    scaled_wh: tuple[int, int]
    stored_from_scaled: np.ndarray
    """(3, 3) float64: px of the network's input -> px of the stored image."""
    image: ImageRef
    found: dict[str, Any]
    """What the provider of coarse matches wants to know of the image, see CoarseProvider.describe."""

    @property
    def size_bytes(self) -> int:
        """Memory that the features take."""
        found = [value for value in self.found.values() if hasattr(value, "nbytes")]
        return sum(array.nbytes for array in (self.coarse, self.cell, self.fine.cells, *found))


class NetworkCoarse:
    """The coarse stage of the network itself, as a provider of coarse matches: points on the grid of its cells."""

    def __init__(self, net: HomoNet, threshold: float) -> None:
        self.net, self.threshold = net, threshold

    def describe(self, image: PreparedImage) -> dict[str, Any]:
        """Nothing: its features come with the fine ones."""
        return {}

    def match(self, features0: ImageFeatures, features1: ImageFeatures) -> PointPairs:
        """The score is the coarse stage's confidence. A point is the fine cell nearest to its coarse cell's centre."""
        backbone = self.net.backbone
        with autocast(features0.coarse.device):
            index0, index1, confidence = self.net.coarse.match(features0.coarse, features1.coarse, self.threshold)
        xy0, xy1 = (
            backbone.fine_grid.to_px(
                fine_cell_of(features.cell[index], backbone.coarse_grid, backbone.fine_grid).cpu().numpy()
            )
            for features, index in ((features0, index0), (features1, index1))
        )
        return PointPairs(xy0, xy1, confidence.float().cpu().numpy(), index0=index0.cpu().numpy())


class HomoMatcher:
    """Matches two images: a network on a device, with the thresholds of the configuration.

    Raises ConfigError, MissingPackageError or InputError where the configuration's coarse matches cannot be had, see
    make_provider.
    """

    def __init__(self, net: HomoNet, config: MatchingConfig, images: ImageConfig) -> None:
        self.device = pick_device(config.device)
        self.net = net.to(self.device).eval().requires_grad_(False)
        self.net.backbone.to(memory_format=torch.channels_last)  # half the time on a CPU
        self.config, self.images = config, images
        self.provider = make_provider(config, self.device) or NetworkCoarse(self.net, config.coarse_threshold)

    @classmethod
    def from_pretrained(
        cls, name: str = "light", *, config: MatchingConfig | None = None, images: ImageConfig | None = None,
        network: NetworkConfig | None = None,
    ) -> "HomoMatcher":  # fmt: skip
        """The matcher with bundled weights (`light`) or those of a file.

        Raises WeightsError where the file is missing, damaged or does not fit `network`.
        """
        net = load_weights(name, network)
        return cls(net, config or MatchingConfig(), images or ImageConfig())

    def match(self, image0: str | Path | np.ndarray, image1: str | Path | np.ndarray) -> PatchMatches:
        """Match two images, each a path or an HxW or HxWx3 (RGB) uint8 array.

        Coordinates are px of the images as stored. Raises InputError on an unreadable image.
        """
        images = [self._prepare(image) for image in (image0, image1)]
        return retry_hypotheses(
            self,
            self.match_features(*(self.encode(image) for image in images)),
            lambda side, hypothesis: self.encode(apply_hypothesis(images[side], hypothesis)),
            lambda side: Sketch(self, images[side]),
        )

    def _prepare(self, image: str | Path | np.ndarray) -> PreparedImage:
        if isinstance(image, np.ndarray):
            return prepare_array(image, self.images.long_edge_px)
        return prepare_image(read_ref(Path(image)), self.images.long_edge_px)

    @torch.inference_mode()
    def encode(self, image: PreparedImage) -> ImageFeatures:
        """Features of a prepared image."""
        backbone = self.net.backbone
        pixels = pad_image(torch.tensor(image.grey, device=self.device), backbone.stride, backbone.standardised)
        with autocast(self.device):
            maps = backbone(pixels)
            columns, rows = (count_cells(size, backbone.coarse_grid) for size in image.scaled_wh)
            coarse = self.net.coarse.describe(maps.coarse[:, :, :rows, :columns])
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        return ImageFeatures(
            coarse=coarse[0].flatten(1).T.contiguous(),
            cell=torch.stack([x, y], dim=-1).reshape(-1, 2).to(self.device),
            fine=make_fine_map(maps.fine),
            scaled_wh=image.scaled_wh,
            stored_from_scaled=image.stored_from_scaled,
            image=image.ref,
            found=self.provider.describe(image),
        )

    @torch.inference_mode()
    def encode_plain(self, image: PreparedImage) -> Tensor:
        """(N, C) float32 of unit length: the 1/8 cells as the backbone sees them, without what only matching needs."""
        backbone = self.net.backbone
        pixels = pad_image(torch.tensor(image.grey, device=self.device), backbone.stride, backbone.standardised)
        with autocast(self.device):
            coarse = backbone(pixels, want_fine=False).coarse
        columns, rows = (count_cells(size, backbone.coarse_grid) for size in image.scaled_wh)
        return F.normalize(coarse[0, :, :rows, :columns].flatten(1).T.float(), dim=1)

    @torch.inference_mode()
    def encode_coarse(self, image: PreparedImage) -> Tensor:
        """(H, W, C) float32: the cells of ImageFeatures.coarse on their grid, without the rest."""
        backbone = self.net.backbone
        pixels = pad_image(torch.tensor(image.grey, device=self.device), backbone.stride, backbone.standardised)
        columns, rows = (count_cells(size, backbone.coarse_grid) for size in image.scaled_wh)
        with autocast(self.device):
            coarse = self.net.coarse.describe(backbone(pixels, want_fine=False).coarse[:, :, :rows, :columns])
        return coarse[0].permute(1, 2, 0).contiguous()

    @torch.inference_mode()
    def match_coarse(self, coarse0: Tensor, coarse1: Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cells of two images that the network's own coarse stage matches: (M,) int64 of each, counted row by row, and
        their scores (M,) float32.

        coarse0, coarse1: as encode_coarse makes them.
        """
        cells = (coarse.flatten(0, 1) for coarse in (coarse0, coarse1))
        with autocast(self.device):
            index0, index1, score = self.net.coarse.match(*cells, self.config.coarse_threshold)
        return index0.cpu().numpy(), index1.cpu().numpy(), score.float().cpu().numpy()

    @torch.inference_mode()
    def match_features(self, features0: ImageFeatures, features1: ImageFeatures) -> PatchMatches:
        """Match two images by their features; coordinates are px of the stored images."""
        backbone, head = self.net.backbone, self.net.head
        coarse = self.provider.match(features0, features1).keep_best(self.config.max_matches)
        cell0, rest0 = round_to_cells(coarse.xy0, backbone.fine_grid)
        cell1, rest1 = round_to_cells(coarse.xy1, backbone.fine_grid)
        cell0, cell1 = cell0.to(self.device), cell1.to(self.device)

        refine = partial(self.estimate_patches, features0.fine, features1.fine)
        start = None
        if isinstance(head, HomographyHead) and (coarse.linear is not None or rest0.any() or rest1.any()):
            start = make_start(rest0, rest1, coarse.linear, head.half).to(self.device)
        homography, log_scale = refine(cell0, cell1, start)
        good = scale_from_score(GROWING_SCORE, backbone.fine_grid)
        can_grow = isinstance(head, HomographyHead) and coarse.index0 is not None
        if can_grow and torch.count_nonzero(log_scale < good) < self.config.grow_below:
            columns, rows = (count_cells(size, backbone.coarse_grid) for size in features0.scaled_wh)
            first, second = fine_cell_of(torch.tensor([[0, 0], [1, 1]]), backbone.coarse_grid, backbone.fine_grid)
            grid = PatchGrid(columns, rows, int(first[0]), int(second[0] - first[0]), head.half)
            found = GridMatches(torch.tensor(coarse.index0, device=self.device), cell1, homography, log_scale)
            found = grow_matches(found, grid, refine, features1.fine.size_wh, good, GROWING_ROUNDS)
            cell0, cell1 = grid.to_fine(found.index0), found.cell1
            homography, log_scale, rest0 = found.homography, found.log_scale, np.zeros((len(cell0), 2))
        regular = is_regular(homography, head.half).cpu().numpy()
        return self._to_stored(features0, features1, cell0, rest0, cell1, homography, log_scale, regular)

    def estimate_patches(
        self, fine0: FineMap, fine1: FineMap, cell0: Tensor, cell1: Tensor, start: Tensor | None,
        iterations: int | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The head's last word on P patches, some at a time: homographies (P, 3, 3) and logs of error scales (P,).

        cell0, cell1: (P, 2) int64 fine cells; start: (P, 4, 2) cells and iterations, as in HomographyHead.forward.
        """
        homography, log_scale = [torch.zeros(0, 3, 3, device=self.device)], [torch.zeros(0, device=self.device)]
        for first in range(0, len(cell0), FINE_CHUNK):
            chunk = slice(first, first + FINE_CHUNK)
            count = len(cell0[chunk])
            padding = (0, 0, 0, -count % FINE_STEP)
            image = torch.zeros(count + padding[-1], dtype=torch.int64, device=self.device)
            cells = (F.pad(cell[chunk], padding) for cell in (cell0, cell1))
            begin = {} if start is None else {"start": F.pad(start[chunk], (0, 0, *padding)), "iterations": iterations}
            with autocast(self.device):
                estimate = self.net.head(fine0, fine1, image, *cells, **begin)[-1]
            homography.append(estimate.homography[:count])
            log_scale.append(estimate.log_scale[:count])
        return torch.cat(homography), torch.cat(log_scale)

    def _to_stored(self, features0, features1, cell0, rest0, cell1, homography, log_scale, regular) -> PatchMatches:
        """From patch coordinates to px of the stored images; drops irregular patches and those out of an image.

        rest0: (P, 2) float64 cells, the matched points relative to the centres of their patches.
        """
        grid, half = self.net.backbone.fine_grid, self.net.head.half
        stored0 = features0.stored_from_scaled @ cell_to_px(cell0.cpu().numpy(), grid)
        stored1 = features1.stored_from_scaled @ cell_to_px(cell1.cpu().numpy(), grid)
        between = stored1 @ homography.cpu().numpy().astype(np.float64) @ np.linalg.inv(stored0)
        centre0 = stored0[:, :2, 2] + np.einsum("nij,nj->ni", stored0[:, :2, :2], rest0)
        mapped = np.einsum("nij,nj->ni", between[:, :, :2], centre0) + between[:, :, 2]
        between = between / mapped[:, 2, None, None]
        centre1 = mapped[:, :2] / mapped[:, 2:]
        score = score_from_scale(log_scale.cpu().numpy().astype(np.float64), grid)
        keep = (regular & is_inside(centre0, features0) & is_inside(centre1, features1)).nonzero()[0]
        keep = keep[np.argsort(-score[keep], kind="stable")][: self.config.max_matches]
        px_per_cell = np.sqrt(abs(np.linalg.det(features0.stored_from_scaled[:2, :2]))) * grid.stride
        return PatchMatches(
            xy0=centre0[keep],
            xy1=centre1[keep],
            score=score[keep],
            homography=between[keep],
            patch_radius_px=float(half * px_per_cell),
        )


def pad_image(grey: Tensor, stride: int, standardise: bool) -> Tensor:
    """(H, W) float32 in [0, 1] -> (1, 1, H', W'), zero-padded right and bottom to multiples of `stride`.

    standardise: to zero mean and unit variance first.
    """
    if standardise:
        grey = (grey - grey.mean()) / grey.std().clamp_min(1e-3)
    height, width = grey.shape
    return F.pad(grey[None, None], (0, -width % stride, 0, -height % stride))


def count_cells(size_px: int, grid: Grid) -> int:
    """Cells along an axis whose centre lies within `size_px`."""
    return int(np.ceil((size_px - grid.offset) / grid.stride))


def fine_cell_of(coarse_cell: Tensor, coarse_grid: Grid, fine_grid: Grid) -> Tensor:
    """(P, 2) int64 coarse cells -> (P, 2) int64: the fine cell nearest to each one's centre (halves go up)."""
    return torch.floor(fine_grid.from_px(coarse_grid.to_px(coarse_cell.double())) + 0.5).long()


def round_to_cells(xy_px: np.ndarray, grid: Grid) -> tuple[Tensor, np.ndarray]:
    """(P, 2) px of the network's input -> (P, 2) int64 cells nearest to them, and (P, 2) cells from these to them."""
    position = grid.from_px(xy_px)
    cell = np.floor(position + 0.5)
    return torch.tensor(cell, dtype=torch.int64), position - cell


def make_start(rest0: np.ndarray, rest1: np.ndarray, linear: np.ndarray | None, half: float) -> Tensor:
    """(P, 4, 2) float32 cells: the displacements of the patches' corners that bring matched points together.

    rest0, rest1: (P, 2) cells, the points relative to the centres of their patches; linear: (P, 2, 2), see PointPairs.
    """
    corners = make_corners(half).double().numpy()
    around = np.eye(2) if linear is None else linear
    return torch.tensor((corners - rest0[:, None]) @ np.swapaxes(around, -1, -2) + rest1[:, None] - corners).float()


def cell_to_px(cell: np.ndarray, grid: Grid) -> np.ndarray:
    """(P, 2) int64 cells -> (P, 3, 3) float64: patch coordinates around each -> px of the network's input."""
    matrix = np.zeros((len(cell), 3, 3))
    matrix[:, 0, 0] = matrix[:, 1, 1] = grid.stride
    matrix[:, :2, 2] = grid.to_px(cell.astype(np.float64))
    matrix[:, 2, 2] = 1
    return matrix


def is_inside(xy: np.ndarray, features: ImageFeatures) -> np.ndarray:
    """(M,) bool: which points (M, 2), px of the stored image, lie in it."""
    width, height = features.scaled_wh
    corners = features.stored_from_scaled[:2] @ np.array([[0, width], [0, height], [1, 1]])
    return np.all((xy >= corners.min(axis=1)) & (xy < corners.max(axis=1)), axis=1)


def score_from_scale(log_scale: np.ndarray, grid: Grid) -> np.ndarray:
    """Error scale (P,), log cells -> (P,) in [0, 1]: the probability of an error below 1 px (Laplace)."""
    return 1 - np.exp(-1 / (np.exp(log_scale) * grid.stride))


def scale_from_score(score: float, grid: Grid) -> float:
    """The inverse of score_from_scale."""
    return -math.log(-math.log(1 - score) * grid.stride)


def autocast(device: torch.device) -> torch.autocast:
    """Half precision for convolutions and matrix products, where the processor computes it natively."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=computes_in_half(device))


def computes_in_half(device: torch.device) -> bool:
    """Whether the processor computes in half precision natively; fine features take 2 bytes a number then, not 4."""
    return device.type == "cuda" or torch.cpu._is_avx512_bf16_supported()


def pick_device(name: str) -> torch.device:
    """`auto` is CUDA where there is one. Raises ConfigError on an unknown or absent device."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name not in ("cpu", "cuda"):
        raise ConfigError(f"device must be auto, cpu or cuda, found {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("device cuda was asked for, but this PyTorch finds no CUDA GPU")
    return torch.device(name)


def save_weights(path: Path, net: HomoNet) -> None:
    """Write the network's configuration and weights; atomic."""
    with replace_file(path) as temporary:
        torch.save({"network": dataclasses.asdict(net.config), "state_dict": net.state_dict()}, temporary)


def find_weights(name: str) -> Path:
    """The file of bundled weights, or the file that is named. Raises WeightsError where there is neither."""
    bundled = WEIGHTS_FOLDER / f"{name}.pt"
    path = bundled if bundled.exists() else Path(name)
    if not path.is_file():
        names = ", ".join(sorted(p.stem for p in WEIGHTS_FOLDER.glob("*.pt")))
        raise WeightsError(f"model {name!r} is neither a file nor bundled weights ({names})")
    return path


def digest_weights(name: str) -> str:
    """sha256 of a weights file, 64 hex digits. Raises WeightsError where there is none."""
    return hashlib.sha256(find_weights(name).read_bytes()).hexdigest()


def load_weights(name: str, network: NetworkConfig | None = None) -> HomoNet:
    """The network of bundled weights or of a file, with the number of iterations that `network` asks for.

    Raises WeightsError where the file is missing, damaged, not a weights file, or made for another network.
    """
    path = find_weights(name)
    if path.parent == WEIGHTS_FOLDER:
        check_digest(path)
    content = read_checkpoint(path)
    if "network" not in content and network is not None and network.backbone == "loftr":
        if network.coarse == "aspan":
            raise WeightsError(f"{path} has no coarse stage for network.coarse aspan: train one with hm-sfm train")
        if network.head != "expectation":
            raise WeightsError(
                f"{path} has no homography head: train one with hm-sfm train, or take network.head expectation"
            )
        net = HomoNet(network)
        load_loftr(net, path)
        return net
    try:
        made_for = parse_config(content["network"], NetworkConfig, str(path))
        state_dict = content["state_dict"]
    except (KeyError, ConfigError) as error:
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: {error}") from error
    wanted = network or made_for
    for field in dataclasses.fields(NetworkConfig):
        found, asked = getattr(made_for, field.name), getattr(wanted, field.name)
        if field.name != "iterations" and found != asked:
            raise WeightsError(
                f"{path} was trained with network.{field.name} {found!r}, the configuration has {asked!r}"
            )
    net = HomoNet(wanted)
    fit_state(net, state_dict, path)
    return net


def load_loftr(net: HomoNet, path: Path) -> None:
    """Put backbone and coarse stage of a public LoFTR checkpoint into a `loftr` network, by name; the backbone alone where
    the coarse stage is ASpanFormer's.

    Raises WeightsError where the file is damaged, or keys are missing or of another shape.
    """
    content = read_checkpoint(path)
    source = {key.removeprefix("matcher."): value for key, value in content.get("state_dict", content).items()}
    parts = [(net.backbone, "backbone."), (net.coarse, "loftr_coarse.")]
    for part, prefix in parts[:1] if isinstance(net.coarse, AspanCoarse) else parts:
        fit_state(
            part, {key.removeprefix(prefix): value for key, value in source.items() if key.startswith(prefix)}, path
        )


def load_parts(net: HomoNet, content: dict, path: Path) -> list[str]:
    """Put what fits of a weights file into a network, part by part; returns the names of the parts that do not fit.

    content: as read_checkpoint returns it. Raises WeightsError where it is damaged or nothing fits.
    """
    state = content.get("state_dict")
    if not isinstance(state, dict):
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: it has no state_dict")
    parts = {"trunk": "backbone.trunk.", "fine": "backbone.fine.", "coarse": "coarse.", "head": "head."}
    if net.config.backbone != "light":
        parts = {"backbone": "backbone.", "coarse": "coarse.", "head": "head."}
    modules = {name: net.get_submodule(prefix[:-1]) for name, prefix in parts.items()}
    modules = {name: module for name, module in modules.items() if module.state_dict()}
    misfits = []
    for name, module in modules.items():
        prefix = parts[name]
        own = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        if describe_misfit(module.state_dict(), own):
            misfits.append(name)
        else:
            module.load_state_dict(own, strict=False)  # checked above
    if len(misfits) == len(modules):
        raise WeightsError(f"{path} fits no part of the network: {describe_misfit(net.state_dict(), state)}")
    return misfits


def read_checkpoint(path: Path) -> dict:
    """The content of a weights file or LoFTR checkpoint. Raises WeightsError where it is damaged or no dictionary."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise WeightsError(
            f"{path} is damaged or no hm_sfm weights file: {' '.join(str(error).split())[:200]}"
        ) from error
    if not isinstance(content, dict):
        raise WeightsError(f"{path} is damaged or no hm_sfm weights file: it holds a {type(content).__name__}")
    return content


def fit_state(module: nn.Module, state: dict[str, Tensor], path: Path) -> None:
    """load_state_dict. Raises WeightsError that names the missing, unexpected and misshapen keys."""
    misfit = describe_misfit(module.state_dict(), state)
    if misfit:
        raise WeightsError(f"{path} does not fit the network: {misfit}")
    module.load_state_dict(state, strict=False)  # checked above


def describe_misfit(wanted: dict[str, Tensor], found: dict[str, Tensor]) -> str:
    """Which keys of `found` are missing, unexpected or of another shape, in words; empty where all fit."""
    if not isinstance(found, dict):
        return f"it holds a {type(found).__name__} in place of named tensors"
    # Batch norms count their batches, which nothing uses; older files do without.
    missing = [key for key in wanted if key not in found and not key.endswith("num_batches_tracked")]
    unexpected = [str(key) for key in found if key not in wanted]
    misshapen = [
        f"{key} ({describe_shape(found[key])}, expected {describe_shape(value)})"
        for key, value in wanted.items()
        if key in found and describe_shape(found[key]) != describe_shape(value)
    ]
    kinds = {"missing": missing, "unexpected": unexpected, "of another shape": misshapen}
    return "; ".join(f"{kind}: {shorten_list(keys)}" for kind, keys in kinds.items() if keys)


def describe_shape(value: Tensor) -> str:
    """Such as 64 x 24 x 3 x 3, or `scalar`; the type's name of what is no tensor."""
    if not isinstance(value, Tensor):
        return type(value).__name__
    return " x ".join(map(str, value.shape)) or "scalar"


def shorten_list(names: list[str], most: int = 3) -> str:
    """The first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def check_digest(path: Path) -> None:
    """Compare bundled weights with the sha256 beside them. Raises WeightsError where they differ."""
    expected = path.with_suffix(".sha256").read_text().split()[0]
    found = digest_weights(str(path))
    if found != expected:
        raise WeightsError(f"{path} is damaged: its sha256 is {found[:16]}..., expected {expected[:16]}...")
