"""hloc's files come in as they are, or not at all."""

import contextlib
import dataclasses
import logging
import os
import sqlite3
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from foreign_files import NUM, SIZE, unit_vectors, write_features, write_matches
from photos import write_photos

import corrsfm
from corrsfm import config as cfg
from corrsfm import pipeline
from corrsfm.errors import ConfigError, CorrsfmError, InputError, WorkspaceError
from corrsfm.finished.advice import more_photos_to_add
from corrsfm.importing.scene import import_features
from corrsfm.workspace import Workspace
from corrsfm.workspace.imported import imported_from
from corrsfm.workspace.resume import complete

RUN = cfg.RunConfig(threads=1, device="cpu")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    write_photos(tmp_path / "photos", 3)
    return tmp_path / "photos"


@pytest.fixture
def names(photos: Path) -> list[str]:
    return sorted(path.name for path in photos.iterdir())


@pytest.fixture
def features(tmp_path: Path, names: list[str]) -> Path:
    write_features(tmp_path / "features.h5", names)
    return tmp_path / "features.h5"


def edit(path: Path, name: str, key: str, value: object) -> None:
    """Replace a data set, or drop it for None."""
    with h5py.File(path, "r+") as file:
        del file[name][key]
        if value is not None:
            file[name][key] = value


def add_shapes(path: Path, name: str, *, scale: float = 2.0, angle: float = 0.5) -> None:
    """Scales and orientations of all photos, of which one keypoint of one photo has these."""
    with h5py.File(path, "r+") as file:
        for photo in file:
            scales, angles = np.full(NUM, 2.0), np.full(NUM, 0.5)
            if photo == name:
                scales[3], angles[3] = scale, angle
            file[photo]["scales"], file[photo]["oris"] = scales, angles


def test_features_come_in_with_half_a_pixel_and_without_what_they_lack(
    photos: Path, features: Path, tmp_path: Path, names: list[str]
) -> None:
    result = import_features(photos, tmp_path / "scene", features=features, kind="superpoint")
    assert (result.num_photos, result.num_keypoints, result.descriptor_size) == (3, 3 * NUM, SIZE)
    assert (result.kind, result.has_shapes, result.num_pairs) == (cfg.FeatureKind.SUPERPOINT, False, 0)
    found = corrsfm.open_workspace(tmp_path / "scene").features(names[0])
    np.testing.assert_array_equal(found.keypoints[2], [2.5, 1.5])
    np.testing.assert_allclose(found.descriptors, unit_vectors(NUM, 0), atol=5e-4)
    np.testing.assert_allclose(found.scores, np.linspace(1, 0.1, NUM), rtol=1e-6)
    assert found.scales is None and found.orientations is None


def test_the_stages_go_on_from_imported_features_and_keep_them(
    photos: Path, features: Path, tmp_path: Path, names: list[str]
) -> None:
    import_features(photos, tmp_path / "scene", features=features)
    workspace = Workspace(tmp_path / "scene")
    before = workspace.features.stat().st_mtime_ns
    for overwrite in (False, True):
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
        outcome = pipeline.extract_features(workspace, cfg.FeaturesConfig(), RUN, overwrite=overwrite)
        assert outcome.skipped and workspace.features.stat().st_mtime_ns == before
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN)
    matches = corrsfm.open_workspace(tmp_path / "scene").matches((names[0], names[1]))
    np.testing.assert_array_equal(matches.indices[:, 0], matches.indices[:, 1])
    assert matches.mutual.all() and (matches.ratios == 0).all()


def test_more_photos_of_imported_features_are_asked_for_by_import(
    photos: Path, features: Path, tmp_path: Path
) -> None:
    import_features(photos, tmp_path / "scene", features=features)
    step = more_photos_to_add(Workspace(tmp_path / "scene"), "next to a.jpg")
    assert "corrsfm import" in step and step.endswith("--overwrite") and "corrsfm add" not in step


