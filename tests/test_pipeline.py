"""Resume that can be trusted: what is redone, what is kept, and that a kill loses nothing."""

import contextlib
import dataclasses
import json
import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from photos import write_photo, write_photos

from corrsfm import config as cfg
from corrsfm import files, pipeline
from corrsfm.colmap import log as colmap
from corrsfm.colmap.models import read_models
from corrsfm.errors import ImageError, InputError, ReconstructionError, WorkspaceError
from corrsfm.features import sift as features
from corrsfm.features import stage as features_stage
from corrsfm.images import cache
from corrsfm.images import photos as images
from corrsfm.pipeline import run_scene
from corrsfm.reconstruction import stage as mapping
from corrsfm.types import Correspondences, PruneResult
from corrsfm.workspace import StageRecord, Workspace
from corrsfm.workspace.lists import read_index, read_pairs
from corrsfm.workspace.store import ItemStore
from corrsfm.workspace.stores import features_of, matches_of, pruned_of

RUN = cfg.RunConfig(threads=1, device="cpu")
SMALL = cfg.FeaturesConfig(max_features=60)


def run_front(
    workspace: Workspace,
    photos: Path,
    features: cfg.FeaturesConfig = SMALL,
    pairs: cfg.PairsConfig | None = None,
    prune: cfg.PruneConfig | None = None,
) -> dict[str, tuple[int, int]]:
    """Run all stages up to pruning; stage → (items, of which were kept)."""
    outcomes = [
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN),
        pipeline.extract_features(workspace, features, RUN),
        pipeline.make_pairs(workspace, pairs or cfg.PairsConfig(), RUN),
        pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN),
        pipeline.prune_matches(workspace, prune or cfg.PruneConfig(method=cfg.PruneMethod.RATIO), RUN),
    ]
    return {outcome.stage: (outcome.num_items, outcome.num_reused) for outcome in outcomes}


def verify(workspace: Workspace, photos: Path) -> None:
    """Run all stages before mapping."""
    run_front(workspace, photos)
    pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN)


def contents(workspace: Workspace) -> dict[str, object]:
    """Everything a workspace holds up to pruning, as comparable values."""
    values: dict[str, object] = {}
    with features_of(workspace).reader() as read:
        for name in read_index(workspace).names:
            item = read(name)
            values[name] = (item.keypoints.tobytes(), item.descriptors.tobytes())
    with matches_of(workspace).reader() as read_matches:
        for pair in read_pairs(workspace).pairs:
            values[f"m {pair}"] = read_matches(pair).indices.tobytes()
    with pruned_of(workspace).reader() as read_pruned:
        for pair in read_pairs(workspace).pairs:
            values[f"p {pair}"] = read_pruned(pair).indices.tobytes()
    return values


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    write_photos(tmp_path / "photos", 4)
    return tmp_path / "photos"


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "scene", create=True)


def test_a_second_run_keeps_everything(workspace: Workspace, photos: Path) -> None:
    assert run_front(workspace, photos)["matches"] == (6, 0)
    before = {path.name: path.stat().st_mtime_ns for path in workspace.root.rglob("*.db")}
    assert len(before) == 3
    again = run_front(workspace, photos)
    assert all(items == kept for stage, (items, kept) in again.items() if stage != "images")
    assert before == {path.name: path.stat().st_mtime_ns for path in workspace.root.rglob("*.db")}


