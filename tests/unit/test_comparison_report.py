"""Table, JSON and plots of a comparison."""

import dataclasses
import json
import sys
import warnings

import numpy as np
import pytest

from hm_sfm.errors import MissingPackageError
from hm_sfm.evaluation.compared_methods import MethodResult
from hm_sfm.evaluation.comparison import Comparison
from hm_sfm.evaluation.comparison_report import (
    format_table,
    lay_out_histogram,
    plot_tracks,
    require_plots,
    write_comparison,
)

GOOD = MethodResult(
    name="persistent",
    registered=5,
    models=1,
    matched_tracks=2000,
    mean_matched_track_length=2.751,
    points=1234,
    points_in_3_images=700,
    observations=4000,
    observations_per_image=800.0,
    mean_track_length=3.241,
    median_track_length=3.0,
    track_length_histogram={2: 534, 3: 400, 5: 300},
    mean_reprojection_px=0.3456,
    auc_percent={0.25: 71.25, 0.5: 80.0, 1: 90.0, 3: 97.0},
    seconds={"match": 12.4, "keypoints": 1.6, "verify": 0.2, "map": 3.0},
)
NOTHING = dataclasses.replace(
    GOOD,
    name="hloc",
    registered=0,
    models=0,
    matched_tracks=0,
    mean_matched_track_length=0.0,
    points=0,
    points_in_3_images=0,
    observations=0,
    observations_per_image=0.0,
    mean_track_length=0.0,
    median_track_length=0.0,
    track_length_histogram={},
    mean_reprojection_px=0.0,
    auc_percent=dict.fromkeys((0.25, 0.5, 1, 3), 0.0),
    seconds={"match": None, "keypoints": None, "verify": 0.2, "map": 0.0},
)


def make_comparison(*methods: MethodResult) -> Comparison:
    return Comparison(5, 0, 10, methods, "0123456789abcdef")


def test_table_lines_up():
    heading, good, nothing = format_table(make_comparison(GOOD, NOTHING)).splitlines()
    assert len(heading) == len(good) == len(nothing)
    assert heading.split()[0] == "method" and "AUC@0.25" in heading and heading.endswith("map s")
    cells = "persistent 5 1 2.75 1234 700 3.24 3 800 0.346 71.2 80.0 90.0 97.0 12 2 0 3"
    assert good.split() == cells.split()
    assert nothing.split()[-4:] == ["-", "-", "0", "0"]


def test_table_without_ground_truth_has_no_auc():
    blind = dataclasses.replace(GOOD, auc_percent=None)
    heading, row = format_table(make_comparison(blind)).splitlines()
    assert "AUC" not in heading
    assert len(row.split()) == 14


def test_json_holds_all_metrics_by_method(tmp_path):
    write_comparison(tmp_path / "compare.json", make_comparison(GOOD, NOTHING))
    content = json.loads((tmp_path / "compare.json").read_text())
    assert (content["num_images"], content["num_pairs"]) == (5, 10)
    assert list(content["methods"]) == ["persistent", "hloc"]
    good = content["methods"]["persistent"]
    assert good.keys() == {field.name for field in dataclasses.fields(MethodResult)} - {"name"}
    assert good["track_length_histogram"] == {"2": 534, "3": 400, "5": 300}
    assert good["auc_percent"] == {"0.25": 71.25, "0.5": 80.0, "1": 90.0, "3": 97.0}
    assert content["methods"]["hloc"]["seconds"]["match"] is None


def test_histogram_is_filled_with_zeros():
    length, points = lay_out_histogram({3: 400, 5: 300})
    np.testing.assert_array_equal(length, [2, 3, 4, 5])
    np.testing.assert_array_equal(points, [0, 400, 0, 300])
    assert lay_out_histogram({})[1].tolist() == [0]


@pytest.mark.parametrize("methods", [(GOOD, NOTHING), (NOTHING,), (GOOD,) * 12], ids=["both", "no points", "many"])
def test_plot_is_a_png(tmp_path, methods):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plot_tracks(tmp_path / "compare.png", make_comparison(*methods))
    assert [path.name for path in tmp_path.iterdir()] == ["compare.png"]
    data = (tmp_path / "compare.png").read_bytes()
    assert data.startswith(b"\x89PNG") and len(data) > 10_000


def test_missing_matplotlib_is_said_clearly(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    for draw in (require_plots, lambda: plot_tracks(tmp_path / "compare.png", make_comparison(GOOD))):
        with pytest.raises(MissingPackageError, match="matplotlib, which is not installed: pip install matplotlib"):
            draw()
    assert not list(tmp_path.iterdir())
