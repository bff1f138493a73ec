import json
from pathlib import Path
from typing import Any

import pytest

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
    (tmp_path / "pruned").mkdir()
    row = folds.run_seed(tmp_path, tmp_path / "pruned", 3)
    assert row["unfolded_by"] == "unfolded-votes"
    assert (row["auc5"], row["without"]["auc5"], row["without"]["folded"]) == (90.0, 40.0, True)
    assert (row["still_folded"], row["num_left_out"]) == (False, 1)
    assert [command[3] for command in commands] == ["prune", "reconstruct"] * 2
    assert all(command[-4:] == ["--seed", "3", "--threads", "1"] for command in commands)