def test_matches_come_in_and_are_not_made_again(
    photos: Path, features: Path, tmp_path: Path, names: list[str]
) -> None:
    write_matches(tmp_path / "matches.h5", [(names[1], names[0]), (names[0], names[2])])
    result = import_features(photos, tmp_path / "scene", features=features, matches=tmp_path / "matches.h5")
    assert (result.num_pairs, result.num_matches) == (2, NUM)
    workspace = Workspace(tmp_path / "scene")
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    for stage in (
        pipeline.extract_features(workspace, cfg.FeaturesConfig(), RUN),
        pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN),
        pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN),
    ):
        assert stage.skipped, stage
    scene = corrsfm.open_workspace(tmp_path / "scene")
    assert scene.pairs == ((names[0], names[1]), (names[0], names[2]))
    found = scene.matches(scene.pairs[0])
    np.testing.assert_array_equal(found.indices, np.repeat(np.arange(0, NUM, 2)[:, None], 2, axis=1))
    assert np.isnan(found.ratios).all() and found.mutual.all()
    assert found.scores is not None and (found.scores == 0.75).all()
    kept = pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.NONE), RUN)
    assert kept.num_items == 2
    for method in (cfg.PruneMethod.RATIO, cfg.PruneMethod.CORRADAPTOR):
        with pytest.raises(CorrsfmError, match="ratio of descriptor distances.*--method loransac"):
            pipeline.prune_matches(workspace, cfg.PruneConfig(method=method), RUN)


def test_options_that_ask_for_other_items_than_the_imported_ones_are_named(
    photos: Path, features: Path, tmp_path: Path, names: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    write_matches(tmp_path / "matches.h5", [(names[0], names[1]), (names[0], names[2])])
    import_features(photos, tmp_path / "scene", features=features, matches=tmp_path / "matches.h5")
    workspace = Workspace(tmp_path / "scene")
    caplog.clear()
    pipeline.extract_features(workspace, cfg.FeaturesConfig(), RUN)
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(block_size=128), RUN)
    assert "no effect" not in caplog.text
    pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=77), RUN)
    pipeline.make_pairs(workspace, cfg.PairsConfig(sequential_overlap=1), RUN)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN, overwrite=True)
    kept = "they were imported and are kept; no effect:"
    for told in (
        f"features: {kept} --max-features 77",
        f"pairs: {kept} --sequential-overlap 1",
        f"matches: {kept} --overwrite",
    ):
        assert told in caplog.text


