"""The pairs that a training shows, in the configured mixture, and batches of them."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from torch import Tensor
from torch.utils.data import DataLoader

from hm_sfm.errors import HmSfmError
from hm_sfm.training.config import TrainConfig
from hm_sfm.training.megadepth import MegaDepthPairs
from hm_sfm.training.mixture import MixedPairs, collate_pairs
from hm_sfm.training.multiview import VALIDATION_SCENES, PhotoPairs, read_photo_pairs
from hm_sfm.training.photos import WarpedPhotos
from hm_sfm.training.processes import Processes
from hm_sfm.training.scenes import RenderedScenes
from hm_sfm.types import TrainingPairs

MOST_WORKERS = 8
"""Processes that prepare the batches of one training process."""


def make_pairs(photos: list[np.ndarray], config: TrainConfig, seed: int, count: int, held_out: bool) -> MixedPairs:
    """`count` pairs of all kinds, in the configured mixture; held_out: of the scenes that validate."""
    size_wh = (config.size_px, config.size_px)
    rest = 1 - config.rendered_share - config.real_share - config.megadepth_share
    kinds: list[tuple[TrainingPairs, float]] = [
        # A remainder due to rounding is no share.
        (WarpedPhotos(photos, size_wh, seed, count, config.warp), rest if rest > 1e-9 else 0.0),
        (RenderedScenes(photos, size_wh, seed, count, config.views), config.rendered_share),
    ]
    if config.real_share:
        source = config.multiview
        names = VALIDATION_SCENES if held_out else None
        scenes = read_photo_pairs(Path(source.tracks), Path(source.photos), names)
        kinds.append((PhotoPairs(scenes, size_wh, seed, count), config.real_share))
    if config.megadepth_share:
        source = config.megadepth
        scene_info = Path(source.validation_info if held_out else source.scene_info)
        pairs = MegaDepthPairs(Path(source.root), scene_info, size_wh, seed, count)
        kinds.append((pairs, config.megadepth_share))
    return MixedPairs(kinds, seed)


def iterate_batches(
    pairs: MixedPairs, pairs_per_step: int, first_step: int, processes: Processes
) -> Iterator[dict[str, Tensor]]:
    """The share of each step's pairs that this process takes, from `first_step` on, prepared by worker processes."""
    share = pairs_per_step // processes.count
    first_pair = first_step * pairs_per_step + processes.rank * share
    batches = [list(range(pair, pair + share)) for pair in range(first_pair, len(pairs), pairs_per_step)]
    workers = min(max((os.cpu_count() or 1) // (2 * processes.count), 1), MOST_WORKERS)
    loader = DataLoader(
        pairs,
        batch_sampler=batches,
        num_workers=workers,
        prefetch_factor=max(8 // workers, 2),
        collate_fn=collate_pairs,
    )
    yield from read_batches(loader)


def read_batches(loader: DataLoader) -> Iterator[dict[str, Tensor]]:
    """The batches of a loader. Errors of its worker processes are raised without the traces in their text."""
    try:
        yield from loader
    except HmSfmError as error:
        last_line = str(error).strip().splitlines()[-1]
        raise type(error)(last_line.partition(": ")[2]) from None
