"""Training pairs of MegaDepth in LoFTR's layout, for those who have it: photos, cameras, depth maps, lists of pairs.

Items look like those of photos.WarpedPhotos: every block of 8 x 8 px of view A is a surface of its own, the plane that
fits the depths in and around it, and the plane gives its homography. On a plane the inverse depth is affine in px.

Frames: MegaDepth's intrinsics are those of COLMAP's undistortion, so they are in COLMAP's frame already (the centre of
the top-left pixel is (0.5, 0.5)), and the depth at row r and column c belongs to (c + 0.5, r + 0.5). Intrinsics are
of the photo as stored; a photo and its depth map are of the same size.

Layout: a root folder with `phoenix` (depth maps) and `Undistorted_SfM` (photos), and a folder of scene_info files, all
of which are used: keep those of the test scenes elsewhere. They are pickles: load none that you do not trust.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
import numpy as np
from torch.utils.data import Dataset

from hm_sfm.errors import ConfigError, InputError
from hm_sfm.io.arrays import read_array
from hm_sfm.training.photos import POINTS, disturb_view
from hm_sfm.types import PinholeView

BLOCK_PX = 8
MARGIN_PX = 4
"""The plane of a block is fitted to this much around it too: the supervised points of a patch reach as far."""
FIT_ROUNDS = 6
DEPTH_NOISE = 0.01
"""Relative residual at which a depth has half its weight in the fit of a plane."""
PLANE_TOLERANCE_PX = 0.5
"""How far a pixel may move, in view B, when its own depth is replaced by that of its block's plane."""
PLANAR_SHARE = 0.75
"""Of the pixels around a block that must have a depth and lie on its plane; at depth edges fewer do."""
ROUND_TRIP_PX = 1.0
"""How far from a pixel of A its partner may land when it is transferred back by the depth that B has there."""
DEPTH_TOLERANCE = 0.02
"""Largest relative difference of the two depths of a point in B. LoFTR's is 0.2, enough for its cells of 8 px; the
round trip is the stricter of the two except where there is little parallax."""
KEYS = ("image_paths", "depth_paths", "intrinsics", "poses", "pair_infos")


@dataclass(frozen=True)
class OverlapRange:
    """Which pairs are used: the share of their sparse points that two photos have in common."""

    least: float = 0.1
    most: float = 0.7


@dataclass(frozen=True)
class MegaDepthScene:
    """The N photos of a scene_info file that its chosen pairs name."""

    image_paths: tuple[str, ...]
    depth_paths: tuple[str, ...]
    """Relative to the root folder."""
    K: np.ndarray
    """(N, 3, 3) float64 px of the stored photos, COLMAP frame."""
    cam_from_world: np.ndarray
    """(N, 3, 4) float64."""
    pairs: np.ndarray
    """(M, 2) int64: indices of photos."""


@dataclass(frozen=True)
class DepthView:
    """One photo as training takes it, with the depth map in its own resolution."""

    grey: np.ndarray
    """(h, w) float32 in [0, 255], resized and not yet padded."""
    camera: PinholeView
    """Of `grey`."""
    depth: np.ndarray
    """(h0, w0) float32 z-depth in the stored photo's pixels, 0 where unknown."""


class MegaDepthPairs(Dataset):
    """Items as photos.WarpedPhotos, with one homography per block of 8 x 8 px, row by row, in place of SURFACES.

    root: the folder that the paths in the scene_info files start from; scene_info: the folder with these files, *.npz;
    size_wh: multiples of 8 px, into which photos are resized whole, padded with zeros at the right or the bottom.
    Item i depends on the seed and on i alone: it draws a file, and a pair of it whose overlap lies within `overlap`.

    Raises InputError where a folder or file is missing or unusable or no pair is left, ConfigError on another size_wh.
    A photo or depth map that turns out to be damaged raises InputError when its item is made.
    """

    def __init__(
        self,
        root: Path,
        scene_info: Path,
        size_wh: tuple[int, int],
        seed: int,
        count: int,
        overlap: OverlapRange = OverlapRange(),
    ) -> None:
        if any(side < BLOCK_PX or side % BLOCK_PX for side in size_wh):
            raise ConfigError(f"the size of MegaDepth's views must be multiples of {BLOCK_PX} px, found {size_wh}")
        self.root, self.size_wh, self.seed, self.count = Path(root), size_wh, seed, count
        self.scenes = load_scenes(self.root, Path(scene_info), overlap)

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng([self.seed, index, 4])
        scene = self.scenes[rng.integers(len(self.scenes))]
        pair = rng.permutation(scene.pairs[rng.integers(len(scene.pairs))])
        view_a, view_b = (read_view(self.root, scene, photo, self.size_wh) for photo in pair)
        b_from_a, surface = relate_depths(view_a, view_b, self.size_wh)
        images = np.zeros((2, *surface.shape), np.uint8)
        for index_in_pair, view in enumerate((view_a, view_b)):
            height, width = view.grey.shape
            images[index_in_pair, :height, :width] = disturb_view(view.grey, rng)
        return {
            "images": images,
            "b_from_a": b_from_a,
            "surface": surface,
            "points": np.full((POINTS, 4), np.nan, np.float32),
        }


