"""Settings of all tests, and the fixtures that tests of several folders use."""

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

# Time limits per example fail at random on busy machines, and a test run must give the same result twice.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")


@pytest.fixture
def one_thread() -> Iterator[None]:
    """PyTorch computes with one thread: several add up in another order, which changes the last bits of a result."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
