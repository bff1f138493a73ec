"""Options: one home for each default, every error named at once, hashes that see what matters."""

import dataclasses
from pathlib import Path

import pytest

from corrsfm import config as cfg
from corrsfm.errors import ConfigError

STAGES = [entry.default_factory for entry in dataclasses.fields(cfg.PipelineConfig)]  # type: ignore[misc]


def test_every_option_has_a_help_text() -> None:
    options = [entry for stage in STAGES for entry in dataclasses.fields(stage)]
    assert len(options) > 25
    assert not [
        entry.name
        for entry in options
        if len(entry.metadata["help"]) < 8 or entry.metadata["help"][-1] == "."
    ]


def test_no_two_stages_share_an_option_name() -> None:
    names = [entry.name for stage in STAGES for entry in dataclasses.fields(stage)]
    assert len(names) == len(set(names))


def test_a_pipeline_file_overrides_only_what_it_names(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text(
        '[features]\nmax-features = 7\n[pairs]\npairing = ["sequential", "spatial"]\nmax_distance_m = 5\n'
    )
    config = cfg.load_pipeline(path)
    assert config.features == dataclasses.replace(cfg.FeaturesConfig(), max_features=7)
    assert config.pairs.pairing == (cfg.PairStrategy.SEQUENTIAL, cfg.PairStrategy.SPATIAL)
    assert config.pairs.max_distance_m == 5.0
    assert config.prune == cfg.PruneConfig()


def test_all_errors_of_a_pipeline_file_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text(
        '[features]\nmax_features = 0\nsize = 1\nmax-features = 7\n[prune]\nmethod = "magic"\n[colour]\n'
        '[run]\nseed = "x"\n'
    )
    with pytest.raises(ConfigError) as error:
        cfg.load_pipeline(path)
    text = str(error.value)
    for part in (
        str(path),
        "features.max_features is 0, expected at least 1",
        "'features.max-features' is there twice, with - and with _",
        "unknown key 'features.size', valid are extractor, max_features",
        "prune.method is 'magic', expected one of none, ratio",
        "unknown key 'colour', valid are images, features",
        "run.seed is 'x', expected a whole number",
    ):
        assert part in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[prune]\nmax_error_px = 0", "prune.max_error_px is 0.0, expected more than 0"),
        ("[prune]\nmax_ratio = nan", "prune.max_ratio is nan, expected a finite number"),
        ("[pairs]\nmax_distance_m = inf", "pairs.max_distance_m is inf, expected a finite number"),
        ("[run]\nseed = 2147483648", "run.seed is 2147483648, expected at most 2147483647"),
        ("[features]\nmax_features = 5000000000", "max_features is 5000000000, expected at most 2147483647"),
        ("[run]\nthreads = 100000", "run.threads is 100000, expected at most 1024"),
        ("[reconstruction]\nmax_runtime_minutes = 1e9", "expected at most 35791394"),
    ],
)
def test_numbers_that_a_stage_would_choke_on_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        cfg.load_pipeline(path)
    assert message in str(error.value)


def test_the_largest_seed_is_valid() -> None:
    assert cfg.from_dict(cfg.RunConfig, {"seed": 2147483647}, "here").seed == 2147483647


@pytest.mark.parametrize("text", ["[features", "features = 3", "[features]\nroot_sift = 1"])
def test_broken_pipeline_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "p.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="p.toml"):
        cfg.load_pipeline(path)


def test_a_missing_pipeline_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        cfg.load_pipeline(tmp_path / "none.toml")


def test_every_bundled_pipeline_file_loads(repository: Path) -> None:
    files = [
        path
        for path in sorted((repository / "pipelines").rglob("*.toml"))
        if not path.name.startswith("train")
    ]
    assert len(files) >= 4
    for path in files:
        cfg.load_pipeline(path)


def test_hash_changes_with_results_and_not_with_speed() -> None:
    base = cfg.PruneConfig()
    assert cfg.config_hash(base) == cfg.config_hash(cfg.PruneConfig())
    assert cfg.config_hash(base) != cfg.config_hash(dataclasses.replace(base, max_ratio=0.7))
    assert cfg.config_hash(base) == cfg.config_hash(dataclasses.replace(base, max_batch_matches=99))


def test_hash_of_nested_records_is_by_value() -> None:
    from corrsfm.types import Camera

    camera = Camera(model="PINHOLE", width=4, height=3, params=(1.0, 1.0, 2.0, 1.5))
    same = Camera(model="PINHOLE", width=4, height=3, params=(1.0, 1.0, 2.0, 1.5))
    other = dataclasses.replace(camera, width=5)
    assert cfg.config_hash([camera]) == cfg.config_hash([same]) != cfg.config_hash([other])


def test_values_nested_without_end_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "deep.toml").write_text("a=" + 100_000 * "[")
    with pytest.raises(ConfigError, match=r"deep\.toml: its values are nested too deep"):
        cfg.load_pipeline(tmp_path / "deep.toml")


def test_files_of_a_config_get_absolute_paths_and_names_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.pt").touch()
    config = cfg.PruneConfig(model=Path("mine.pt"), max_candidates=7)
    assert cfg.absolute(config) == dataclasses.replace(config, model=tmp_path / "mine.pt")
    bundled = cfg.PruneConfig(model=Path("small-mutual"))
    assert cfg.absolute(bundled) == bundled
