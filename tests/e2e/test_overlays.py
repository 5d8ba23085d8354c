"""Photos with the same logo in all of them."""

import cv2
import numpy as np
import pytest

from hm_sfm.colmap.database import read_verified_matches
from hm_sfm.photos.exif import write_jpeg
from hm_sfm.synthetic.demo import write_demo
from hm_sfm.synthetic.textures import make_texture


@pytest.mark.slow
def test_a_logo_joins_no_places(tmp_path, run, caplog):
    """Two courtyards, the second seen by two photos only."""
    logo = make_texture(np.random.default_rng(7), "mural", (1.0, 0.8), 100)
    (tmp_path / "photos").mkdir()
    for place, seed, count in (("a", 0, 3), ("b", 1, 2)):
        write_demo(tmp_path / place, seed, count, (320, 240))
        for path in sorted((tmp_path / place / "images").iterdir()):
            photo = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
            photo[10:90, 210:310] = logo
            write_jpeg(tmp_path / "photos" / f"{place}_{path.name}", photo, 28)
    finished = run("export", tmp_path / "photos", tmp_path / "out")
    assert finished.code == 0, finished.err
    assert any("stays in its place while the scene moves" in message for message in caplog.messages)
    verified = read_verified_matches(tmp_path / "out" / "database.db")
    assert {(pair.name0[0], pair.name1[0]) for pair in verified} == {("a", "a"), ("b", "b")}
    assert min(map(len, verified.values())) > 50