def load_scenes(root: Path, scene_info: Path, overlap: OverlapRange) -> list[MegaDepthScene]:
    """The scene_info files of a folder, sorted by name, less those without a pair in the range.

    Raises InputError where a folder is missing, a file is damaged or names a photo or depth map that does not exist,
    or no pair is left.
    """
    for folder in (root, scene_info):
        if not folder.is_dir():
            raise InputError(
                f"the MegaDepth folder {folder} " + ("is not a folder" if folder.exists() else "is missing")
            )
    paths = sorted(scene_info.glob("*.npz"))
    if not paths:
        raise InputError(f"{scene_info} holds no scene_info file (*.npz)")
    scenes = []
    known: set[str] = set()
    for path in paths:
        scene = read_scene(path, overlap)
        # Days into a training is too late to learn that a download is incomplete.
        for name in (*scene.image_paths, *scene.depth_paths):
            if name not in known and not (root / name).is_file():
                raise InputError(f"{root / name} is missing, which {path} names")
            known.add(name)
        if len(scene.pairs):
            scenes.append(scene)
    if not scenes:
        raise InputError(f"no pair in {scene_info} has an overlap between {overlap.least} and {overlap.most}")
    return scenes


def read_scene(path: Path, overlap: OverlapRange) -> MegaDepthScene:
    """One scene_info file: an npz archive, or a pickled dict as LoFTR's own are, whatever their names say.

    Its `poses` are world to camera, (4, 4). Raises InputError where the file is damaged or foreign.
    """
    try:
        with open(path, "rb") as file:
            content = np.load(file, allow_pickle=True)
            entries = {key: content[key] for key in KEYS if key in content}
    except Exception as error:  # unpickling raises whatever the damage happens to spell
        raise InputError(f"cannot read the scene_info file {path}: {' '.join(str(error).split())[:200]}") from error
    missing = [key for key in KEYS if key not in entries]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}: it is no scene_info file of LoFTR's kind")
    try:
        chosen = [
            (int(first), int(second))
            for (first, second), share, *_ in entries["pair_infos"]
            if overlap.least <= share <= overlap.most
        ]
        used, pairs = np.unique(np.array(chosen, np.int64).reshape(-1, 2), return_inverse=True)
        image_paths, depth_paths = (tuple(str(Path(entries[key][i])) for i in used) for key in KEYS[:2])
        k = np.array([entries["intrinsics"][i] for i in used], np.float64).reshape(-1, 3, 3)
        cam_from_world = np.array([entries["poses"][i] for i in used], np.float64).reshape(-1, 4, 4)[:, :3]
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path} holds a pair without paths, 3 x 3 intrinsics or 4 x 4 poses: {error}") from error
    if not (np.isfinite(k).all() and np.isfinite(cam_from_world).all()):
        raise InputError(f"{path} holds intrinsics or poses that are not finite")
    return MegaDepthScene(image_paths, depth_paths, k, cam_from_world, pairs.reshape(-1, 2))