def test_unchanged_photos_are_not_even_opened_again(
    workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_front(workspace, photos)
    opened: list[str] = []
    for original in (files.sha256_of, images.read_photo_info):

        def spy(path: Path, original: Callable = original) -> object:
            opened.append(path.name)
            return original(path)

        monkeypatch.setattr(cache, original.__name__, spy)
    write_photo(photos / "2.png", 85)
    before = read_index(workspace)
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    assert set(opened) == {"2.png"}
    assert [a == b for a, b in zip(before.records, read_index(workspace).records, strict=True)] == [
        True, True, False, True,
    ]  # fmt: skip


def test_a_changed_photo_redoes_its_features_and_its_pairs_only(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    write_photo(photos / "2.png", 85)
    outcome = run_front(workspace, photos)
    assert outcome["features"] == (4, 3)
    assert outcome["matches"] == (6, 3)
    assert outcome["pruned matches"] == (6, 3)


def test_a_new_photo_adds_its_features_and_pairs_only(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    write_photo(photos / "new.png", 20)
    outcome = run_front(workspace, photos)
    assert outcome["features"] == (5, 4)
    assert outcome["matches"] == (10, 6)


def test_a_removed_photo_leaves_no_trace(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    (photos / "1.png").unlink()
    outcome = run_front(workspace, photos)
    assert outcome["features"] == (3, 3)
    assert outcome["matches"] == (3, 3)
    assert not [key for key in contents(workspace) if "1.png" in key]


def test_a_changed_prune_option_redoes_pruning_only(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    outcome = run_front(workspace, photos, prune=cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=0.7))
    assert outcome["features"] == (4, 4)
    assert outcome["matches"] == (6, 6)
    assert outcome["pruned matches"] == (6, 0)


def test_what_was_warned_of_before_the_first_stage_is_in_the_report(tmp_path: Path, photos: Path) -> None:
    config = cfg.PipelineConfig(features=SMALL, prune=cfg.PruneConfig(method=cfg.PruneMethod.RATIO), run=RUN)
    for warned in (["--precision: no effect"], []):
        with contextlib.suppress(ReconstructionError):
            run_scene(photos, tmp_path / "scene", config, warned=warned)
        values = json.loads((tmp_path / "scene" / "report.json").read_text())
        assert [one["message"] for one in values["warnings"] if one["stage"] == "run"] == warned


def test_a_method_that_was_used_before_prunes_nothing_again(workspace: Workspace, photos: Path) -> None:
    methods = [cfg.PruneConfig(method=cfg.PruneMethod(name)) for name in ("ratio", "none", "ratio")]
    kept = [run_front(workspace, photos, prune=method)["pruned matches"] for method in methods]
    assert kept == [(6, 0), (6, 0), (6, 6)]
    verify(workspace, photos)
    after = contents(workspace)
    fresh = Workspace(workspace.root.with_name("fresh"), create=True)
    run_front(fresh, photos)
    assert after == contents(fresh)


def test_damaged_items_are_made_again_alone(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    before = contents(workspace)
    with contextlib.closing(sqlite3.connect(workspace.matches)) as store, store:
        store.execute("UPDATE arrays SET data = zeroblob(length(data)) WHERE number = 2")
    verify = dataclasses.replace(RUN, verify=True)
    assert pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN).skipped
    outcome = pipeline.match_pairs(workspace, cfg.MatchesConfig(), verify)
    assert (outcome.num_items, outcome.num_reused) == (6, 5)
    again = run_front(workspace, photos)
    assert all(items == kept for stage, (items, kept) in again.items() if stage != "images")
    assert contents(workspace) == before


def test_an_option_of_speed_redoes_nothing(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(block_size=17), RUN)
    outcome = run_front(workspace, photos)
    assert outcome["pruned matches"] == (6, 6)


def test_what_changed_is_said(workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture) -> None:
    run_front(workspace, photos)
    write_photo(photos / "2.png", 85)
    with caplog.at_level("INFO", logger="corrsfm"):
        run_front(workspace, photos, features=dataclasses.replace(SMALL, max_features=50))
    assert "photos changed since the last run: 1 (2.png)" in caplog.text
    assert "features: redone where needed (max_features 60 → 50)" in caplog.text


def test_pruning_after_new_features_asks_for_matching_first(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=40), RUN)
    with pytest.raises(WorkspaceError, match="older than features; run: corrsfm"):
        pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), RUN)


def test_a_deleted_file_is_made_again(workspace: Workspace, photos: Path) -> None:
    run_front(workspace, photos)
    before = contents(workspace)
    workspace.matches.unlink()
    assert run_front(workspace, photos)["matches"] == (6, 0)
    assert contents(workspace) == before


@pytest.mark.parametrize("length", [0, 1000, 10_000])
def test_a_truncated_feature_file_is_put_aside_and_made_again(
    workspace: Workspace, photos: Path, length: int, caplog: pytest.LogCaptureFixture
) -> None:
    run_front(workspace, photos)
    before = contents(workspace)
    workspace.features.write_bytes(workspace.features.read_bytes()[:length])
    run_front(workspace, photos)
    assert "features.db: damaged" in caplog.text and "the old file as features.db.damaged" in caplog.text
    workspace.features.with_name("features.db.damaged").unlink()
    assert contents(workspace) == before


def test_an_unreadable_photo_is_named_and_the_others_are_kept(workspace: Workspace, photos: Path) -> None:
    whole = (photos / "2.png").read_bytes()
    (photos / "2.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ImageError, match=r"2\.png"):
        run_front(workspace, photos)
    (photos / "2.png").write_bytes(whole)
    assert run_front(workspace, photos)["features"][0] == 4


class RandomHistory(RuleBasedStateMachine):
    """Whatever happened to a workspace, running it again equals starting afresh."""

    @initialize()
    def start(self) -> None:
        self.root = Path(os.environ["TMPDIR_FOR_HISTORY"]) / f"{random.getrandbits(64):x}"
        self.photos = self.root / "photos"
        write_photos(self.photos, 3)
        self.workspace = Workspace(self.root / "scene", create=True)
        self.features = SMALL
        self.pairs = cfg.PairsConfig()
        self.prune = cfg.PruneConfig(method=cfg.PruneMethod.RATIO)

    @rule(number=st.integers(0, 4), position=st.integers(0, 300))
    def write(self, number: int, position: int) -> None:
        write_photo(self.photos / f"{number}.png", position)

    @rule(number=st.integers(2, 4))
    def remove(self, number: int) -> None:
        (self.photos / f"{number}.png").unlink(missing_ok=True)

    @rule(num=st.sampled_from([40, 60]))
    def change_features(self, num: int) -> None:
        self.features = cfg.FeaturesConfig(max_features=num)

    @rule(overlap=st.integers(1, 3))
    def change_pairs(self, overlap: int) -> None:
        self.pairs = cfg.PairsConfig(pairing=(cfg.PairStrategy.SEQUENTIAL,), sequential_overlap=overlap)

    @rule(ratio=st.sampled_from([0.7, 0.8]))
    def change_pruning(self, ratio: float) -> None:
        self.prune = cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=ratio)

    @rule(name=st.sampled_from(["features.db", "matches.db", "pruned/ratio.db", "pairs.txt", "images.json"]))
    def lose_a_file(self, name: str) -> None:
        (self.workspace.root / name).unlink(missing_ok=True)

    @rule(after=st.integers(0, 12))
    def interrupt(self, after: int) -> None:
        count = 0
        add = ItemStore.add

        def stop(self: ItemStore, *arguments: object) -> None:
            nonlocal count
            if count == after:
                raise KeyboardInterrupt
            count += 1
            add(self, *arguments)

        ItemStore.add = stop  # type: ignore[method-assign]
        try:
            self.run(self.workspace)
        except KeyboardInterrupt:
            pass
        finally:
            ItemStore.add = add  # type: ignore[method-assign]

    def run(self, workspace: Workspace) -> None:
        run_front(workspace, self.photos, self.features, self.pairs, self.prune)

    @invariant()
    def running_again_equals_a_fresh_start(self) -> None:
        if not hasattr(self, "root"):
            return
        copy = self.root / "copy"
        shutil.copytree(self.workspace.root, copy)
        self.run(Workspace(copy))
        fresh = Workspace(self.root / "fresh", create=True)
        self.run(fresh)
        assert contents(Workspace(copy)) == contents(fresh)
        shutil.rmtree(copy)
        shutil.rmtree(fresh.root)

    def teardown(self) -> None:
        if hasattr(self, "root"):
            shutil.rmtree(self.root)


def test_any_history_of_a_workspace_ends_like_a_fresh_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hypothesis.stateful import run_state_machine_as_test

    monkeypatch.setenv("TMPDIR_FOR_HISTORY", str(tmp_path))
    run_state_machine_as_test(
        RandomHistory,
        settings=settings(
            max_examples=6,
            stateful_step_count=5,
            deadline=None,
            derandomize=True,
            suppress_health_check=list(HealthCheck),
        ),
    )


def test_killing_the_process_anywhere_loses_nothing(tmp_path: Path, photos: Path) -> None:
    arguments = ["--max-features", "60", "--threads", "1", "--device", "cpu"]
    command = [sys.executable, "-m", "corrsfm", "extract", str(photos)]
    subprocess.run([*command, str(tmp_path / "straight"), *arguments], check=True, capture_output=True)
    killed = 0
    for milliseconds in (1200, 2400, 3600):
        process = subprocess.Popen(
            [*command, str(tmp_path / "killed"), *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        time.sleep(milliseconds / 1000)
        killed += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
    result = subprocess.run([*command, str(tmp_path / "killed"), *arguments], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert killed
    workspaces = [Workspace(tmp_path / name) for name in ("straight", "killed")]
    for workspace in workspaces:
        pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), RUN)
    assert contents(workspaces[0]) == contents(workspaces[1])
    names = [{path.name for path in workspace.root.iterdir()} for workspace in workspaces]
    assert names[0] == names[1]


def test_same_input_gives_same_bytes(tmp_path: Path, photos: Path) -> None:
    values = []
    for name in ("a", "b"):
        workspace = Workspace(tmp_path / name, create=True)
        run_front(workspace, photos)
        values.append(contents(workspace))
    assert values[0] == values[1]
    assert any(np.frombuffer(value, np.int32).size for key, value in values[0].items() if key[:2] == "p ")  # type: ignore[arg-type]


def test_a_broken_link_is_an_unreadable_photo(workspace: Workspace, photos: Path) -> None:
    (photos / "4.png").symlink_to("nowhere.png")
    with pytest.raises(ImageError, match=r"4\.png: no such file"):
        pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    outcome = pipeline.index_photos(workspace, photos, cfg.ImagesConfig(skip_unreadable=True), RUN)
    assert outcome.num_items == 4


@pytest.mark.parametrize("way", [{}, {"verify": True}, {"overwrite": True}])
def test_damaged_features_are_mended_where_photos_may_be_left_out(tmp_path: Path, way: dict) -> None:
    photos = tmp_path / "photos"
    write_photos(photos, 3)
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(skip_unreadable=True), RUN)
    config = cfg.FeaturesConfig(max_features=60)
    pipeline.extract_features(workspace, config, RUN)
    content = workspace.features.read_bytes()
    workspace.features.write_bytes(content[:4096] + b"\xff" * 4096 + content[8192:])
    run = dataclasses.replace(RUN, verify=way.get("verify", False))
    pipeline.extract_features(workspace, config, run, overwrite=way.get("overwrite", False))
    with features_of(workspace).reader() as read:
        assert [len(read(name)) for name in read_index(workspace).names]


@pytest.mark.parametrize("skip", [False, True])
def test_features_are_of_the_photos_that_were_listed(tmp_path: Path, skip: bool) -> None:
    photos = tmp_path / "photos"
    write_photos(photos, 3)
    workspace = Workspace(tmp_path / "scene", create=True)
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(skip_unreadable=skip), RUN)
    shutil.copy(photos / "0.png", photos / "2.png")
    with pytest.raises(InputError, match=r"2\.png: has changed since the photos were listed\nrun the"):
        pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=60), RUN)
    # The one that has changed is not taken for one that cannot be read.
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(skip_unreadable=skip), RUN)
    outcome = pipeline.extract_features(workspace, cfg.FeaturesConfig(max_features=60), RUN)
    assert (outcome.num_items, outcome.num_reused) == (3, 2)


