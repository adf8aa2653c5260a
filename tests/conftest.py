"""What all tests share: one cache of generated kernels for the session, and the files in tests/data."""

import json
import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def kernel_cache(tmp_path_factory):
    """A directory of this session's own: no test depends on what the user has cached, nor leaves anything there."""
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # shared by the workers of one run
    directory = base / "kernels"
    directory.mkdir(mode=0o700, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NHENV_CACHE_DIR", str(directory))
        yield directory


@pytest.fixture(scope="session", autouse=True)
def no_windows():
    """What draws into a window draws into one that nobody sees, with or without a display."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SDL_VIDEODRIVER", "dummy")
        yield


@pytest.fixture(scope="session")
def data_records():
    """Read a JSON file below tests/data."""

    def read(name):
        return json.loads((Path(__file__).parent / "data" / name).read_text(encoding="utf-8"))

    return read