def read_view(root: Path, scene: MegaDepthScene, photo: int, size_wh: tuple[int, int]) -> DepthView:
    """Photo and depth map number `photo` of a scene; the photo is resized to the largest that fits size_wh.

    Raises InputError where one of them cannot be read or the two differ in size.
    """
    path, depth_path = root / scene.image_paths[photo], root / scene.depth_paths[photo]
    stored = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if stored is None:
        raise InputError(f"cannot read the photo {path}")
    depth = read_depth(depth_path)
    if depth.shape != stored.shape:
        sizes = " and ".join(f"{width} x {height}" for height, width in (depth.shape, stored.shape))
        raise InputError(f"the depth map {depth_path} and its photo {path} must be of one size, found {sizes} px")
    height, width = stored.shape
    scale = min(size_wh[0] / width, size_wh[1] / height)
    reduced_wh = (max(1, round(width * scale)), max(1, round(height * scale)))
    grey = cv2.resize(stored, reduced_wh, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    k = np.diag([reduced_wh[0] / width, reduced_wh[1] / height, 1.0]) @ scene.K[photo]
    return DepthView(grey.astype(np.float32), PinholeView(k, reduced_wh, scene.cam_from_world[photo]), depth)


def read_depth(path: Path) -> np.ndarray:
    """(h, w) float32 z-depth, 0 where unknown. Raises InputError where there is no such 2D map in the file."""
    try:
        with h5py.File(path, "r") as file:
            depth = read_array(file, "depth").astype(np.float32, copy=False)
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"cannot read the depth map {path}: {' '.join(str(error).split())[:200]}") from error
    if depth.ndim != 2:
        raise InputError(f"the depth map {path} must have 2 dimensions, found the shape {depth.shape}")
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def relate_depths(view_a: DepthView, view_b: DepthView, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Correspondence of two views by their depth maps.

    size_wh: (W, H) of the padded views, multiples of 8. Returns b_from_a (P, 3, 3) float32, px of A -> px of B over
    the plane of each of the P = W / 8 * H / 8 blocks of A, row by row (identity where there is none), and surface
    (H, W) int64: the block of each pixel of A, -1 where the block is not planar, the pixel has no depth or is off the
    plane, B does not show the same point, and in the padding.
    """
    xy, depth = sample_depth(view_a, size_wh)
    known = depth > 0
    xy_b = np.full(xy.shape, np.nan)
    seen = np.zeros(known.shape, dtype=bool)
    xy_b[known], seen[known] = find_partners(view_a, view_b, xy[known], depth[known])

    inverse_depth = np.divide(1, depth, out=np.zeros(depth.shape), where=known)
    x, y, target = cut_windows(xy[..., 0]), cut_windows(xy[..., 1]), cut_windows(inverse_depth)
    b_from_a = plane_homographies(fit_planes(x, y, target), view_a.camera, view_b.camera)
    mapped = b_from_a @ np.stack([x, y, np.ones(x.shape)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved_x = mapped[:, 0] / mapped[:, 2] - cut_windows(xy_b[..., 0])
        moved_y = mapped[:, 1] / mapped[:, 2] - cut_windows(xy_b[..., 1])
    on_plane = (target > 0) & (mapped[:, 2] > 0) & (np.hypot(moved_x, moved_y) <= PLANE_TOLERANCE_PX)
    width, height = view_a.camera.size_wh
    pictured = np.zeros(known.shape, dtype=bool)
    pictured[:height, :width] = True
    planar = on_plane.sum(axis=1) >= PLANAR_SHARE * np.maximum(cut_windows(pictured).sum(axis=1), 1)
    b_from_a[~planar] = np.eye(3)

    block = np.arange(len(planar)).reshape(known.shape[0] // BLOCK_PX, -1)
    surface = np.repeat(np.repeat(block, BLOCK_PX, axis=0), BLOCK_PX, axis=1)
    surface[~(seen & join_blocks(on_plane & planar[:, None], known.shape))] = -1
    return b_from_a.astype(np.float32), surface


def sample_depth(view: DepthView, size_wh: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The depth nearest to the centre of each pixel of the padded view, and where exactly it was measured.

    Returns xy (H, W, 2) float64 px of the view: the centre of the depth map's pixel, which is up to half a pixel of
    the depth map away from the view's pixel centre; and depth (H, W) float64, 0 where unknown and in the padding.
    """
    width, height = view.camera.size_wh
    step_x, step_y = width / view.depth.shape[1], height / view.depth.shape[0]
    columns = ((np.arange(width) + 0.5) / step_x).astype(np.int64)
    rows = ((np.arange(height) + 0.5) / step_y).astype(np.int64)
    xy = np.zeros((size_wh[1], size_wh[0], 2))
    xy[:height, :width, 0] = (columns + 0.5) * step_x
    xy[:height, :width, 1] = (rows[:, None] + 0.5) * step_y
    depth = np.zeros(xy.shape[:2])
    depth[:height, :width] = view.depth[rows[:, None], columns]
    return xy, depth


def find_partners(
    view_a: DepthView, view_b: DepthView, xy: np.ndarray, depth: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project points of A, (N, 2) px with (N,) z-depths, into B.

    Returns xy_b (N, 2) float64 px, NaN behind the camera, and seen (N,) bool: B's own depth says the same.
    """
    xy_b, depth_b = view_b.camera.project(lift_points(view_a.camera, xy, depth))
    xy_b[depth_b <= 0] = np.nan
    seen = np.all((xy_b >= 0) & (xy_b < view_b.camera.size_wh), axis=1)
    stored_wh = np.array(view_b.depth.shape[::-1])
    columns, rows = np.minimum((xy_b[seen] * stored_wh / view_b.camera.size_wh).astype(np.int64), stored_wh - 1).T
    measured = view_b.depth[rows, columns].astype(np.float64)
    back, _ = view_a.camera.project(lift_points(view_b.camera, xy_b[seen], measured))
    same_depth = np.abs(measured - depth_b[seen]) <= DEPTH_TOLERANCE * depth_b[seen]
    seen[seen] = same_depth & (np.linalg.norm(back - xy[seen], axis=1) <= ROUND_TRIP_PX)
    return xy_b, seen


def lift_points(camera: PinholeView, xy: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Px (N, 2) and z-depths (N,) -> world points (N, 3) float64."""
    rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K).T
    return (rays * depth[:, None] - camera.cam_from_world[:, 3]) @ camera.cam_from_world[:, :3]


def cut_windows(field: np.ndarray) -> np.ndarray:
    """(H, W) -> (P, N): each block with the margin around it, row by row; zeros (False) beyond the view."""
    side = BLOCK_PX + 2 * MARGIN_PX
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(field, MARGIN_PX), (side, side))
    return windows[::BLOCK_PX, ::BLOCK_PX].reshape(-1, side * side)


