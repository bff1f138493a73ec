"""Batches: augmentation keeps the truth true and the side information consistent."""

import dataclasses

import numpy as np
import pytest
import torch
from labelled_scene import make_scene

from corrsfm.config import MatchInput
from corrsfm.errors import InputError
from corrsfm.prune import correspondences
from corrsfm.training.config import NO_AUGMENTATION, AugmentConfig
from corrsfm.training.dataset import RealPairs, augment, generator_for, side_information

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def data() -> RealPairs:
    return RealPairs([make_scene("a"), make_scene("b", seed=1)], CPU)


def test_labels_agree_with_the_compact_file(data):
    scene = make_scene("a")
    expected = [(scene.pair(index).label_distances < 1e-4).mean() for index in range(6)]
    np.testing.assert_allclose(data.inlier_ratios[:6].numpy(), expected, atol=0.02)


@pytest.mark.parametrize(
    "changed",
    ["swap_probability", "mirror_probability", "quarter_turn_probability", "turn_probability",
     "undistort_probability", "jitter_probability", "unknown_focal_probability"],
)  # fmt: skip
def test_augmentation_keeps_labels(data, changed):
    generator = generator_for(0, 0, 0, CPU)
    batch = data.sample(8, 40, NO_AUGMENTATION, generator)
    config = dataclasses.replace(NO_AUGMENTATION, **{changed: 1.0})
    changed_batch = augment(batch, torch.full((8, 2), 0.8), config, generator_for(1, 0, 0, CPU))
    right = batch.distances() < 1e-6
    assert right.float().mean() > 0.3
    assert float(changed_batch.distances()[right].max()) < 1e-5
    if changed != "undistort_probability":
        assert not torch.allclose(changed_batch.true_correspondences, batch.true_correspondences)


def test_swap_exchanges_points_and_inverts_side_information(data):
    batch = data.sample(4, 40, NO_AUGMENTATION, generator_for(0, 0, 0, CPU))
    swapped = augment(
        batch,
        torch.ones(4, 2),
        dataclasses.replace(NO_AUGMENTATION, swap_probability=1.0),
        generator_for(1, 0, 0, CPU),
    )
    torch.testing.assert_close(swapped.correspondences, batch.correspondences[..., [2, 3, 0, 1]])
    torch.testing.assert_close(swapped.log_scale_ratios, -batch.log_scale_ratios)
    torch.testing.assert_close(swapped.rotations, -batch.rotations)
    torch.testing.assert_close(swapped.matrix, batch.matrix.transpose(1, 2))


