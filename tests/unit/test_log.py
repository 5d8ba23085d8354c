"""The rows of a training."""

from hm_sfm.training.log import append_row, drop_rows_after


def test_rows_that_are_cut_short_or_too_late_are_dropped(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("step,loss\n1,0.5\n2,0.25\n3,0.125\n10,0.5\n")
    drop_rows_after(path, 2)
    assert path.read_text() == "step,loss\n1,0.5\n2,0.25\n"
    # The machine went down in the middle of "25,0.75": neither its beginning nor one without an end is a row.
    for rest in ("2", "2,0.7"):
        path.write_text("step,loss\n1,0.5\n" + rest)
        drop_rows_after(path, 20)
        assert path.read_text() == "step,loss\n1,0.5\n"
    path.write_text("")
    drop_rows_after(path, 20)
    append_row(path, {"step": 1, "loss": 0.5})
    assert path.read_text().split() == ["step,loss", "1,0.5"]
    drop_rows_after(tmp_path / "absent.csv", 1)
    assert not (tmp_path / "absent.csv").exists()
