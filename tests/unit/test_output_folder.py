"""OUT: an output folder of an earlier version is refused, and left as it is."""

import json

import h5py
import numpy as np
import pytest

from hm_sfm.config import Config
from hm_sfm.errors import StaleResultError
from hm_sfm.pipeline.output_folder import describe_matching, open_store
from hm_sfm.types import ImagePair, ImageRef, PairMatches


def test_the_out_of_the_first_version_is_refused_in_one_sentence_and_nothing_deleted(tmp_path):
    """Its matches know the setting retry_turned, and native.h5 lies beside them."""
    images = []
    for name in ("a.jpg", "b.jpg"):
        (tmp_path / name).write_bytes(name.encode())
        images.append(ImageRef(name, tmp_path / name, (64, 48)))
    out = tmp_path / "out"
    out.mkdir()
    store = open_store(out / "matches.h5", images, Config())
    none = np.zeros((0, 2), np.float32)
    pair = ImagePair("a.jpg", "b.jpg")
    no_matches = {"xy0": none, "xy1": none, "score": np.zeros(0), "homography": np.zeros((0, 3, 3))}
    store.write([PairMatches(pair=pair, **no_matches, patch_radius_px=8.0)])
    store.merge()
    made_by = describe_matching(Config())
    made_by["matching.retry_turned"] = made_by.pop("matching.try_hypotheses")
    with h5py.File(out / "matches.h5", "a") as h5:
        h5.attrs["made_by"] = json.dumps(made_by, sort_keys=True)
    (out / "native.h5").write_bytes(b"of the first version")
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    with pytest.raises(StaleResultError) as error:
        open_store(out / "matches.h5", images, Config())
    assert str(error.value) == (
        f"{out / 'matches.h5'} was made by another version of hm_sfm, which had the setting matching.retry_turned: "
        "name another OUT or delete it"
    )
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
