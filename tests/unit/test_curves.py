"""The picture of a training."""

import sys

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from hm_sfm.errors import MissingPackageError
from hm_sfm.training.curves import draw_curves, read_columns, smooth
from hm_sfm.training.log import append_row


@pytest.fixture
def files(tmp_path):
    """Log, validation and picture of a training of three steps."""
    for step in (1, 2, 3):
        row = {"step": step, "loss": 3.0 / step, "coarse": 2.0 / step, "gradient": 50.0, "rate": 1e-3, "seconds": 9.0}
        append_row(tmp_path / "log.csv", row)
    return tmp_path / "log.csv", tmp_path / "validation.csv", tmp_path / "curves.png"


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    """The figures that are saved."""
    figures = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *args, **more: (figures.append(figure), save(figure, *args, **more))
    )
    return figures


def test_losses_learning_rate_and_scores_are_drawn(files, drawn):
    log, validation, path = files
    append_row(validation, {"step": 2, "real_recall": 30.0, "median_px": 0.8})
    append_row(validation, {"step": 3, "real_recall": 40.0, "median_px": 0.7})
    draw_curves(log, validation, path)
    picture = cv2.imread(str(path))
    assert picture.shape[1] == 1500 and picture.std() > 10
    losses, rate, recall, error = drawn[0].axes
    assert [line.get_label() for line in losses.get_lines()] == ["loss", "coarse"]
    np.testing.assert_allclose(losses.get_lines()[0].get_ydata(), [3, 1.5, 1])
    np.testing.assert_allclose(rate.get_lines()[0].get_ydata(), 1e-3)
    assert "real_recall" in recall.get_title() and "median_px" in error.get_title()
    assert recall.get_lines()[0].get_xydata().tolist() == [[2, 30], [3, 40]]
    assert error.get_lines()[0].get_xydata().tolist() == [[2, 0.8], [3, 0.7]]
    assert sorted(p.name for p in path.parent.iterdir()) == ["curves.png", "log.csv", "validation.csv"]


def test_scores_of_one_kind_share_a_panel(files, drawn):
    """And a bin without a match leaves a gap."""
    log, validation, path = files
    append_row(validation, {"step": 2, "right@0.2": 30.0, "median_px": 0.8, "right@0.4": float("nan")})
    draw_curves(log, validation, path)
    _, _, right, error = drawn[0].axes
    assert [line.get_label() for line in right.get_lines()] == ["right@0.2", "right@0.4"]
    assert right.get_title() == "held-out pairs: right" and error.get_title() == "held-out pairs: median_px"


def test_before_the_first_validation_there_are_losses_only(files, drawn):
    draw_curves(*files)
    assert files[2].exists() and len(drawn[0].axes) == 2


def test_a_failing_picture_leaves_the_earlier_one(files, monkeypatch):
    draw_curves(*files)
    before = files[2].read_bytes()

    def fail(figure, path, **more):
        path.write_bytes(b"half a picture")
        raise OSError("no space left")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="no space left"):
        draw_curves(*files)
    assert files[2].read_bytes() == before
    assert sorted(p.name for p in files[2].parent.iterdir()) == ["curves.png", "log.csv"]


def test_without_matplotlib_the_package_is_named(files, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingPackageError, match="curves.png.*matplotlib"):
        draw_curves(*files)
    assert not files[2].exists()


def test_long_curves_are_running_means():
    step = np.arange(1.0, 501)
    value = np.where(step % 2, 4.0, 2.0)
    mean_step, mean = smooth(step, value)
    np.testing.assert_allclose(mean, 3)
    np.testing.assert_allclose(mean_step, np.arange(5.5, 496))
    assert smooth(step[:7], value[:7])[1].tolist() == value[:7].tolist()
    assert len(smooth(step[:0], value[:0])[0]) == 0


def test_columns_are_read_by_their_names(files):
    columns = read_columns(files[0])
    assert list(columns) == ["step", "loss", "coarse", "gradient", "rate", "seconds"]
    np.testing.assert_allclose(columns["coarse"], [2, 1, 2 / 3], rtol=1e-5)
    files[0].write_text("step,loss\n")
    assert [len(column) for column in read_columns(files[0]).values()] == [0, 0]
