"""Settings of all tests, and the fixtures that tests of several folders use."""

from collections.abc import Iterator

import pytest
import torch
from hypothesis import settings

# Time limits per example fail at random on busy machines, and a test run must give the same result twice.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")

# Made once for many tests, but not in a moment: scenes that are rendered, a cluster, several training processes.
SLOW_FIXTURES = {"cluster", "demo", "scene", "several"}


@pytest.hookimpl(tryfirst=True)  # before those that are not wanted are left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what needs such a fixture as slow, beside the tests that are marked themselves."""
    for item in items:
        if SLOW_FIXTURES & set(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """PyTorch computes with one thread: several add up in another order, which changes the last bits of a result."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