def join_blocks(windows: np.ndarray, shape_hw: tuple[int, int]) -> np.ndarray:
    """(P, N) -> (H, W): the windows without their margins, put together again."""
    side = BLOCK_PX + 2 * MARGIN_PX
    inner = slice(MARGIN_PX, MARGIN_PX + BLOCK_PX)
    blocks = windows.reshape(shape_hw[0] // BLOCK_PX, -1, side, side)[:, :, inner, inner]
    return blocks.swapaxes(1, 2).reshape(shape_hw)


def fit_planes(x: np.ndarray, y: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    """The plane that most samples of each window lie on: (P, 3) float64 with 1 / z = plane @ (x, y, 1).

    x, y (px), inverse_depth (0 where unknown): (P, N) each. Reweighted least squares (Cauchy): the minority beyond a
    depth edge hardly pulls.
    """
    known = inverse_depth > 0
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    centre_x, centre_y = ((field * known).sum(axis=1, keepdims=True) / count for field in (x, y))
    scale = inverse_depth.sum(axis=1, keepdims=True) / count
    scale[scale == 0] = 1
    design = np.stack([(x - centre_x) / BLOCK_PX, (y - centre_y) / BLOCK_PX, np.ones(x.shape)], axis=2)
    target = (inverse_depth / scale)[..., None]
    weight = known[..., None].astype(np.float64)
    solution = np.zeros((len(x), 3, 1))
    for _ in range(FIT_ROUNDS):
        weighted = (design * weight).swapaxes(1, 2)
        # The ridge makes windows without a depth solvable; it weighs nothing beside the samples of the others.
        solution = np.linalg.solve(weighted @ design + 1e-9 * np.eye(3), weighted @ target)
        weight = known[..., None] / (1 + ((design @ solution - target) / DEPTH_NOISE) ** 2)
    slope_x, slope_y, level = (solution[:, i] * scale for i in range(3))
    slope_x, slope_y = slope_x / BLOCK_PX, slope_y / BLOCK_PX
    return np.concatenate([slope_x, slope_y, level - slope_x * centre_x - slope_y * centre_y], axis=1)


def plane_homographies(planes: np.ndarray, camera_a: PinholeView, camera_b: PinholeView) -> np.ndarray:
    """(P, 3) planes of A as fit_planes gives them -> (P, 3, 3) float64, px of A -> px of B; w is depth in B over A."""
    rotation = camera_b.cam_from_world[:, :3] @ camera_a.cam_from_world[:, :3].T
    translation = camera_b.cam_from_world[:, 3] - rotation @ camera_a.cam_from_world[:, 3]
    return camera_b.K @ (rotation @ np.linalg.inv(camera_a.K) + translation[:, None] * planes[:, None, :])