def test_a_truncated_photo_is_left_out_on_request(
    workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = (photos / "2.png").read_bytes()
    (photos / "2.png").write_bytes(whole[: len(whole) // 2])
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(skip_unreadable=True), RUN)
    assert pipeline.extract_features(workspace, SMALL, RUN).num_items == len(read_index(workspace).names)
    pipeline.make_pairs(workspace, cfg.PairsConfig(), RUN)
    assert read_pairs(workspace).pairs == (("0.png", "1.png"), ("0.png", "3.png"), ("1.png", "3.png"))
    assert "do not connect" not in caplog.text
    (photos.parent / "pairs.txt").write_text("0.png 1.png\n1.png 2.png\n2.png 3.png\n")
    listed = cfg.PairsConfig(pairing=(cfg.PairStrategy.FILE,), pairs_file=photos.parent / "pairs.txt")
    pipeline.make_pairs(workspace, listed, RUN)
    assert read_pairs(workspace).pairs == (("0.png", "1.png"),)
    pipeline.match_pairs(workspace, cfg.MatchesConfig(), RUN)
    pipeline.prune_matches(workspace, cfg.PruneConfig(method=cfg.PruneMethod.RATIO), RUN)
    pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN)
    assert {image.name: str(image.reason) for image in pipeline.report(workspace).missing} == {
        "0.png": "not mapped yet",
        "1.png": "not mapped yet",
        "2.png": "unreadable, left out",
        "3.png": "no pair",
    }


def test_options_that_name_files_hold_from_any_folder_and_files_may_move(
    workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photo(photos.parent / "masks" / "0.png.png", 0)
    (photos.parent / "pairs.txt").write_text("0.png 1.png\n1.png 2.png\n")
    monkeypatch.chdir(photos.parent)
    listed = cfg.PairsConfig(pairing=(cfg.PairStrategy.FILE,), pairs_file=Path("pairs.txt"))
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(mask_dir=Path("masks")), RUN)
    pipeline.extract_features(workspace, SMALL, RUN)
    pipeline.make_pairs(workspace, listed, RUN)
    assert workspace.require("images").config["mask_dir"] == str(photos.parent / "masks")
    assert workspace.require("pairs").config["pairs_file"] == str(photos.parent / "pairs.txt")
    moved = dataclasses.replace(listed, pairs_file=Path("pairs.txt").rename("list.txt"))
    assert pipeline.make_pairs(workspace, moved, RUN).skipped
    Path("list.txt").write_text("0.png 1.png\n")
    assert not pipeline.make_pairs(workspace, moved, RUN).skipped


def test_a_left_out_photo_is_tried_again(
    workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    skipping, strict = cfg.ImagesConfig(skip_unreadable=True), cfg.ImagesConfig()
    pipeline.index_photos(workspace, photos, skipping, RUN)

    def fail_once(path: Path) -> object:
        if path.name == "2.png":
            raise ImageError("2.png: Input/output error")
        return read_image(path)

    read_image = images.read_image
    with monkeypatch.context() as patch:
        patch.setattr(features_stage, "read_image", fail_once)
        assert pipeline.extract_features(workspace, SMALL, RUN).num_reused == 0
        written = workspace.features.stat().st_mtime_ns
        caplog.clear()
        # Still unreadable: said again, but nothing is written again.
        assert pipeline.extract_features(workspace, SMALL, RUN).skipped
        assert "left out: 2.png: Input/output error" in caplog.text
        assert workspace.features.stat().st_mtime_ns == written
        pipeline.index_photos(workspace, photos, strict, RUN)
        with pytest.raises(ImageError, match=r"2\.png: Input/output error"):
            pipeline.extract_features(workspace, SMALL, RUN)
    assert len(features_of(workspace).read("2.png")) == 0
    outcome = pipeline.extract_features(workspace, SMALL, RUN)
    assert (outcome.num_items, outcome.num_reused) == (4, 3)
    assert len(features_of(workspace).read("2.png")) > 10


def test_a_folder_without_most_photos_costs_no_finished_work(
    workspace: Workspace, photos: Path, tmp_path: Path
) -> None:
    run_front(workspace, photos)
    before = contents(workspace)
    other = tmp_path / "other"
    write_photos(other, 2)
    (other / "1.png").rename(other / "new.png")
    with pytest.raises(
        InputError, match=rf"{other}: 3 of the 4 photos of .* are not there \(1.png, 2.png, 3.png\); mount"
    ):
        run_front(workspace, other)
    assert contents(workspace) == before
    assert run_front(workspace, photos)["pruned matches"] == (6, 6)
    pipeline.index_photos(workspace, other, cfg.ImagesConfig(), RUN, overwrite=True)
    assert read_index(workspace).names == ["0.png", "new.png"]


def test_photos_that_a_list_leaves_out_have_not_vanished(
    workspace: Workspace, photos: Path, tmp_path: Path
) -> None:
    write_photo(photos / "4.png", 160)
    pipeline.index_photos(workspace, photos, cfg.ImagesConfig(), RUN)
    (tmp_path / "list.txt").write_text("0.png\n1.png\n")
    config = cfg.ImagesConfig(image_list=tmp_path / "list.txt")
    assert pipeline.index_photos(workspace, photos, config, RUN).num_items == 2


def test_another_version_of_a_library_does_not_mix_with_what_the_old_one_made(
    workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def finish() -> list[bool]:
        return [
            pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN).skipped,
            pipeline.reconstruct(workspace, cfg.ReconstructionConfig(), RUN).skipped,
        ]

    run_front(workspace, photos)
    finish()
    assert finish() == [True, True]
    monkeypatch.setattr(colmap.pycolmap, "__version__", "99.1.0")
    assert run_front(workspace, photos)["features"] == (4, 4)
    assert finish() == [False, False]
    monkeypatch.setattr(features.cv2, "__version__", "99.1.0")
    assert run_front(workspace, photos)["features"] == (4, 0)


@pytest.mark.parametrize(
    ("method", "sizes"), [(cfg.PruneMethod.CORRADAPTOR, [4, 2]), (cfg.PruneMethod.LORANSAC, [6])]
)
def test_a_killed_run_loses_few_pairs_of_a_slow_network(
    workspace: Workspace,
    photos: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: cfg.PruneMethod,
    sizes: list[int],
) -> None:
    seen = []

    class Keep:
        name = fingerprint = "keep"

        def __call__(self, pairs: list[Correspondences]) -> list[PruneResult]:
            seen.append(len(pairs))
            return [
                PruneResult(scores=np.ones(len(pair), np.float32), inlier_mask=np.ones(len(pair), bool))
                for pair in pairs
            ]

    run_front(workspace, photos)
    monkeypatch.setattr("corrsfm.prune.stage.build_pruner", lambda config, **options: Keep())
    run = cfg.RunConfig(threads=2, device="cpu")
    pipeline.prune_matches(workspace, cfg.PruneConfig(method=method), run)
    assert seen == sizes


def test_matches_that_do_not_belong_to_the_features_are_not_pruned(
    workspace: Workspace, photos: Path
) -> None:
    run_front(workspace, photos)
    matches, record = workspace.matches.read_bytes(), workspace.require("matches")
    run_front(workspace, photos, features=cfg.FeaturesConfig(max_features=40))
    now = workspace.require("matches")
    workspace.matches.write_bytes(matches)
    assert record.fingerprint != now.fingerprint
    config = cfg.PruneConfig(method=cfg.PruneMethod.RATIO, max_ratio=0.3)
    with pytest.raises(WorkspaceError, match=r"matches\.db: is not the file that .*; run: corrsfm match"):
        pipeline.prune_matches(workspace, config, RUN)


def test_a_failed_mapping_leaves_no_stale_model_to_take_for_new(tmp_path: Path, photos: Path) -> None:
    workspace = Workspace(tmp_path / "scene", create=True)
    run_front(workspace, photos)
    workspace.finish("models", StageRecord(fingerprint="of earlier matches"))
    (workspace.sparse / "0").mkdir(parents=True)
    workspace.run_json.write_text("of earlier matches")
    # No pair has as many inliers.
    config = cfg.PipelineConfig(
        features=SMALL,
        prune=cfg.PruneConfig(method=cfg.PruneMethod.RATIO),
        database=cfg.DatabaseConfig(min_num_inliers=1000),
        run=RUN,
    )
    with pytest.raises(ReconstructionError, match=rf"\nevery photo and pair: {workspace.report_html}$"):
        run_scene(photos, workspace.root, config)
    assert workspace.report_html.exists()
    assert not workspace.sparse.exists() and not workspace.run_json.exists()
    assert (workspace.root / "sparse.old" / "run.json").read_text() == "of earlier matches"
    assert "mapper could not place it" not in workspace.report_json.read_text()
    assert '"models": []' in workspace.report_json.read_text()
    assert Workspace(workspace.root).record_of("models") is None


def test_the_bar_of_mapping_starts_again_with_the_count(
    workspace: Workspace, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int | str] = []

    class Bar(mapping.tqdm):
        def refresh(self, *arguments: object, **options: object) -> None:
            shown.append(self.n)

        def reset(self, total: float | None = None) -> None:
            shown.append("again")
            self.n = 0

    def map_twice(*_: object, on_progress: Callable[[int], None], **__: object) -> list[object]:
        for num_registered in (2, 3, 4, 2, 3):
            on_progress(num_registered)
        return []

    verify(workspace, photos)
    monkeypatch.setattr(mapping, "tqdm", Bar)
    monkeypatch.setattr(mapping, "map_database", map_twice)
    pipeline.reconstruct(workspace, cfg.ReconstructionConfig(), RUN)
    assert shown[-6:] == [2, 3, 4, "again", 2, 3]


def test_a_truncated_database_is_written_again(
    workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    verify(workspace, photos)
    whole = workspace.database.read_bytes()
    assert pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN).skipped
    workspace.database.write_bytes(whole[: len(whole) // 2])
    for stage in (
        lambda: pipeline.report(workspace),
        lambda: pipeline.reconstruct(workspace, cfg.ReconstructionConfig(), RUN),
    ):
        with pytest.raises(WorkspaceError, match=r"damaged, its end is missing; run: corrsfm prune .* ratio"):
            stage()
    assert not pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN).skipped
    assert "database.db: damaged (its end is missing); it is written again" in caplog.text
    assert len(workspace.database.read_bytes()) == len(whole)
    assert pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN).skipped


def test_a_database_that_lost_rows_is_written_again(
    workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    verify(workspace, photos)
    before = read_keypoint_counts(workspace.database)
    with contextlib.closing(sqlite3.connect(workspace.database)) as connection:
        connection.execute("DELETE FROM keypoints")
        connection.commit()
    assert not pipeline.verify_matches(workspace, cfg.DatabaseConfig(), RUN).skipped
    assert "database.db: damaged (not as it was written); it is written again" in caplog.text
    assert read_keypoint_counts(workspace.database) == before and len(before) == 4


def read_keypoint_counts(database: Path) -> list[tuple[int, int]]:
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return connection.execute("SELECT image_id, rows FROM keypoints ORDER BY image_id").fetchall()


def colours(workspace: Workspace) -> set[tuple[int, ...]]:
    (model,) = read_models(workspace.sparse)
    return {tuple(point.color.tolist()) for point in model.points3D.values()}


@pytest.mark.parametrize("mapper", list(cfg.Mapper))
def test_photos_that_were_moved_cost_the_colours_only(
    mapper: cfg.Mapper, workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    verify(workspace, photos)
    elsewhere = photos.rename(photos.with_name("elsewhere"))
    config = cfg.ReconstructionConfig(mapper=mapper, min_model_size=2)
    assert not pipeline.reconstruct(workspace, config, RUN).skipped
    extract = f"corrsfm extract NEWDIR {workspace.root} --max-features 60"
    assert f"photos are no longer at {photos}; the points stay black; " in caplog.text
    assert extract in caplog.text
    assert colours(workspace) == {(0, 0, 0)}
    assert pipeline.reconstruct(workspace, config, RUN).skipped
    assert pipeline.report(workspace, html=True).models and workspace.report_html.exists()
    verify(workspace, elsewhere)
    assert not pipeline.reconstruct(workspace, config, RUN).skipped
    assert len(colours(workspace)) > 3
    elsewhere.rename(photos)
    assert pipeline.reconstruct(workspace, config, RUN).skipped


def test_a_photo_of_another_size_costs_the_colours_only(
    workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    verify(workspace, photos)
    path = sorted(photos.iterdir())[0]
    before = path.read_bytes()
    assert cv2.imwrite(str(path), np.zeros((9, 9), np.uint8))
    config = cfg.ReconstructionConfig(min_model_size=2)
    assert not pipeline.reconstruct(workspace, config, RUN).skipped
    assert (
        f"the points stay black; {path}: is of another size than it was; run: corrsfm extract" in caplog.text
    )
    assert colours(workspace) == {(0, 0, 0)}
    path.write_bytes(before)
    assert not pipeline.reconstruct(workspace, config, RUN).skipped
    assert len(colours(workspace)) > 3


def test_verified_pairs_in_two_parts_are_told_before_mapping(
    workspace: Workspace, photos: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(3):
        write_photo(photos / f"other{number}.png", 40 * number, seed=1)
    verify(workspace, photos)
    pipeline.reconstruct(workspace, cfg.ReconstructionConfig(), RUN)
    assert (
        "verified pairs fall into 2 components of 4, 3 photos: each becomes a separate model" in caplog.text
    )
    assert "not connected to the largest: other0.png, other1.png, other2.png" in caplog.text
