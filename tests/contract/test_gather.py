"""What a report gathers from the database and the model of a synthetic scene."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from hm_sfm.colmap.verification import VerifiedPair
from hm_sfm.config import Config, fingerprint
from hm_sfm.judgement.judgement import GivenUpPair, Judgement
from hm_sfm.keypoints.tracks import build_tracks, count_neighbours
from hm_sfm.report.diagnosis import Cause, Diagnosis
from hm_sfm.report.gather import (
    MOST_WEAK_PAIRS,
    gather_report,
    lay_out_scene,
    make_upright,
    read_baselines,
)
from hm_sfm.types import ImagePair, ImageRef, PairMatches

NOTHING_REFUTED = Judgement({}, (), 0)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, list[ImageRef], pycolmap.Reconstruction]:
    """OUT of a run of five images, with noisy keypoints; the last image is not registered."""
    out = tmp_path_factory.mktemp("run") / "out"
    out.mkdir()
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=5, num_points3D=100)
    with pycolmap.Database.open(out / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model, database)
        ids = {row.name: row.image_id for row in database.read_all_images()}
        names = sorted(ids)
        database.delete_two_view_geometry(ids[names[0]], ids[names[1]])
    model.deregister_frame(model.image(ids[names[4]]).frame_id)
    camera = next(iter(model.cameras.values()))
    photo = np.random.default_rng(0).integers(0, 255, (camera.height, camera.width), np.uint8)
    images = []
    for name in names:
        path = (out / name).with_suffix(".png")
        path.parent.mkdir(exist_ok=True)
        cv2.imwrite(str(path), photo)
        images.append(ImageRef(name, path, (camera.width, camera.height)))
    (out / "summary.json").write_text(json.dumps({"registered": 4}))
    return out, images, model


@pytest.fixture(scope="module")
def report(run):
    out, images, model = run
    diagnosis = Diagnosis(Cause.NO_POSE, {images[4].name: "why"}, ())
    return gather_report(out, images, 10, [model], NOTHING_REFUTED, None, [diagnosis], Config())


def test_figures_of_images_are_those_of_the_model(run, report):
    _, images, model = run
    assert [image.name for image in report.images] == [image.name for image in images]
    assert [image.registered for image in report.images] == [True] * 4 + [False]
    posed = {image.name: image for image in model.images.values()}
    for image in report.images[:4]:
        assert image.keypoints == posed[image.name].num_points2D()
        assert image.observations == posed[image.name].num_points3D
        assert image.neighbours == 3 and image.reason == ""
        errors = [
            np.linalg.norm(posed[image.name].project_point(model.points3D[seen.point3D_id].xyz) - seen.xy)
            for seen in posed[image.name].get_observation_points2D()
        ]
        assert image.mean_error_px == pytest.approx(np.mean(errors), rel=1e-3)
        assert 0.3 < image.mean_error_px < 1.2
    last = report.images[4]
    assert (last.observations, last.mean_error_px, last.neighbours, last.reason) == (0, None, 0, "why")
    assert report.track_lengths == {"this run": {4: 100}}


def test_the_verified_pairs_are_counted(report):
    assert report.num_pairs == 10
    assert report.verified_pairs.keys() == {(i, j) for i in range(5) for j in range(i + 1, 5)} - {(0, 1)}
    assert set(report.verified_pairs.values()) == {100}


def test_weak_pairs_are_drawn_with_their_matches(report):
    assert len(report.weak_pairs) == MOST_WEAK_PAIRS
    for weak in report.weak_pairs:
        assert weak.matches == 100
        picture = cv2.imdecode(np.frombuffer(weak.jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert max(picture.shape) <= 2 * 560 + 8
        # The photos are grey noise: what is green was drawn.
        greenness = (picture[..., 1].astype(int) - picture[..., 2]).max()
        has_poses = report.images[4].name not in (weak.pair.name0, weak.pair.name1)
        assert (greenness > 100) == has_poses


def test_scene_is_the_model_turned_and_scaled(run, report):
    _, _, model = run
    scene = report.scene
    xyz = np.array([model.points3D[point_id].xyz for point_id in sorted(model.points3D)])
    assert scene.xyz.shape == (100, 3) and len(scene.names) == 4
    posed = {image.name: image for image in model.images.values()}
    centres = np.array([posed[name].projection_center() for name in scene.names])
    world, shown = np.concatenate([xyz, centres]), np.concatenate([scene.xyz, scene.frusta[:, 0]])
    ratio = np.linalg.norm(np.diff(shown, axis=0), axis=1) / np.linalg.norm(np.diff(world, axis=0), axis=1)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert 0.5 < np.abs(shown).max() < 2
    # Both must be right-handed.
    edges = [points[[1, 2, 3]] - points[0] for points in (world, shown)]
    assert np.sign(np.linalg.det(edges[0])) == np.sign(np.linalg.det(edges[1]))


def test_photos_on_their_sides_stand_upright(run):
    """Rotated cameras show the same scene the same way when EXIF says how they were rotated."""
    _, images, model = run
    names = {image.name: 0 for image in images}
    upright = lay_out_scene(model, names)
    quarter = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, -np.pi / 2])), np.zeros(3))
    rotated = pycolmap.Reconstruction(model)
    for frame_id in rotated.reg_frame_ids():
        frame = rotated.frame(frame_id)
        frame.rig_from_world = quarter * frame.rig_from_world
    np.testing.assert_allclose(lay_out_scene(rotated, dict.fromkeys(names, 90)).xyz, upright.xyz, atol=1e-4)
    assert np.abs(lay_out_scene(rotated, names).xyz - upright.xyz).max() > 0.05


@pytest.mark.parametrize(
    ("up", "forward"),
    [([0.3, 2.0, 0.1], [1.0, 0.5, -2.0]), ([0, 0, 5.0], [0, 0, -1.0]), ([0, 0, 0.0], [0, 0, 0.0])],
    ids=["any", "straight down", "cancelled"],
)
def test_upright_is_a_rotation(up, forward):
    up, forward = np.array(up), np.array(forward)
    rotation = make_upright(up, forward)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ up, [0, np.linalg.norm(up), 0], atol=1e-12)
    x, _, z = rotation @ forward
    assert x == pytest.approx(0, abs=1e-12) and z <= 1e-12


def test_neighbours_share_a_track():
    image = np.array([0, 1, 3, 1, 2, 0, 1])
    track = np.array([0, 0, 0, 1, 1, 2, 2])
    assert count_neighbours(build_tracks(track, image, np.arange(7)), 5).tolist() == [2, 3, 1, 2, 0]
    assert count_neighbours(build_tracks(track[:0], image[:0], image[:0]), 2).tolist() == [0, 0]


def test_no_model(run):
    out, images, _ = run
    report = gather_report(out, images, 10, [], NOTHING_REFUTED, None, [], Config())
    assert report.scene is None
    assert report.track_lengths == {"this run": {}}
    assert not any(image.registered for image in report.images)
    assert len(report.weak_pairs) == MOST_WEAK_PAIRS


def test_pairs_given_up_are_drawn_those_with_most_matches_first(run):
    out, images, model = run
    names = [image.name for image in images]
    stored, given_up = {}, []
    for number, pair in enumerate(ImagePair(*names[i : i + 2]) for i in range(4)):
        xy = np.random.default_rng(number).uniform(10, 90, (5, 2))
        homography = np.tile(np.eye(3), (5, 1, 1))
        stored[pair] = PairMatches(
            pair=pair, xy0=xy, xy1=xy, score=np.ones(5), homography=homography, patch_radius_px=8.0
        )
        given_up.append(GivenUpPair(VerifiedPair(pair, np.arange(5) <= number, 1.0), 0.1 * number))
    report = gather_report(out, images, 10, [model], Judgement({}, tuple(given_up), 0), stored.get, [], Config())
    assert [refuted.matches for refuted in report.refuted_pairs] == [4, 3, 2, 1]
    assert [refuted.belief for refuted in report.refuted_pairs] == pytest.approx([0.3, 0.2, 0.1, 0.0])
    assert all(cv2.imdecode(np.frombuffer(each.jpeg, np.uint8), 0) is not None for each in report.refuted_pairs)


def test_baselines_are_those_of_the_same_run(tmp_path):
    path = tmp_path / "compare.json"
    assert read_baselines(path, 5, Config()) == {}
    methods = {
        "persistent": {"mean_track_length": 6.0, "track_length_histogram": {"6": 1}},
        "loftr_style_raw": {"mean_track_length": 2.0, "track_length_histogram": {"2": 9}},
        "loftr_style_1px": {"mean_track_length": 3.0, "track_length_histogram": {"3": 8}},
        "loftr_style_2px": {"mean_track_length": 3.5, "track_length_histogram": {"3": 4, "4": 4}},
    }
    comparison = {"num_images": 5, "config_fingerprint": fingerprint(Config()), "methods": methods}
    path.write_text(json.dumps(comparison))
    expected = {"loftr_style_raw": {2: 9}, "loftr_style_2px": {3: 4, 4: 4}}
    assert read_baselines(path, 5, Config()) == expected
    assert read_baselines(path, 6, Config()) == {}
    other = dataclasses.replace(Config(), pairs=dataclasses.replace(Config().pairs, mode="sequential"))
    assert read_baselines(path, 5, other) == {}
    for damaged in ("{", "[]", json.dumps({**comparison, "methods": {"loftr_style_raw": 3}})):
        path.write_text(damaged)
        assert read_baselines(path, 5, Config()) == {}


def test_the_scene_of_a_model_in_utm_coordinates_loses_nothing(run, report):
    """The page is in single precision."""
    _, images, model = run
    utm = pycolmap.Reconstruction(model)
    utm.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [500000.0, 4649776.0, 120.0]))
    scene = lay_out_scene(utm, {image.name: image.rotation_deg for image in images})
    np.testing.assert_allclose(scene.xyz, report.scene.xyz, atol=1e-6)
    np.testing.assert_allclose(scene.frusta, report.scene.frusta, atol=1e-6)
