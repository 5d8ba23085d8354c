"""Why photos are not in the model, on synthetic scenes with one fault each."""

import dataclasses
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.cameras import Cameras
from hm_sfm.colmap.database import write_database
from hm_sfm.colmap.verification import verify_database
from hm_sfm.config import Config, ImageConfig, VerificationConfig
from hm_sfm.errors import InputError
from hm_sfm.pairs.selection import pair_exhaustively
from hm_sfm.report.diagnosis import MOST_LISTED, Cause, Diagnosis, diagnose
from hm_sfm.types import ImagePair, ImageRef, IndexMatches, Keypoints, PairMatches


class Run:
    """A synthetic scene of four images: its verified database, its model, and what `diagnose` is given of it."""

    def __init__(self, folder: Path) -> None:
        pycolmap.set_random_seed(3)
        options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=4, num_points3D=120)
        self.database_path = folder / "database.db"
        with pycolmap.Database.open(self.database_path) as database:
            self.model = pycolmap.synthesize_dataset(options, database)
            self.ids = {row.name: row.image_id for row in database.read_all_images()}
        self.names = sorted(self.ids)
        camera = pycolmap.Camera(next(iter(self.model.cameras.values())).todict())
        camera.has_prior_focal_length = True
        self.cameras = Cameras((camera,), (0,) * 4)
        self.images = [ImageRef(name, Path(name), (4000, 3000)) for name in self.names]
        self.pairs = pair_exhaustively(self.names)
        self.scores: dict[ImagePair, int] = {}
        """Pair -> its number of good matches."""
        self.moves_px = 90.0
        """By which matches move, px of the photos of 4000 x 3000 px."""
        self.models = [self.model]
        self.config = Config()

    def read(self, pair: ImagePair) -> PairMatches:
        good = self.scores.get(pair, 0)
        count = good + 5
        score = np.r_[np.full(good, 0.9), np.full(5, 0.1)]
        xy = np.zeros((count, 2))
        homography = np.tile(np.eye(3), (count, 1, 1))
        xy1 = xy + self.moves_px
        return PairMatches(pair=pair, xy0=xy, xy1=xy1, score=score, homography=homography, patch_radius_px=8.0)

    def deregister(self, name: str) -> None:
        self.model.deregister_frame(self.model.image(self.ids[name]).frame_id)

    def forget_pairs(self, name: str, partners: list[str]) -> None:
        with pycolmap.Database.open(self.database_path) as database:
            for partner in partners:
                database.delete_two_view_geometry(self.ids[name], self.ids[partner])

    def diagnose(self) -> tuple[Diagnosis, ...]:
        return diagnose(self.images, self.cameras, self.pairs, self.read, self.database_path, self.models, self.config)


@pytest.fixture
def run(tmp_path) -> Run:
    return Run(tmp_path)


def test_nothing_to_say_where_all_are_registered(run):
    assert run.diagnose() == ()


def test_an_image_in_no_pair(run):
    first, *others = run.names
    run.deregister(first)
    run.forget_pairs(first, others)
    run.pairs = [pair for pair in run.pairs if first not in (pair.name0, pair.name1)]
    (diagnosis,) = run.diagnose()
    assert (diagnosis.cause, list(diagnosis.reasons)) == (Cause.UNPAIRED, [first])
    assert diagnosis.advice == ("--pairs exhaustive",)


def test_too_few_matches_name_the_best_neighbour(run):
    last = run.names[-1]
    run.deregister(last)
    run.forget_pairs(last, run.names[:-1])
    run.scores[ImagePair(run.names[1], last)] = 21
    (diagnosis,) = run.diagnose()
    assert diagnosis.cause == Cause.FEW_MATCHES
    assert diagnosis.reasons == {last: f"at most 21, with {run.names[1]}; 30 are needed"}
    assert diagnosis.advice == ("photos taken in between", "--set images.long_edge_px=1600")
    line = f"1 not in the model, too few good matches: {last} (at most 21, with {run.names[1]}; 30 are needed); try "
    assert str(diagnosis) == line + "photos taken in between, or --set images.long_edge_px=1600"

    run.config = dataclasses.replace(run.config, images=ImageConfig(long_edge_px=4000))
    run.pairs = run.pairs[1:]
    (diagnosis,) = run.diagnose()
    assert diagnosis.advice == ("photos taken in between", "--pairs exhaustive")


def test_matches_that_disagree(run):
    last = run.names[-1]
    run.deregister(last)
    run.forget_pairs(last, run.names[:-1])
    run.scores[ImagePair(run.names[0], last)] = 30
    (diagnosis,) = run.diagnose()
    assert (diagnosis.cause, diagnosis.reasons[last]) == (
        Cause.DISAGREEING,
        f"30 with {run.names[0]}, too few of them agree",
    )


def test_masks_are_advised_where_matches_stay_in_their_places(run):
    """As those of a still background do, before which an object turns."""
    run.models = []
    run.scores = dict.fromkeys(run.pairs, 50)
    (moving,) = run.diagnose()
    run.moves_px = 2.0  # half a px of the matching resolution
    (still,) = run.diagnose()
    assert still.advice == ("masks of what stays where it is in the frame (--masks, --camera-mask)", *moving.advice)


