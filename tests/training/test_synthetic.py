"""Synthetic pairs: exact truth, the asked-for difficulty, side information like that of real pairs."""

import numpy as np
import pytest
import torch

from corrsfm.geometry import symmetric_epipolar_distance_sq
from corrsfm.training.config import SyntheticConfig
from corrsfm.training.dataset import Batch
from corrsfm.training.statistics import MEASURED, measure
from corrsfm.training.synthetic import SyntheticPairs

CPU = torch.device("cpu")


def draw(num_pairs=64, num_matches=400, seed=0, **options) -> Batch:
    source = SyntheticPairs(SyntheticConfig(**options), CPU)
    return source.sample(num_pairs, num_matches, torch.Generator().manual_seed(seed))


def rounding_of_distances(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far rounding to float32 may move symmetric epipolar distances (not squared), (M,).

    x1ᵀ E x0 sums nine products that pass at most six roundings each; the distance divides it by the lengths
    of the lines, and the rest of its computation rounds it fewer than twenty times.
    """
    x0, x1 = (np.column_stack([points[:, c : c + 2], np.ones(len(points))]) for c in (0, 2))
    total = np.einsum("ni,ij,nj->n", np.abs(x1), np.abs(matrix), np.abs(x0))
    lengths0, lengths1 = (np.linalg.norm(lines[:, :2], axis=1) for lines in (x1 @ matrix, x0 @ matrix.T))
    distances = np.sqrt(symmetric_epipolar_distance_sq(matrix, points))
    return 2.0**-24 * (6 * total * np.hypot(1 / lengths0, 1 / lengths1) + 20 * distances)


def test_ground_truth_is_exact_without_noise():
    batch = draw(noise_px=0.0, min_inlier_ratio=0.5, max_inlier_ratio=0.9)
    exact = num_undecided = 0
    for pair, in_float32 in enumerate(batch.distances().double().sqrt().numpy()):
        matrix, points = (x[pair].double().numpy() for x in (batch.matrix, batch.true_correspondences))
        squared = symmetric_epipolar_distance_sq(matrix, points)
        exact += int((squared < 1e-9).sum())
        # The distances on the device, in float32, agree with the float64 reference, and so do the labels.
        distances, rounding = np.sqrt(squared), rounding_of_distances(matrix, points)
        assert (np.abs(in_float32 - distances) <= rounding)[batch.mask[pair].numpy()].all()
        undecided = np.abs(distances - 1e-2) <= rounding
        num_undecided += int(undecided.sum())
        np.testing.assert_array_equal((distances < 1e-2)[~undecided], (in_float32 < 1e-2)[~undecided])
    # Some pairs have fewer visible points than asked for.
    assert exact > 0.3 * batch.mask.sum()
    assert num_undecided < 0.001 * batch.mask.sum()


def test_matrix_is_an_essential_matrix():
    singular = torch.linalg.svdvals(draw().matrix.double())
    torch.testing.assert_close(
        singular, torch.tensor([1.0, 1.0, 0.0]).double().expand(64, 3), atol=1e-5, rtol=0
    )


def test_noise_moves_right_matches_by_about_as_much_as_asked():
    batch = draw(noise_px=1.0, min_inlier_ratio=0.6, max_inlier_ratio=0.9)
    distances = batch.distances()
    near = distances[distances < 1e-4].sqrt()
    # A millirad in each of the four coordinates.
    assert 3e-4 < float(near.median()) < 3e-3


def test_inlier_ratios_cover_the_range():
    batch = draw(num_pairs=400, num_matches=300)
    share = (batch.distances() < 1e-5).float().mean(1)
    assert float(share.quantile(0.1)) < 0.08
    assert float(share.quantile(0.95)) > 0.4


def test_batch_depends_on_the_generator_only():
    first, again, other = draw(seed=5), draw(seed=5), draw(seed=6)
    torch.testing.assert_close(first.correspondences, again.correspondences, rtol=0, atol=0)
    assert not torch.equal(first.correspondences, other.correspondences)


def test_everything_is_finite_and_in_a_photo():
    batch = draw(num_pairs=200)
    for name in ("correspondences", "matrix", "ratios", "mutual", "log_scale_ratios", "rotations"):
        assert torch.isfinite(getattr(batch, name)).all(), name
    assert float(batch.correspondences.abs().max()) < 1.0
    assert float(batch.ratios.min()) >= 0 and float(batch.ratios.max()) <= 1


def test_side_information_has_the_measured_distribution():
    found = measure([draw(num_pairs=200, num_matches=500)])
    # Chance inliers among the wrong matches blur the difference a little.
    assert float((found.mutual - MEASURED.mutual).abs().max()) < 0.15
    assert float((found.ratio[..., 4] - MEASURED.ratio[..., 4]).abs().mean()) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_right_matches_agree_in_scale_and_rotation(seed):
    batch = draw(seed=seed, min_inlier_ratio=0.5, max_inlier_ratio=0.9)
    right = batch.distances() < 1e-5
    spread = batch.rotations.masked_fill(~right, torch.nan)
    deviation = (spread - spread.nanmedian(1, keepdim=True).values).abs()
    assert float(deviation.nanmedian()) < 0.2
