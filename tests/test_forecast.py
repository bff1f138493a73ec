"""A forecast measures the stages before mapping on a few photos and multiplies."""

from pathlib import Path

import pytest
from photos import write_photos

from corrsfm import Forecast, forecast_run
from corrsfm import config as cfg
from corrsfm.errors import InputError

CONFIG = cfg.PipelineConfig(
    features=cfg.FeaturesConfig(max_features=200),
    prune=cfg.PruneConfig(method=cfg.PruneMethod.RATIO),
    run=cfg.RunConfig(threads=1, device="cpu"),
)


def test_a_forecast_counts_all_photos_and_measures_some(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    names = write_photos(tmp_path / "photos", 9)
    found = forecast_run(tmp_path / "photos", names, CONFIG)
    assert (found.num_photos, found.num_pairs) == (9, 36)
    assert found.seconds_per_photo > 0 and found.seconds_per_pair > 0
    # 200 keypoints of 128 bytes and a few floats.
    assert 200 * 128 < found.bytes_per_photo < 200 * 400
    assert 0 < found.bytes_per_pair < 100_000
    assert not caplog.messages
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]


def test_minutes_and_disk_grow_with_photos_and_pairs() -> None:
    found = Forecast(
        num_photos=300, num_pairs=9000, seconds_per_photo=2.0, seconds_per_pair=0.1,
        bytes_per_photo=1e6, bytes_per_pair=1e5,
    )  # fmt: skip
    assert found.minutes == pytest.approx(25)
    assert found.megabytes == pytest.approx(1200)
    assert str(found).startswith(
        "a run matches 9,000 pairs: about 25 min on this machine, then mapping, and 1,200 MB of disk"
    )


def test_one_photo_has_no_forecast(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 photos; a forecast needs two"):
        forecast_run(tmp_path, ["0.png"], CONFIG)