def test_matches_that_disagree_may_be_those_of_a_fisheye_lens(run):
    last = run.names[-1]
    run.deregister(last)
    run.forget_pairs(last, run.names[:-1])
    run.scores[ImagePair(run.names[0], last)] = 30
    fisheye = "--camera-model OPENCV_FISHEYE if the lens is a fisheye"
    (diagnosis,) = run.diagnose()
    assert diagnosis.advice[-1] == fisheye and "--camera-params" not in str(diagnosis)

    camera = pycolmap.Camera.create_from_model_name(1, "OPENCV_FISHEYE", 420.0, 1024, 768)
    run.cameras = Cameras((camera,), (0,) * 4)
    (diagnosis,) = run.diagnose()
    assert diagnosis.reasons[last].endswith("too few of them agree, focal length unknown")
    assert diagnosis.advice[0] == "known intrinsics: --camera-model and --camera-params"
    assert fisheye not in diagnosis.advice

    run.cameras = Cameras((camera,), (0,) * 4, known=True)
    (diagnosis,) = run.diagnose()
    assert "--camera-model" not in str(diagnosis)


def test_an_image_of_another_model(run):
    whole = pycolmap.Reconstruction(run.model)
    run.deregister(run.names[2])
    run.models = [run.model, whole]
    (diagnosis,) = run.diagnose()
    assert (diagnosis.cause, diagnosis.reasons) == (Cause.OTHER_MODEL, {run.names[2]: "sparse/1, 4 images"})


def test_verified_pairs_outside_the_model_only(run):
    inside, outside = run.names[:2], run.names[2:]
    for name in outside:
        run.deregister(name)
        run.forget_pairs(name, inside)
    (diagnosis,) = run.diagnose()
    assert diagnosis.cause == Cause.APART
    assert list(diagnosis.reasons) == outside
    assert diagnosis.reasons[outside[0]].endswith(f"verified matches with {outside[1]}")


def test_points_of_the_model_in_view_are_counted(run):
    name = run.names[1]
    run.deregister(name)
    (diagnosis,) = run.diagnose()
    reason = "120 points of the model in view, focal length 1280 px from EXIF"
    assert (diagnosis.cause, diagnosis.reasons[name]) == (Cause.NO_POSE, reason)
    assert diagnosis.advice == ("known intrinsics: --camera-model and --camera-params", "--camera-mode per-image")

    camera = run.cameras.cameras[0]
    run.cameras = Cameras((camera,), (0,) * 4, known=True)
    (diagnosis,) = run.diagnose()
    assert diagnosis.reasons[name] == "120 points of the model in view"
    assert diagnosis.advice == ("--camera-mode per-image",)

    run.cameras = Cameras((camera,), (0,) * 4)
    camera.has_prior_focal_length = False
    (diagnosis,) = run.diagnose()
    assert diagnosis.reasons[name].endswith(", focal length unknown")
    assert "--camera-params" in diagnosis.advice[0]

    for point_id in sorted(run.model.points3D)[29:]:
        run.model.delete_point3D(point_id)
    (diagnosis,) = run.diagnose()
    assert (diagnosis.cause, diagnosis.reasons[name]) == (Cause.FEW_POINTS, "29; 30 are needed")


def test_no_model_in_spite_of_good_pairs(run):
    run.models = []
    (diagnosis,) = run.diagnose()
    assert (diagnosis.cause, list(diagnosis.reasons)) == (Cause.NO_START, run.names)
    assert diagnosis.reasons[run.names[0]].startswith("120 verified matches with ")
    assert f"{run.names[MOST_LISTED - 1]} (" in str(diagnosis)


def test_the_same_view_twice_has_no_baseline(tmp_path):
    xy = np.random.default_rng(0).uniform((20, 20), (620, 460), (200, 2))
    images = [ImageRef(name, Path(name), (640, 480)) for name in ("a.jpg", "b.jpg")]
    keypoints = [Keypoints(image.name, xy, np.ones(200), np.ones(200)) for image in images]
    pair = ImagePair("a.jpg", "b.jpg")
    matches = IndexMatches(pair, np.repeat(np.arange(200)[:, None], 2, axis=1), np.ones(200))
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 700.0, 640, 480)
    cameras = Cameras((camera,), (0, 0))
    path = tmp_path / "database.db"
    write_database(path, images, cameras, keypoints, [matches])
    verify_database(path, VerificationConfig(), num_threads=1)
    homography = np.tile(np.eye(3), (200, 1, 1))
    still = PairMatches(pair=pair, xy0=xy, xy1=xy, score=np.ones(200), homography=homography, patch_radius_px=8.0)
    (diagnosis,) = diagnose(images, cameras, [pair], lambda pair: still, path, (), Config())
    assert diagnosis.cause == Cause.SMALL_BASELINE
    assert diagnosis.reasons["a.jpg"] == "rays meet at 0.0 degrees at most, focal length unknown"
    assert diagnosis.advice[0] == "photos from places farther apart" and diagnosis.advice[1].startswith("masks ")


def test_long_lists_are_cut():
    names = [f"{i}.jpg" for i in range(MOST_LISTED + 3)]
    line = str(Diagnosis(Cause.UNPAIRED, dict.fromkeys(names, "why"), ()))
    assert line.startswith(f"{MOST_LISTED + 3} not in the model, in no pair: 0.jpg (why), ")
    assert line.endswith(f"{MOST_LISTED - 1}.jpg (why) and 3 more")


def test_missing_database_is_an_input_error(run, tmp_path):
    run.models, run.database_path = [], tmp_path / "missing.db"
    with pytest.raises(InputError, match="missing.db"):
        run.diagnose()
