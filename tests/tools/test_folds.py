import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scene_of_points

from tools import folds


def test_a_seed_that_was_unfolded_is_mapped_again_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def call(*words: object) -> bool:
        command = [str(word) for word in words]
        commands.append(command)
        workspace = Path(command[4])
        if command[3] == "reconstruct":
            unfold = "--no-unfold" not in command
            chosen = {"name": "unfolded-votes" if unfold else "first", "chosen": True}
            found = {"folded": not unfold, "num_near_pairs": 30, "left_out": [["a", "b"]] if unfold else []}
            evidence = {"models_tried": [{"name": "first", "chosen": False}, chosen], "folds": found}
            (workspace / "evidence.json").write_text(json.dumps(evidence))
        return True

    def measure(model: Path, scene: Path, seed: int) -> dict[str, Any]:
        return {"seed": seed, "auc5": 90.0 if "--no-unfold" not in commands[-1] else 40.0}

    monkeypatch.setattr(folds, "call", call)
    monkeypatch.setattr(folds, "measure", measure)
    monkeypatch.setattr(folds, "read_poses", lambda folder: {})
    monkeypatch.setattr(folds, "count_in_place", lambda *poses: 7)
    (tmp_path / "pruned").mkdir()
    row = folds.run_seed(tmp_path, tmp_path / "pruned", 3)
    assert row["unfolded_by"] == "unfolded-votes"
    assert (row["auc5"], row["without"]["auc5"], row["without"]["folded"]) == (90.0, 40.0, True)
    assert (row["still_folded"], row["num_left_out"], row["num_in_place"]) == (False, 1, 7)
    assert [command[3] for command in commands] == ["prune", "reconstruct"] * 2
    assert all(command[-4:] == ["--seed", "3", "--threads", "1"] for command in commands)


def test_photos_in_place_are_those_that_one_similarity_brings_there() -> None:
    turn = scene_of_points.turn("y", 120.0)
    truth, poses = {}, {}
    for number, centre in enumerate(np.random.default_rng(0).normal(size=(9, 3))):
        rotation = scene_of_points.turn("x", 10.0 * number)
        truth[str(number)] = rotation, -rotation @ centre
        # In a frame of its own, three times as large; the last three are turned away, or stand elsewhere.
        own = scene_of_points.turn("z", 40.0) @ turn if number == 6 else turn
        place = 3.0 * turn.T @ centre + (2.0 if number > 6 else 0.0)
        poses[str(number)] = rotation @ own, -rotation @ own @ place
    assert folds.count_in_place(poses, truth) == 6
    assert folds.count_in_place(truth, truth) == 9
    assert folds.count_in_place({}, truth) == 0
