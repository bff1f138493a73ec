"""The training loss equals the published one, and virtual points equal OpenCV's."""

import cv2
import numpy as np
import pytest
import torch

from corrsfm.geometry import essential_from_pose
from corrsfm.model.network import symmetric_epipolar_squared
from corrsfm.training.losses import classification_loss, essential_loss, virtual_points


@pytest.fixture(scope="module")
def published(shared_dir):
    with np.load(shared_dir / "parity" / "published_loss.npz") as file:
        return {name: torch.from_numpy(np.asarray(file[name], np.float64)) for name in file.files}


def test_classification_loss_equals_the_published_one(published):
    loss = classification_loss(
        [published[f"logits_{step}"] for step in range(5)],
        [published[f"residuals_{step}"] for step in range(5)],
    )
    assert float(loss) == pytest.approx(float(published["classification_loss"]), rel=1e-12)


def test_essential_and_total_losses_equal_the_published_ones(published):
    loss = essential_loss(published["essential"].view(-1, 3, 3), published["virtual_points"])
    assert float(loss) == pytest.approx(float(published["essential_loss"]), rel=1e-12)
    total = published["classification_loss"] + 0.5 * loss
    assert float(total) == pytest.approx(float(published["total_loss"]), rel=1e-12)
    assert float(published["classification_loss"]) == pytest.approx(
        float(published["total_loss_before_ramp"])
    )


def test_virtual_points_equal_the_published_ones(published):
    essential = np.stack(
        [
            essential_from_pose(r, t)
            for r, t in zip(published["R"].numpy(), published["t"].numpy(), strict=True)
        ]
    )
    found = virtual_points(torch.from_numpy(essential)).numpy()
    difference = np.abs(found - published["virtual_points"].numpy()).max(axis=2)
    # Close to an epipole the cost has several local minima.
    assert np.mean(difference < 1e-5) > 0.95


def test_virtual_points_equal_opencvs_for_random_poses():
    rng = np.random.default_rng(3)
    steps = np.arange(20) * 0.1 - 1
    grid = np.stack(np.meshgrid(steps, steps), -1).reshape(1, -1, 2)
    share_close = []
    for _ in range(20):
        rotation = cv2.Rodrigues(rng.normal(size=3) * 0.3)[0]
        essential = essential_from_pose(rotation, rng.normal(size=3))
        expected = np.concatenate(cv2.correctMatches(essential, grid, grid), axis=2)[0]
        batch = torch.from_numpy(essential)[None]
        found = virtual_points(batch)
        share_close.append(np.mean(np.abs(found[0].numpy() - expected).max(axis=1) < 1e-3))
        assert float((symmetric_epipolar_squared(found, batch) < 1e-9).double().mean()) > 0.97
    assert np.mean(share_close) > 0.95


def test_padding_does_not_count():
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(2, 30, generator=generator)
    distances = torch.rand(2, 30, generator=generator) * 2e-4
    padded = torch.cat([logits, torch.full((2, 7), -torch.inf)], 1)
    far = torch.cat([distances, torch.full((2, 7), 1.0)], 1)
    mask = torch.arange(37).expand(2, -1) < 30
    torch.testing.assert_close(
        classification_loss([padded], [far], [mask]), classification_loss([logits], [distances])
    )


def test_loss_without_right_matches_is_finite():
    logits = torch.randn(1, 16, generator=torch.Generator().manual_seed(1), requires_grad=True)
    loss = classification_loss([logits], [torch.ones(1, 16)])
    loss.backward()
    assert torch.isfinite(loss) and torch.isfinite(logits.grad).all()
