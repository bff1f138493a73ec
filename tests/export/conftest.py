"""One finished scene for all tests of exports; none of them changes it."""

import pytest
from finished_scene import FinishedScene, make_finished_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> FinishedScene:
    return make_finished_scene(tmp_path_factory.mktemp("opencv") / "made")


@pytest.fixture(scope="session")
def radial_scene(tmp_path_factory: pytest.TempPathFactory) -> FinishedScene:
    """A camera with one focal length and its principal point in the middle."""
    return make_finished_scene(tmp_path_factory.mktemp("radial") / "made", camera="SIMPLE_RADIAL")
