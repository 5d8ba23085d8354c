import cv2
import numpy as np
import pytest

from hm_sfm.errors import InputError
from hm_sfm.evaluation.homographies import score_homographies
from hm_sfm.matching.matcher import HomoMatcher
from hm_sfm.synthetic.textures import make_texture


@pytest.fixture(scope="module")
def matcher():
    return HomoMatcher.from_pretrained("light")


@pytest.mark.slow
def test_homographies_of_a_small_hpatches_folder(tmp_path, matcher):
    image = make_texture(np.random.default_rng(0), "bricks", (2.4, 1.8), 160)
    sequence = tmp_path / "v_bricks"
    sequence.mkdir()
    cv2.imwrite(str(sequence / "1.png"), image)
    size_wh = image.shape[1], image.shape[0]
    for number in range(2, 7):
        true = np.array([[1, 0.02 * number, 3], [-0.02 * number, 1, 6], [2e-5 * number, 0, 1]])
        np.savetxt(sequence / f"H_1_{number}", true)
        cv2.imwrite(str(sequence / f"{number}.png"), cv2.warpPerspective(image, true, size_wh))
    scores = score_homographies(matcher, tmp_path, quiet=True)
    assert scores["auc_3px"] > 60 and scores["mean_matches"] > 100
    with pytest.raises(InputError, match="HPatches"):
        score_homographies(matcher, sequence, quiet=True)
