"""Settings of all tests."""

from hypothesis import settings

# Time limits per example fail at random on busy machines, and a test run must give the same result twice.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")
