"""The training loop: learns one batch by heart, resumes exactly, survives what is not finite."""

import dataclasses
import itertools
import json
import math
from types import SimpleNamespace

import pytest
import torch
from labelled_scene import make_scene

from corrsfm.config import MatchInput
from corrsfm.errors import CheckpointError, ConfigError, WorkspaceError
from corrsfm.labelled.compact import write_scenes
from corrsfm.model import build_network, load_network, read_provenance, save_network
from corrsfm.prune.correspondences import NEUTRAL_CHANNELS
from corrsfm.training import loop
from corrsfm.training.checkpoint import load_state, without_side_channels
from corrsfm.training.config import AugmentConfig, Schedule, TrainConfig, TrainRecipe
from corrsfm.training.dataset import RealPairs, generator_for
from corrsfm.training.initial import network_config
from corrsfm.training.loop import Trainer, train
from corrsfm.training.schedule import learning_rate_factor
from corrsfm.workspace.lease import hold

CPU = torch.device("cpu")
TINY = {
    "channels": 8, "clusters": 4, "heads": 2, "mlp_ratio": 1, "oa_filters": 1, "motion_stacking": 1,
    "fusion_rounds": 1, "neighbors": [3, 3], "side_channels": 5,
}  # fmt: skip


def make_recipe(folder, **options) -> TrainRecipe:
    values = {"batch_size": 4, "num_matches": 48, "max_steps": 6, "essential_start": 0.3, "log_every": 1}
    return TrainRecipe(train=TrainConfig(output=folder, **{**values, **options}), network=TINY)


@pytest.fixture(scope="module")
def data() -> RealPairs:
    return RealPairs([make_scene("a"), make_scene("b", seed=1)], CPU)


def test_overfits_one_batch(data, tmp_path):
    recipe = make_recipe(tmp_path, learning_rate=1e-2, ema_decay=0.0)
    trainer = Trainer(recipe, data, CPU)
    batch = data.sample(4, 48, AugmentConfig(), generator_for(0, 0, 0, CPU))
    trainer.draw = lambda step: batch  # type: ignore[method-assign]
    losses = [trainer.train_step(0.25)["loss"] for _ in range(100)]
    # Each step doubles what rounding began, so a single late loss is a draw: processors differ by a factor of
    # two in it. The best of ten is below a quarter in all orders of summation that were tried.
    assert min(losses[-10:]) < 0.45 * losses[0]


def test_overfits_one_batch_of_mutual_matches(tmp_path):
    scenes = [make_scene("a", num_keypoints=160), make_scene("b", num_keypoints=160, seed=1)]
    data = RealPairs(scenes, CPU, match_input=MatchInput.MUTUAL)
    recipe = make_recipe(tmp_path, learning_rate=1e-2, ema_decay=0.0, input=MatchInput.MUTUAL)
    trainer = Trainer(recipe, data, CPU)
    batch = data.sample(4, 48, AugmentConfig(), generator_for(0, 0, 0, CPU))
    assert batch.mutual[batch.mask].all()
    trainer.draw = lambda step: batch  # type: ignore[method-assign]
    losses = [trainer.train_step(0.25)["loss"] for _ in range(100)]
    assert min(losses[-10:]) < 0.45 * losses[0]
    trainer.save()
    assert load_network(tmp_path / "latest.pt").usage.input is MatchInput.MUTUAL
    with pytest.raises(ConfigError, match="began with input mutual, not all"):
        Trainer(make_recipe(tmp_path), data, CPU).load()


def test_a_batch_of_photos_of_two_places_only_has_a_finite_loss(data, tmp_path):
    trainer = Trainer(make_recipe(tmp_path, essential_start=0.0), data, CPU)
    batch = trainer.draw(0)
    for related in ([False] * 4, [True, False, False, True]):
        mixed = dataclasses.replace(batch, related=torch.tensor(related))
        trainer.draw = lambda step, mixed=mixed: mixed  # type: ignore[method-assign]
        losses = trainer.train_step(0.9)
        assert math.isfinite(losses["loss"]) and math.isfinite(losses["gradient"])
        assert ("essential" in losses) == any(related)
    assert trainer.num_skipped == 0


def test_synthetic_pairs_are_not_for_a_network_of_mutual_matches(tmp_path):
    recipe = make_recipe(tmp_path, input=MatchInput.MUTUAL, synthetic_share=0.5)
    with pytest.raises(ConfigError, match="synthetic_share to 0"):
        train(recipe, device=CPU)


def test_stop_and_resume_equals_a_straight_run_bitwise(data, tmp_path):
    straight = Trainer(make_recipe(tmp_path / "straight"), data, CPU)
    straight.run()
    stopped = Trainer(make_recipe(tmp_path / "stopped"), data, CPU)
    for _ in range(3):
        stopped.train_step(stopped.progress)
    stopped.save()
    torch.manual_seed(99)
    resumed = Trainer(make_recipe(tmp_path / "stopped"), data, CPU)
    resumed.load()
    assert resumed.step == 3
    resumed.run()
    for name in ("network", "average", "optimiser", "random"):
        first, second = (
            load_state(tmp_path / run / "state.pt", CPU)[name] for run in ("straight", "stopped")
        )
        assert_equal(first, second, name)


