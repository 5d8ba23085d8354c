"""OUT: an output folder of an earlier version is refused, and left as it is."""

import json

import h5py
import numpy as np
import pytest

from hm_sfm.config import Config
from hm_sfm.errors import InputError, StaleResultError
from hm_sfm.io.locks import release_locks
from hm_sfm.io.markers import RUN_MARKER
from hm_sfm.pipeline.output_folder import claim_folder, describe_matching, open_store
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


def claim(out, **options):
    with release_locks():
        claim_folder(out, **options)
    assert (out / RUN_MARKER).exists()


@pytest.mark.parametrize("images", ["project/images", "project/photos/of/may"])
def test_a_folder_around_the_photos_can_be_out(tmp_path, images):
    """COLMAP's layout; masks and models of others are no obstacle."""
    for folder in (images, "project/masks", "project/sparse/0"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "project" / "notes.txt").touch()
    claim(tmp_path / "project", photos=tmp_path / images)
    claim(tmp_path / "project", photos=tmp_path / images)  # the next run


@pytest.mark.parametrize("name", ["database.db", "matches.h5", "pairs.txt", "summary.json"])
def test_what_others_wrote_in_the_place_of_results_is_not_replaced(tmp_path, name):
    (tmp_path / "images").mkdir()
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=f"{tmp_path.name} holds {name}, which hm_sfm did not write"):
        claim(tmp_path, photos=tmp_path / "images")
    assert not (tmp_path / RUN_MARKER).exists() and (tmp_path / name).read_text() == "mine"


def test_the_folder_of_the_photos_and_other_folders_cannot_be_out(tmp_path):
    for name in ("images", "thesis"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.jpg").touch()
        with pytest.raises(InputError, match=f"{name} is not empty and holds no run of hm_sfm: name a new one"):
            claim(tmp_path / name, photos=tmp_path / "images")
        assert [path.name for path in (tmp_path / name).iterdir()] == ["1.jpg"]


@pytest.mark.parametrize("stage", ["batches", "matches", "summary", "comparison"])
def test_a_run_that_was_copied_without_hidden_files_is_known(tmp_path, stage):
    """As by cp -r out/* moved/."""
    if stage in ("batches", "matches"):
        (tmp_path / "a.jpg").write_bytes(b"a")
        store = open_store(tmp_path / "out" / "matches.h5", [ImageRef("a.jpg", tmp_path / "a.jpg", (64, 48))], Config())
        (tmp_path / "out").mkdir()
        store.merge()
        if stage == "batches":
            (tmp_path / "out" / "matches.h5.parts").mkdir()
            (tmp_path / "out" / "matches.h5").rename(tmp_path / "out" / "matches.h5.parts" / "000000.h5")
    else:
        (tmp_path / "out").mkdir()
        name = "summary.json" if stage == "summary" else "compare.json"
        (tmp_path / "out" / name).write_text(json.dumps({"config_fingerprint": "0123"}))
    (tmp_path / "out" / "database.db").touch()
    claim(tmp_path / "out")


@pytest.mark.parametrize("content", ["{", "[]", '{"num_images": 3}'])
def test_files_of_others_with_the_same_names_are_no_run(tmp_path, content):
    (tmp_path / "summary.json").write_text(content)
    with h5py.File(tmp_path / "matches.h5", "w") as h5:  # as hloc's, which says nothing about itself
        h5.create_group("a.jpg")
    with pytest.raises(InputError, match="holds no run"):
        claim(tmp_path)