def test_what_was_imported_of_photos_that_are_left_out_waits_for_their_return(
    photos: Path, features: Path, tmp_path: Path, names: list[str]
) -> None:
    pairs = [(names[0], names[1]), (names[0], names[2])]
    write_matches(tmp_path / "matches.h5", pairs)
    import_features(photos, tmp_path / "scene", features=features, matches=tmp_path / "matches.h5")
    workspace = Workspace(tmp_path / "scene")
    (tmp_path / "two.txt").write_text(f"{names[0]}\n{names[1]}\n")
    for image_list, wanted in ((tmp_path / "two.txt", pairs[:1]), (None, pairs)):
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(image_list=image_list), RUN)
        pipeline.extract_features(workspace, cfg.FeaturesConfig(), RUN)
        pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
        pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN)
        scene = corrsfm.open_workspace(tmp_path / "scene")
        assert scene.pairs == tuple(wanted)
        assert [len(scene.matches(pair)) for pair in wanted] == [NUM // 2] * len(wanted)


def test_options_for_other_features_are_refused_before_any_work(
    photos: Path, features: Path, tmp_path: Path
) -> None:
    import_features(photos, tmp_path / "scene", features=features)
    with pytest.raises(ConfigError, match="features were imported and are kept; for those of disk"):
        pipeline.check_options(
            RUN,
            features=cfg.FeaturesConfig(extractor=cfg.Extractor.DISK),
            workspace_dir=tmp_path / "scene",
        )
    with pytest.raises(
        ConfigError, match="lightglue has weights for aliked and disk, these features are other"
    ):
        pipeline.check_options(
            RUN,
            matches=cfg.MatchesConfig(matcher=cfg.Matcher.LIGHTGLUE),
            workspace_dir=tmp_path / "scene",
        )


def test_a_photo_that_changed_after_the_import_is_named(
    photos: Path, features: Path, tmp_path: Path, names: list[str]
) -> None:
    import_features(photos, tmp_path / "scene", features=features)
    (photos / names[1]).write_bytes((photos / names[0]).read_bytes())
    workspace = Workspace(tmp_path / "scene")
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    with pytest.raises(WorkspaceError, match=f"no features of {names[1]}.*corrsfm import .*--features"):
        pipeline.extract_features(workspace, cfg.FeaturesConfig(), RUN)


def test_half_precision_keypoints_are_warned_of(
    photos: Path, names: list[str], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_features(tmp_path / "half.h5", names, half=True)
    with caplog.at_level(logging.WARNING, "corrsfm"):
        import_features(photos, tmp_path / "scene", features=tmp_path / "half.h5")
    assert "keypoints of 3 photos are half-precision numbers" in caplog.text


@pytest.mark.parametrize(
    ("break_it", "text"),
    [
        (
            lambda path, name: edit(path, name, "descriptors", None),
            "has no 'descriptors', only keypoints, scores",
        ),
        (
            lambda path, name: edit(path, name, "descriptors", unit_vectors(NUM, 0)),
            r"descriptors have shape \(40, 64\), expected \(D, 40\)",
        ),
        (
            lambda path, name: edit(path, name, "descriptors", unit_vectors(NUM, 0, 32).T),
            "descriptors of .* are 64 × float32, those of .* are 32 × float32",
        ),
        (
            lambda path, name: edit(path, name, "keypoints", np.full((NUM, 2), np.nan, np.float32)),
            "keypoint 0 is not a finite number",
        ),
        (
            lambda path, name: edit(path, name, "keypoints", np.full((NUM, 2), 5000, np.float32)),
            r"keypoint 0 at \(5000.5, 5000.5\) lies outside of the photo",
        ),
        (
            lambda path, name: edit(path, name, "keypoints", np.zeros((NUM, 3), np.float32)),
            r"shape \(40, 3\)",
        ),
        (lambda path, name: edit(path, name, "scores", np.zeros(3, np.float32)), r"scores have shape \(3,\)"),
        (
            lambda path, name: edit(path, name, "keypoints", np.full((NUM, 2), 1e300)),
            "keypoint 0 is not a finite number",
        ),
        (
            lambda path, name: edit(path, name, "descriptors", np.full((SIZE, NUM), 1e300)),
            "descriptor 0 is not a finite number",
        ),
        (
            lambda path, name: edit(path, name, "descriptors", np.full((SIZE, NUM), 1e30)),
            "length of descriptor 0 is not a finite number",
        ),
        (
            lambda path, name: edit(path, name, "scores", np.full(NUM, np.inf)),
            "score of keypoint 0 is not a finite number",
        ),
        (lambda path, name: add_shapes(path, name, scale=np.nan), "scale of keypoint 3 is nan.*extract"),
        (lambda path, name: add_shapes(path, name, scale=-1), "scale of keypoint 3 is -1, expected a finite"),
        (lambda path, name: add_shapes(path, name, scale=0), "scale of keypoint 3 is 0"),
        (lambda path, name: add_shapes(path, name, scale=1e300), "scale of keypoint 3 is inf"),
        (lambda path, name: add_shapes(path, name, scale=1e-300), "scale of keypoint 3 is 0"),
        (
            lambda path, name: add_shapes(path, name, angle=np.inf),
            "orientation of keypoint 3 is not",
        ),
        (lambda path, name: add_shapes(path, name, angle=np.nan), "or give them without scales"),
    ],
)
def test_bad_features_are_refused_and_leave_nothing(
    photos: Path,
    features: Path,
    tmp_path: Path,
    names: list[str],
    break_it: Callable[[Path, str], None],
    text: str,
) -> None:
    break_it(features, names[1])
    with pytest.raises(InputError, match=text) as error:
        import_features(photos, tmp_path / "scene", features=features)
    assert str(features) in str(error.value) and names[1] in str(error.value)
    assert not (tmp_path / "scene").exists()


def test_names_must_be_those_of_the_photos(photos: Path, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "features.h5"
    write_features(path, [f"db/{name}" for name in names])
    with pytest.raises(InputError, match=f"its names are like 'db/{names[0]}', these photos are like"):
        import_features(photos, tmp_path / "scene", features=path)
    write_features(path, [*names, "query.jpg"])
    with pytest.raises(InputError, match="features of query.jpg, which .* does not hold"):
        import_features(photos, tmp_path / "scene", features=path)
    write_features(path, names[:2])
    with pytest.raises(InputError, match=f"no features of {names[2]}"):
        import_features(photos, tmp_path / "scene", features=path)


@pytest.mark.parametrize(
    ("matches", "text"),
    [
        (np.full(NUM, NUM, np.int32), "names keypoint 40 of the second photo, which has 40"),
        (np.full(NUM, -2, np.int32), "names keypoint -2 of the second photo"),
        (np.zeros(NUM + 1, np.int32), "matches of 41 keypoints, but the first photo has 40"),
        (np.zeros(NUM, np.float32), "matches0 is float32, expected integers"),
    ],
)
def test_bad_matches_are_refused_and_leave_nothing(
    photos: Path, features: Path, names: list[str], tmp_path: Path, matches: np.ndarray, text: str
) -> None:
    path = tmp_path / "matches.h5"
    with h5py.File(path, "w") as file:
        file[f"{names[0]}/{names[1]}/matches0"] = matches
    with pytest.raises(InputError, match=text) as error:
        import_features(photos, tmp_path / "scene", features=features, matches=path)
    assert f"{names[0]} – {names[1]}" in str(error.value)
    assert not (tmp_path / "scene").exists()


def test_infinite_scores_of_matches_are_refused(
    photos: Path, features: Path, names: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "matches.h5"
    write_matches(path, [(names[0], names[1])])
    with h5py.File(path, "r+") as file:
        file[f"{names[0]}/{names[1]}/matching_scores0"][2] = np.inf
    with pytest.raises(InputError, match=f"{names[0]} – {names[1]}: the score of match 1 is infinite"):
        import_features(photos, tmp_path / "scene", features=features, matches=path)


def test_a_link_into_another_file_is_refused_before_anything_behind_it_is_opened(
    photos: Path, features: Path, names: list[str], tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "pipe.h5")  # opening it would not end
    with h5py.File(features, "r+") as file:
        del file[names[0]]["keypoints"]
        file[names[0]]["keypoints"] = h5py.ExternalLink("pipe.h5", "/x")
    with pytest.raises(InputError, match=f"features.h5: .*{names[0]}/keypoints is a link into another file"):
        import_features(photos, tmp_path / "scene", features=features)


def test_names_that_are_not_text_are_refused(photos: Path, names: list[str], tmp_path: Path) -> None:
    write_features(tmp_path / "features.h5", names)
    with h5py.File(tmp_path / "features.h5", "r+") as file:
        file.create_group(b"p\xff\xfe.jpg")["keypoints"] = np.zeros((NUM, 2))
    with pytest.raises(InputError, match=r"features\.h5: .*the name 'p\\xff\\xfe\.jpg' is not UTF-8"):
        import_features(photos, tmp_path / "scene", features=tmp_path / "features.h5")


def test_errors_name_a_photo_as_it_is_called(
    photos: Path, features: Path, names: list[str], tmp_path: Path
) -> None:
    edit(features, names[0], "scores", np.full(NUM, b"a"))
    with pytest.raises(InputError, match=f"features.h5: {names[0]}: 'scores' is"):
        import_features(photos, tmp_path / "scene", features=features)


def test_pairs_of_other_photos_twice_or_of_one_photo_are_refused(
    photos: Path, features: Path, names: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "matches.h5"
    for pairs, text in (
        ([(names[0], "x.jpg")], "not there: x.jpg"),
        ([(names[0], names[1]), (names[1], names[0])], "the pair is there twice"),
        ([(names[0], names[0])], "a photo is matched with itself"),
    ):
        write_matches(path, pairs)
        with pytest.raises(InputError, match=text):
            import_features(photos, tmp_path / "scene", features=features, matches=path)


def test_a_workspace_with_features_keeps_them(photos: Path, features: Path, tmp_path: Path) -> None:
    import_features(photos, tmp_path / "scene", features=features)
    before = (tmp_path / "scene" / "features.db").read_bytes()
    with pytest.raises(WorkspaceError, match="is there already; choose another folder, or add --overwrite"):
        import_features(photos, tmp_path / "scene", features=features)
    assert (tmp_path / "scene" / "features.db").read_bytes() == before
    import_features(photos, tmp_path / "scene", features=features, overwrite=True)


def test_one_source_must_be_given(photos: Path, features: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give --features, or --database"):
        import_features(photos, tmp_path / "scene")
    with pytest.raises(ConfigError, match="--rematch belongs to --database"):
        import_features(photos, tmp_path / "scene", features=features, with_matches=False)
    with pytest.raises(InputError, match="cannot be read as HDF5"):
        (tmp_path / "text.h5").write_text("no")
        import_features(photos, tmp_path / "scene", features=tmp_path / "text.h5")


@pytest.mark.parametrize("name", ["features.h5", "matches.h5"])
def test_files_of_hloc_in_the_folder_of_a_workspace_stay_as_they_are(
    photos: Path, names: list[str], tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "hloc"
    folder.mkdir()
    write_features(folder / name, names)
    before = (folder / name).read_bytes()
    pipeline.run_scene(photos, folder, cfg.PipelineConfig(run=RUN))
    manifest = folder / "workspace.json"
    old = manifest.read_text("utf-8").replace('"format_version": 2', '"format_version": 1')
    manifest.write_text(old, "utf-8")
    with Workspace(folder).lock():
        pass
    assert (folder / name).read_bytes() == before


def test_lightglue_is_not_asked_for_features_that_it_does_not_know(
    photos: Path, features: Path, names: list[str], tmp_path: Path
) -> None:
    lightglue = cfg.MatchesConfig(matcher=cfg.Matcher.LIGHTGLUE)
    import_features(photos, tmp_path / "scene", features=features)
    workspace = Workspace(tmp_path / "scene")
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    with pytest.raises(ConfigError, match="lightglue has weights for aliked and disk"):
        pipeline.match_pairs(workspace, lightglue, RUN)
    write_matches(tmp_path / "matches.h5", [(names[0], names[1])])
    import_features(photos, tmp_path / "other", features=features, matches=tmp_path / "matches.h5")
    with pytest.raises(ConfigError, match="matches were imported and are kept"):
        pipeline.match_pairs(Workspace(tmp_path / "other"), lightglue, RUN)


@pytest.fixture
def matched(tmp_path: Path, names: list[str]) -> Path:
    write_matches(tmp_path / "matches.h5", [(names[0], names[1]), (names[1], names[2])])
    return tmp_path / "matches.h5"


def go_on(workspace: Workspace, photos: Path, run: cfg.RunConfig = RUN) -> None:
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), run)
    pipeline.extract_features(workspace, cfg.FeaturesConfig(), run)
    pipeline.make_pairs(workspace, cfg.PairsConfig(), run)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), run)


def test_an_import_outlives_the_manifest(
    photos: Path, features: Path, matched: Path, tmp_path: Path, names: list[str]
) -> None:
    import_features(photos, tmp_path / "scene", features=features, matches=matched)
    workspace = Workspace(tmp_path / "scene")
    go_on(workspace, photos)
    recorded = {stage: workspace.record_of(stage).fingerprint for stage in ("features", "matches")}
    workspace.manifest.unlink()
    workspace = Workspace(tmp_path / "scene", create=True)
    go_on(workspace, photos)
    assert {stage: workspace.record_of(stage).fingerprint for stage in recorded} == recorded
    assert imported_from(workspace, "features").features == features


@pytest.mark.parametrize("stage", ["features", "matches"])
def test_a_killed_import_is_not_mistaken_for_none(
    stage: str, photos: Path, features: Path, matched: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(workspace: Workspace, which: str, *rest: object, **options: object) -> object:
        if which == stage:
            raise KeyboardInterrupt
        return complete(workspace, which, *rest, **options)

    (tmp_path / "scene").mkdir()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("corrsfm.importing.scene.complete", fail)
        import_features(photos, tmp_path / "scene", features=features, matches=matched)
    with pytest.raises(WorkspaceError, match=r"not finished; run: corrsfm import .*matches\.h5"):
        go_on(Workspace(tmp_path / "scene"), photos)
    # The same command again is enough.
    import_features(photos, tmp_path / "scene", features=features, matches=matched)
    go_on(Workspace(tmp_path / "scene"), photos)


@pytest.mark.parametrize("name", ["features.db", "matches.db"])
@pytest.mark.parametrize("way", ["cut", "row"])
def test_damaged_imports_are_kept_until_they_are_imported_again(
    name: str, way: str, photos: Path, features: Path, matched: Path, tmp_path: Path
) -> None:
    import_features(photos, tmp_path / "scene", features=features, matches=matched)
    path = tmp_path / "scene" / name
    if way == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    else:
        with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as connection:
            connection.execute("UPDATE arrays SET data = zeroblob(length(data)) WHERE number = 2")
    before = path.read_bytes()
    # One row is noticed where it is read; else by --verify.
    for verify in (False, True) if way == "cut" else (True,):
        with pytest.raises(WorkspaceError, match=r"corrsfm import .* --overwrite$"):
            go_on(Workspace(tmp_path / "scene"), photos, dataclasses.replace(RUN, verify=verify))
        assert path.read_bytes() == before
    import_features(photos, tmp_path / "scene", features=features, matches=matched, overwrite=True)
    go_on(Workspace(tmp_path / "scene"), photos, dataclasses.replace(RUN, verify=True))