def assert_equal(first, second, where):
    if isinstance(first, torch.Tensor):
        assert torch.equal(first, second), where
    elif isinstance(first, dict):
        assert first.keys() == second.keys(), where
        for key in first:
            assert_equal(first[key], second[key], f"{where}.{key}")
    elif isinstance(first, list):
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            assert_equal(a, b, f"{where}[{index}]")
    else:
        assert first == second, where


def test_run_from_files_writes_a_network_that_says_where_it_comes_from(tmp_path):
    write_scenes(tmp_path / "train.h5", [make_scene("a")])
    recipe = make_recipe(tmp_path / "run", max_steps=2, train_files=(tmp_path / "train.h5",))
    rows = []
    path = train(recipe, device=CPU, on_log=rows.append)
    assert load_network(path).config.channels == 8
    provenance = read_provenance(path)
    assert provenance["scenes"] == ["a"] and provenance["steps"] == 2 and provenance["seed"] == 0
    assert [row["step"] for row in rows] == [1, 2]
    assert (tmp_path / "run" / "log.csv").read_text().count("\n") == 3
    with pytest.raises(ConfigError, match="holds a run already; try --resume"):
        train(recipe, device=CPU)
    assert train(recipe, device=CPU, resume=True) == path
    (tmp_path / "run" / "state.pt").unlink()
    with pytest.raises(ConfigError, match=r"latest\.pt: weights of a run whose state\.pt is gone"):
        train(recipe, device=CPU, resume=True)
    assert read_provenance(path) == provenance


def test_a_run_that_goes_on_with_another_recipe_says_so_and_records_it(data, tmp_path, caplog):
    Trainer(make_recipe(tmp_path / "run", max_steps=2), data, CPU).run()
    again = Trainer(make_recipe(tmp_path / "run", max_steps=2, log_every=3), data, CPU)
    again.load()
    assert not caplog.messages and not again.changes
    other = Trainer(make_recipe(tmp_path / "run", max_steps=3, learning_rate=0.5), data, CPU)
    other.load()
    assert "goes on with another recipe from step 2" in caplog.text and "→ 0.5" in caplog.text
    other.run()
    (change,) = json.loads((tmp_path / "run" / "recipe.json").read_text())["changes"]
    assert change["before_step"] == 2 and change["options"]["train.max_steps"] == 2
    assert read_provenance(tmp_path / "run" / "latest.pt")["changes"] == [change]


@pytest.mark.parametrize(
    ("name", "value"),
    [("step", -5), ("step", "x"), ("minutes", math.nan), ("average", {}), ("network", None)],
)
def test_a_state_that_no_run_leaves_is_damaged(data, tmp_path, name, value):
    Trainer(make_recipe(tmp_path, max_steps=1), data, CPU).run()
    state = torch.load(tmp_path / "state.pt", weights_only=True)
    if name == "network":
        value = {key: tensor * torch.nan for key, tensor in state["network"].items()}
    torch.save({**state, name: value}, tmp_path / "state.pt")
    with pytest.raises(CheckpointError, match=r"state\.pt: damaged, or not the state.*--initial"):
        Trainer(make_recipe(tmp_path, max_steps=2), data, CPU).load()


def test_steps_that_are_not_finite_are_counted_and_change_nothing(data, tmp_path):
    trainer = Trainer(make_recipe(tmp_path), data, CPU)
    before = {name: value.clone() for name, value in trainer.network.named_parameters()}
    draw = trainer.draw

    def broken(step):
        batch = draw(step)
        return dataclasses.replace(batch, matrix=batch.matrix * torch.nan)

    trainer.draw = broken  # type: ignore[method-assign]
    assert trainer.train_step(0.9) == {}
    assert trainer.num_skipped == 1 and trainer.step == 1
    for name, value in trainer.network.named_parameters():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize(("processor_time", "clock"), [(False, "monotonic"), (True, "process_time")])