def test_turning_one_photo_turns_its_keypoints(data):
    batch = data.sample(4, 40, NO_AUGMENTATION, generator_for(0, 0, 0, CPU))
    config = dataclasses.replace(NO_AUGMENTATION, turn_probability=1.0, max_turn_deg=20.0)
    turned = augment(batch, torch.ones(4, 2), config, generator_for(1, 0, 0, CPU))

    def angle(before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        cosine = (before * after).sum(-1)
        sine = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
        return torch.atan2(sine, cosine)

    turns = [
        angle(batch.correspondences[..., c : c + 2], turned.correspondences[..., c : c + 2]) for c in (0, 2)
    ]
    torch.testing.assert_close(turned.rotations - batch.rotations, turns[1] - turns[0], atol=1e-4, rtol=0)


def test_thinning_lowers_the_share_of_right_matches(data):
    config = dataclasses.replace(NO_AUGMENTATION, thin_probability=1.0)
    plain, thinned = (
        torch.stack(
            [
                (data.sample(16, 30, c, generator_for(0, s, 0, CPU)).distances() < 1e-6).float().mean()
                for s in range(8)
            ]
        ).mean()
        for c in (NO_AUGMENTATION, config)
    )
    assert float(thinned) < 0.8 * float(plain)


def test_thinning_loses_right_matches_of_pairs_that_are_drawn_whole(data):
    config = dataclasses.replace(NO_AUGMENTATION, thin_probability=1.0)
    whole, thinned = (data.sample(64, 100, c, generator_for(0, 0, 0, CPU)) for c in (NO_AUGMENTATION, config))
    assert (whole.mask.sum(1) >= 59).all()
    assert float(thinned.inliers().sum()) < 0.8 * float(whole.inliers().sum())
    assert int((thinned.mask & ~thinned.inliers()).sum()) == int((whole.mask & ~whole.inliers()).sum())
    assert (thinned.mask.sum(1) >= 20).all()


def test_two_photos_from_one_place_are_not_trained_on():
    scene = make_scene("a")
    first, second = scene.pairs[0]
    translations = scene.translations.copy()
    rotation = scene.rotations[second] @ scene.rotations[first].T
    translations[second] = rotation @ translations[first]
    scene = dataclasses.replace(scene, translations=translations)
    data = RealPairs([scene], CPU)
    assert float(data.inlier_ratios[0]) == 0
    assert float(data._weights[0]) == 0 and float(data._weights[1:].sum()) > 0


def test_short_pairs_are_padded_and_masked(data):
    batch = data.sample(4, 100, NO_AUGMENTATION, generator_for(0, 0, 0, CPU))
    assert batch.mask.sum(1).tolist() == [59] * 4 or batch.correspondences.shape[1] == 60


def test_side_channels_are_those_of_inference():
    scene = make_scene("a")
    data = RealPairs([scene], CPU)
    batch = data._gather(torch.tensor([0]), torch.arange(59)[None])
    expected = correspondences.side_information(scene.pair(0).as_correspondences(), 5)
    channels = side_information(batch, 5)
    assert channels is not None
    np.testing.assert_allclose(channels[0].numpy(), expected, atol=3e-3)
    assert side_information(batch, 0) is None


def test_mutual_input_yields_the_mutual_matches_of_either_layout():
    scene = make_scene("a", num_keypoints=160)
    pairs = [scene.pair(index) for index in range(6)]
    for source in ([scene], pairs):
        data = RealPairs(source, CPU, match_input=MatchInput.MUTUAL)
        for index, pair in enumerate(pairs):
            num = int(pair.mutual.sum())
            batch = data._gather(torch.tensor([index]), torch.arange(num + 1)[None])
            assert batch.mask[0].tolist() == [True] * num + [False]
            assert batch.mutual[batch.mask].all()
            seen, read = pair.correspondences[pair.mutual], batch.correspondences[0, :num].numpy()
            np.testing.assert_allclose(read, seen, atol=1e-6)
            np.testing.assert_allclose(batch.ratios[0, :num], pair.ratios[pair.mutual], atol=3e-3)
            rotations = batch.rotations[0, :num].numpy() - pair.rotations[pair.mutual]
            np.testing.assert_allclose(np.cos(rotations), 1, atol=1e-5)


def with_negatives(scene, num):
    """The scene with its first pairs marked as showing two places."""
    covisible = scene.covisible.copy()
    covisible[:num] = 0
    return dataclasses.replace(scene, covisible=covisible)


def test_negatives_are_all_wrong_and_drawn_as_often_as_asked():
    scenes = [with_negatives(make_scene("a"), 2), with_negatives(make_scene("b", seed=1), 1)]
    data = RealPairs(scenes, CPU, negative_share=0.25)
    batch = data.sample(400, 32, AugmentConfig(), generator_for(0, 0, 0, CPU))
    assert 0.18 < float((~batch.related).float().mean()) < 0.32
    assert not batch.inliers()[~batch.related].any()
    assert batch.inliers()[batch.related].any(1).all()
    never = RealPairs(scenes, CPU).sample(400, 32, AugmentConfig(), generator_for(0, 0, 0, CPU))
    assert never.related.all()


def test_a_share_of_negatives_without_any_is_refused():
    with pytest.raises(InputError, match="train prepare --negatives"):
        RealPairs([make_scene("a")], CPU, negative_share=0.1)


def test_batches_depend_on_seed_step_and_rank_only(data):
    config = AugmentConfig()
    first, again = (data.sample(4, 32, config, generator_for(3, 7, 1, CPU)) for _ in range(2))
    assert torch.equal(first.correspondences, again.correspondences)
    for other in [(4, 7, 1), (3, 8, 1), (3, 7, 0)]:
        assert not torch.equal(
            first.correspondences, data.sample(4, 32, config, generator_for(*other, CPU)).correspondences
        )
