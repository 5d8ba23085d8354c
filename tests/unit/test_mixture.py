"""Several kinds of pairs in one data set, in the configured mixture."""

import dataclasses

import numpy as np
import torch
from torch.utils.data import Dataset, default_collate

from hm_sfm.training import batches
from hm_sfm.training.config import MegaDepthSource
from hm_sfm.training.mixture import MixedPairs, collate_pairs


class Tagged(Dataset):
    """Items that say where they come from, with so many surfaces."""

    def __init__(self, tag: float, surfaces: int = 2, count: int = 400) -> None:
        self.tag, self.surfaces, self.count = tag, surfaces, count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        b_from_a = np.full((self.surfaces, 3, 3), self.tag, np.float32)
        return {"b_from_a": b_from_a, "tag": np.array(self.tag), "index": np.array(index)}


def draw_tags(kinds: list[tuple[Dataset, float]], seed: int = 1) -> list[float]:
    pairs = MixedPairs(kinds, seed)
    return [float(pairs[i]["tag"]) for i in range(len(pairs))]


def test_a_mixture_has_its_shares():
    tags = draw_tags([(Tagged(0), 0.5), (Tagged(1), 0.2), (Tagged(2), 0.0), (Tagged(3), 0.3)])
    shares = [tags.count(tag) / 400 for tag in range(4)]
    assert shares[2] == 0
    np.testing.assert_allclose(shares, [0.5, 0.2, 0, 0.3], atol=0.08)


def test_a_mixture_is_drawn_by_seed_and_index():
    kinds = [(Tagged(0), 0.5), (Tagged(1), 0.5)]
    assert draw_tags(kinds) == draw_tags(kinds) != draw_tags(kinds, seed=2)
    pairs = MixedPairs(kinds, 1)
    assert len(pairs) == 400 and pairs[17]["index"] == 17
    assert set(draw_tags([(Tagged(0), 0.0), (Tagged(1), 0.1)])) == {1}


def test_a_batch_fills_up_the_surfaces():
    batch = collate_pairs([Tagged(1, surfaces=2)[0], Tagged(2, surfaces=5)[1]])
    assert batch["b_from_a"].shape == (2, 5, 3, 3) and batch["b_from_a"].dtype == torch.float32
    assert (batch["b_from_a"][0, :2] == 1).all() and (batch["b_from_a"][1] == 2).all()
    assert not batch["b_from_a"][0, 2:].any()
    assert batch["index"].tolist() == [0, 1]
    same = [Tagged(1)[0], Tagged(2)[0]]
    assert torch.equal(collate_pairs(same)["b_from_a"], default_collate(same)["b_from_a"])


def test_megadepth_is_one_of_the_kinds_of_pairs(training, monkeypatch):
    made = []

    def make(root, scene_info, size_wh, seed, count):
        made.append((root.name, scene_info.name, size_wh, seed, count))
        return Tagged(7, count=count)

    monkeypatch.setattr(batches, "MegaDepthPairs", make)
    source = MegaDepthSource(root="root", scene_info="index", validation_info="held_out")
    training = dataclasses.replace(training, megadepth=source, rendered_share=0.3, megadepth_share=0.7)
    photos = [np.zeros((144, 160), np.uint8)]
    pairs = batches.make_pairs(photos, training, 5, 40, held_out=False)
    batches.make_pairs(photos, training, 6, 8, held_out=True)
    assert made == [("root", "index", (64, 64), 5, 40), ("root", "held_out", (64, 64), 6, 8)]
    # 1 - 0.3 - 0.7 is not quite 0 in floating point, but no share of warped photos.
    assert len(pairs.kinds) == 2
    assert 15 < sum("tag" in pairs[i] for i in range(40)) < 40