def test_a_run_bounded_by_time_ends_at_learning_rate_zero(data, tmp_path, monkeypatch, processor_time, clock):
    # A clock of the test's, so that a busy machine cannot end the run after one step: 0.2 s a step.
    ticks = itertools.count()
    still = {"monotonic": lambda: 0.0, "process_time": lambda: 0.0}
    moving = {clock: lambda: 0.2 * next(ticks)}
    monkeypatch.setattr(loop, "time", SimpleNamespace(**{**still, **moving}))
    rows = []
    recipe = make_recipe(tmp_path, max_minutes=0.03, processor_time=processor_time)
    Trainer(recipe, data, CPU, on_log=rows.append).run()
    assert rows[-2]["minutes"] <= 0.03 <= rows[-1]["minutes"]
    assert rows[-1]["learning_rate"] < rows[len(rows) // 2]["learning_rate"]


@pytest.mark.parametrize("schedule", list(Schedule))
def test_schedules_rise_to_one_and_fall_to_zero(schedule):
    assert learning_rate_factor(0.1, 0.1, schedule) == pytest.approx(1.0)
    assert learning_rate_factor(1.0, 0.1, schedule) == pytest.approx(0.0, abs=1e-12)
    assert learning_rate_factor(0.55, 0.1, schedule) == pytest.approx(0.5)
    assert learning_rate_factor(0.0, 0.1, schedule) == pytest.approx(
        0.04 if schedule is Schedule.ONE_CYCLE else 0.0
    )
    assert math.isfinite(learning_rate_factor(0.0, 0.0, schedule))


def test_a_run_starts_from_the_weights_of_a_checkpoint(data, tmp_path):
    first = Trainer(make_recipe(tmp_path / "first"), data, CPU)
    save_network(first.network, tmp_path / "first.pt")
    recipe = make_recipe(tmp_path / "second", initial=str(tmp_path / "first.pt"), seed=7)
    for network in (recipe.network, {}):
        trainer = Trainer(dataclasses.replace(recipe, network=network), data, CPU)
        assert_equal(dict(trainer.network.state_dict()), dict(first.network.state_dict()), "network")
        assert trainer.step == 0
    trainer.save()
    assert read_provenance(tmp_path / "second" / "latest.pt")["recipe"]["train"]["initial"] == "first.pt"
    with pytest.raises(ConfigError, match=r"initial checkpoint .*first\.pt"):
        Trainer(dataclasses.replace(recipe, network={**TINY, "channels": 12}), data, CPU)


def test_a_network_that_pruning_could_not_feed_is_refused():
    with pytest.raises(ConfigError, match=r"side_channels is 3, expected one of \[0, 2, 5\]"):
        network_config(TrainRecipe(network={**TINY, "side_channels": 3}))


@pytest.mark.parametrize(("before", "left"), [(5, 2), (5, 0), (2, 0)])
def test_a_network_goes_on_without_its_last_side_channels(before, left):
    network = build_network(network_config(TrainRecipe(network={**TINY, "side_channels": before})))
    narrow = without_side_channels(network, left, NEUTRAL_CHANNELS)
    assert narrow.config.side_channels == left


def test_resuming_another_network_is_refused(data, tmp_path):
    Trainer(make_recipe(tmp_path), data, CPU).save()
    other = dataclasses.replace(make_recipe(tmp_path), network={**TINY, "channels": 12})
    with pytest.raises(ConfigError, match="another network"):
        Trainer(other, data, CPU).load()


@pytest.mark.parametrize("content", [b"", b"hello world", b"PK\x03\x04", None])
def test_a_state_of_another_kind_is_refused(tmp_path, content):
    path = tmp_path / "state.pt"
    torch.save({"format": "other"}, path) if content is None else path.write_bytes(content)
    with pytest.raises(CheckpointError, match=f"not the state of .*: --initial {tmp_path}/latest.pt"):
        load_state(path, CPU)


@pytest.mark.parametrize("name", ["network", "optimiser", "random", "step"])
def test_of_a_run_whose_state_is_damaged_another_begins_with_its_weights(tmp_path, name):
    write_scenes(tmp_path / "train.h5", [make_scene("a")])
    recipe = make_recipe(tmp_path / "run", max_steps=2, train_files=(tmp_path / "train.h5",))
    train(recipe, device=CPU)
    path = tmp_path / "run" / "state.pt"
    state = load_state(path, CPU)
    if name == "network":
        state[name] = {f"{key}?": value for key, value in state[name].items()}
    else:
        del state[name]
    torch.save(state, path)
    latest = path.with_name("latest.pt")
    with pytest.raises(CheckpointError, match=f"damaged.*another --output.*: --initial {latest}"):
        train(recipe, device=CPU, resume=True)
    train(make_recipe(tmp_path / "other", max_steps=2, train_files=recipe.train.train_files,
                      initial=str(latest)), device=CPU)  # fmt: skip


def test_the_folder_of_a_run_is_for_one_run_alone(tmp_path):
    write_scenes(tmp_path / "train.h5", [make_scene("a")])
    recipe = make_recipe(tmp_path / "run", max_steps=2, train_files=(tmp_path / "train.h5",))
    (tmp_path / "run").mkdir()
    with hold(tmp_path / "run" / ".lock"), pytest.raises(WorkspaceError, match="another corrsfm works in"):
        train(recipe, device=CPU)
    (tmp_path / "run" / "latest.pt").write_text("mine")
    with pytest.raises(ConfigError, match=r"latest\.pt: is of no run in this folder; move it away"):
        train(recipe, device=CPU)
    assert (tmp_path / "run" / "latest.pt").read_text() == "mine"
