"""Every network learns one batch by heart with its published loss, and the losses are what the papers say."""

import math

import pytest
import torch
from labelled_scene import make_scene

from corrsfm.config import MatchInput, NetworkUsage
from corrsfm.errors import ConfigError
from corrsfm.model import load_network
from corrsfm.model.rivals import ARCHITECTURES
from corrsfm.training.config import AugmentConfig, TrainConfig, TrainRecipe, load_recipe
from corrsfm.training.dataset import RealPairs, generator_for
from corrsfm.training.initial import initial_network, network_config
from corrsfm.training.loop import Trainer
from corrsfm.training.losses import balanced_classification_loss, matrix_loss

CPU = torch.device("cpu")
CLUSTERED = {"oanet", "lmcnet", "ms2dgnet", "pgfnet", "ncmnet", "mgnet"}


def small(architecture: str) -> dict:
    clusters = {"clusters": 4} if architecture in CLUSTERED else {}
    return {"architecture": architecture, "channels": 32, **clusters, "side_channels": 5}


@pytest.fixture(scope="module")
def data() -> RealPairs:
    return RealPairs([make_scene("a"), make_scene("b", seed=1)], CPU)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_a_rival_overfits_one_batch(architecture, data, tmp_path):
    recipe = TrainRecipe(
        train=TrainConfig(output=tmp_path, learning_rate=1e-2, ema_decay=0.0, essential_start=0.3),
        network=small(architecture),
    )
    trainer = Trainer(recipe, data, CPU)
    batch = data.sample(2, 48, AugmentConfig(), generator_for(0, 0, 0, CPU))
    trainer.draw = lambda step: batch  # type: ignore[method-assign]
    losses = [trainer.train_step(0.25)["loss"] for _ in range(60)]
    assert trainer.num_skipped == 0
    assert min(losses[-10:]) < 0.6 * losses[0]
    # With the term of the matrix: its gradient reaches the weights and stays finite.
    later = trainer.train_step(0.9)
    assert {"classification", "essential"} <= later.keys() and math.isfinite(later["gradient"])
    trainer.save()
    assert load_network(tmp_path / "latest.pt", architecture).config.channels == 32


def test_inliers_and_outliers_of_a_pair_weigh_the_same():
    logits = torch.tensor([[2.0, -1.0, 0.5, 9.0]])
    distances = torch.tensor([[1e-5, 1.0, 2.0, 0.0]])
    mask = torch.tensor([[True, True, True, False]])
    expected = 0.5 * math.log1p(math.exp(-2.0))
    expected += 0.25 * (math.log1p(math.exp(-1.0)) + math.log1p(math.exp(0.5)))
    loss = balanced_classification_loss([logits, logits], [distances, distances], [mask, mask])
    assert float(loss) == pytest.approx(2 * expected, rel=1e-6)
    # A pair without inliers has but the other half.
    alone = balanced_classification_loss([logits[:, 1:3]], [distances[:, 1:3]])
    assert float(alone) == pytest.approx(expected - 0.5 * math.log1p(math.exp(-2.0)), rel=1e-6)


def test_matrices_are_compared_without_scale_and_sign():
    matrix = torch.arange(1.0, 10.0).view(1, 3, 3)
    assert float(matrix_loss(-3 * matrix, matrix)) == pytest.approx(0.0, abs=1e-12)
    first, second = torch.zeros(1, 3, 3), torch.zeros(1, 3, 3)
    first[0, 0, 0] = second[0, 1, 1] = 1.0
    assert float(matrix_loss(first, second)) == pytest.approx(2.0)


@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_each_rival_has_a_recipe_that_builds_it(architecture, request):
    recipe = load_recipe(request.config.rootpath / "pipelines" / f"train_{architecture}.toml")
    network = initial_network(recipe)
    assert network_config(recipe).architecture == architecture == network.config.architecture
    assert network.usage.input is MatchInput.ALL and recipe.train.max_minutes >= 30


def test_a_run_says_what_a_rival_reads(tmp_path):
    recipe = TrainRecipe(train=TrainConfig(input=MatchInput.MUTUAL), network=small("lmcnet"))
    assert initial_network(recipe).usage == NetworkUsage(input=MatchInput.MUTUAL, pose_min_score=0.95)
    with pytest.raises(ConfigError, match="channels is 31, expected a positive multiple of 32"):
        network_config(TrainRecipe(network={"architecture": "convmatch", "channels": 31}))
    with pytest.raises(ConfigError, match="architecture is 'superglue', expected one of pointcn"):
        network_config(TrainRecipe(network={"architecture": "superglue"}))
