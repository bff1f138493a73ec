"""What a model explains of the verified matches."""

import dataclasses

import numpy as np
import pytest
from scene_of_points import CAMERA, bend, make_scene, turn

from corrsfm.reconstruction.explained import explain
from corrsfm.reconstruction.views import View


def test_the_true_model_explains_everything() -> None:
    scene = make_scene()
    explained = explain(scene.views, scene.keypoints, scene.verified())
    assert explained.share == explained.share_of_registered == 1.0
    assert (explained.num_verified, explained.num_explained) == (600, 600)
    assert explained.contradicted == () and explained.loose_ends == ()
    assert [(pair.name0, pair.name1) for pair in explained.pairs] == scene.all_pairs()


def test_a_pair_angle_is_that_between_its_photos() -> None:
    scene = make_scene(3)
    angles = [pair.angle_deg for pair in explain(scene.views, scene.keypoints, scene.verified()).pairs]
    assert angles == pytest.approx([10.0, 20.0, 10.0], abs=1.5)


def test_a_photo_in_the_wrong_place_contradicts_its_pairs_only() -> None:
    scene = make_scene()
    views = {**scene.views, "2.jpg": dataclasses.replace(scene.views["2.jpg"], rotation=turn("x", 30.0))}
    explained = explain(views, scene.keypoints, scene.verified())
    wrong = {(pair.name0, pair.name1) for pair in explained.contradicted}
    assert wrong == {pair for pair in scene.all_pairs() if "2.jpg" in pair}
    assert all(pair.share == 1.0 for pair in explained.pairs if "2.jpg" not in (pair.name0, pair.name1))
    assert explained.loose_ends == ("2.jpg",)


def test_false_pairs_do_not_count_against_the_pairs_that_agree() -> None:
    scene = make_scene()
    verified = scene.verified()
    verified["0.jpg", "4.jpg"] = np.roll(verified["0.jpg", "4.jpg"], 7, axis=0) * [1, 0]  # all to keypoint 0
    explained = explain(scene.views, scene.keypoints, verified)
    assert [(pair.name0, pair.name1) for pair in explained.contradicted] == [("0.jpg", "4.jpg")]
    assert explained.share < 0.95
    assert explained.share_of_supported == 1.0
    assert explained.misplaced == ()


def test_a_photo_most_of_whose_matches_contradict_it_is_misplaced() -> None:
    scene = make_scene()
    explained = explain({**scene.views, "1.jpg": bend(scene.views["1.jpg"], 12.0)}, scene.keypoints,
                        scene.verified())  # fmt: skip
    assert explained.misplaced == ("1.jpg",)
    shares = explained.photo_shares
    assert list(shares) == ["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg"]
    # The others lose one of four pairs to it.
    assert shares["1.jpg"] < 0.4 and all(0.75 <= shares[name] < 0.9 for name in shares if name != "1.jpg")


def test_contradicted_pairs_come_the_least_explained_first() -> None:
    scene = make_scene()
    explained = explain({**scene.views, "0.jpg": bend(scene.views["0.jpg"], 3.0)}, scene.keypoints,
                        scene.verified())  # fmt: skip
    shares = [pair.share for pair in explained.contradicted]
    assert shares == sorted(shares)


def test_false_matches_are_not_explained() -> None:
    scene = make_scene(2)
    matches = scene.matches(("0.jpg", "1.jpg"))
    matches[::3, 1] = np.roll(matches[::3, 1], 1)
    (pair,) = explain(scene.views, scene.keypoints, {("0.jpg", "1.jpg"): matches}).pairs
    assert pair.num_verified == 60
    assert 40 <= pair.num_explained <= 43  # a false match may lie on the line by chance
    assert not pair.is_contradicted


def test_a_photo_that_is_missing_costs_its_pairs() -> None:
    scene = make_scene(4)
    views = {name: view for name, view in scene.views.items() if name != "3.jpg"}
    explained = explain(views, scene.keypoints, scene.verified())
    assert explained.share == 0.5  # three of six pairs
    assert explained.share_of_registered == 1.0
    assert explained.contradicted == ()
    assert explained.registered == ("0.jpg", "1.jpg", "2.jpg")


def test_the_orientation_of_a_pair_does_not_matter() -> None:
    scene = make_scene(3)
    turned = {(b, a): matches[:, ::-1] for (a, b), matches in scene.verified().items()}
    views = {**scene.views, "1.jpg": bend(scene.views["1.jpg"], 1.0)}
    one = explain(views, scene.keypoints, scene.verified())
    other = explain(views, scene.keypoints, turned)
    assert one.num_explained == other.num_explained < 180


def test_a_photo_held_by_one_pair_is_a_loose_end() -> None:
    scene = make_scene(4)
    verified = {pair: matches for pair, matches in scene.verified().items() if "3.jpg" not in pair}
    verified["2.jpg", "3.jpg"] = scene.matches(("2.jpg", "3.jpg"))
    assert explain(scene.views, scene.keypoints, verified).loose_ends == ("3.jpg",)


@pytest.mark.parametrize("registered", [[], ["0.jpg"], ["0.jpg", "1.jpg"]])
def test_a_scene_without_pairs_has_the_share_zero(registered: list[str]) -> None:
    scene = make_scene(2)
    views = {name: scene.views[name] for name in registered}
    for verified in ({}, {("0.jpg", "1.jpg"): np.zeros((0, 2), np.int32)}):
        explained = explain(views, scene.keypoints, verified)
        assert explained.share == explained.share_of_registered == 0.0
        assert explained.contradicted == ()
        assert explained.loose_ends == tuple(registered)


def test_a_camera_that_only_turned_explains_nothing() -> None:
    scene = make_scene(2)
    pair = ("0.jpg", "1.jpg")
    still = {**scene.views, "1.jpg": dataclasses.replace(scene.views["1.jpg"], translation=turn("y", 10.0) @
             scene.views["0.jpg"].translation)}  # fmt: skip
    explained = explain(still, scene.keypoints, {pair: scene.matches(pair)})
    assert (explained.num_explained, explained.widest_angle_deg) == (0, 0.0)
    assert len(explained.contradicted) == 1


@pytest.mark.parametrize("jitter", [0.0, 1e-4, -1e-4])
def test_photos_of_one_standpoint_agree_by_rotation_whatever_side_noise_says(jitter: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-3, -2, 8], [3, 2, 12], (200, 3))
    views, keypoints = {}, {}
    for number, angle in enumerate([-5.0, 5.0]):
        rotation = turn("y", angle)
        in_camera = points @ rotation.T
        name = f"{number}.jpg"
        translation = np.array([number * jitter, 0.0, 0.0])
        views[name] = View(camera=CAMERA, rotation=rotation, translation=translation)
        keypoints[name] = in_camera[:, :2] / in_camera[:, 2:] * 500.0 + [320.0, 240.0]
        keypoints[name] += rng.normal(0, 0.5, (200, 2))
    verified = {("0.jpg", "1.jpg"): np.column_stack([np.arange(200)] * 2)}
    assert explain(views, keypoints, verified).share == 1.0
    # Turned upwards by two degrees, 17 px, nothing agrees.
    up = dataclasses.replace(views["1.jpg"], rotation=turn("x", 2.0) @ views["1.jpg"].rotation)
    assert explain({**views, "1.jpg": up}, keypoints, verified).share < 0.1
