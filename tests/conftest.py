"""What holds for all tests."""

from hypothesis import settings

# A deadline would assert wall-clock time, and fail on a busy machine.
settings.register_profile("flexsheet", deadline=None)
settings.load_profile("flexsheet")
