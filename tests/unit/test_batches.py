import pytest

from hm_sfm.io import batches
from hm_sfm.io.batches import store_in_batches


def test_results_are_written_together_at_the_end():
    written = []
    with store_in_batches(written.append) as keep:
        keep([1, 2])
        keep([])
        keep([3])
        assert not written
    assert written == [[1, 2, 3]]


def test_results_are_written_when_it_is_time(monkeypatch):
    monkeypatch.setattr(batches, "BATCH_SECONDS", -1.0)
    written = []
    with store_in_batches(written.append) as keep:
        keep([1])
        keep([2, 3])
    assert written == [[1], [2, 3], []]


def test_what_is_there_is_written_when_the_loop_fails():
    written = []
    with pytest.raises(KeyboardInterrupt), store_in_batches(written.append) as keep:
        keep([1])
        raise KeyboardInterrupt
    assert written == [[1]]


def test_errors_of_writing_go_through():
    def refuse(batch):
        raise OSError("full")

    with pytest.raises(OSError, match="full"), store_in_batches(refuse) as keep:
        keep([1])
