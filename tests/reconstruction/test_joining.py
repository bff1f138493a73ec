"""Parts of one scene become one model where points say how; parts that do not belong together stay apart."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from two_parts import TwoParts, make_two_parts

from corrsfm.config import ReconstructionConfig
from corrsfm.reconstruction.agreement import relative_pose_differences_deg
from corrsfm.reconstruction.joining import FEWEST_POINTS, join_models
from corrsfm.reconstruction.mapper import reconstruct
from corrsfm.reconstruction.similarity import Observed, find_similarity, fit_similarity
from corrsfm.reconstruction.views import views_of

NEXT_TO = (range(0, 50, 10), range(50, 100, 10))
APART = (range(0, 50, 10), range(80, 130, 10))
SIDE_BY_SIDE = (range(0, 50, 10), range(5, 55, 10))


def assert_joined_as_it_was(parts: TwoParts) -> pycolmap.Reconstruction:
    models, (attempt,) = join_models(parts.models, parts.database, parts.evidence)
    assert attempt.is_joined and len(models) == 1, attempt.reason
    views = views_of(models[0])
    assert len(views) == 10
    assert relative_pose_differences_deg(views, views_of(parts.truth)).max() < 0.6
    return models[0]


def test_parts_that_share_points_become_one_model(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = assert_joined_as_it_was(parts)
    across = [
        point
        for point in model.points3D.values()
        if len({model.images[e.image_id].name[0] for e in point.track.elements}) == 2
    ]
    assert len(across) >= 55
    assert max(model.images) <= 10 and model.num_points3D() == 60 + 2 * 150


def test_few_matches_of_each_pair_are_enough_together(tmp_path: Path) -> None:
    parts = make_two_parts(
        tmp_path / "d.db", angles_deg=APART, num_common_points=30, num_cross_matches=3, num_false_matches=10
    )
    assert_joined_as_it_was(parts)


@pytest.mark.parametrize("unit_descriptors", [False, True])
def test_without_any_match_the_look_of_points_is_enough(unit_descriptors: bool, tmp_path: Path) -> None:
    parts = make_two_parts(
        tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60, num_cross_matches=0,
        unit_descriptors=unit_descriptors,
    )  # fmt: skip
    assert_joined_as_it_was(parts)


@pytest.mark.parametrize("num_common", [0, 8])
def test_parts_without_enough_in_common_stay_apart_and_say_what_is_missing(
    num_common: int, tmp_path: Path
) -> None:
    parts = make_two_parts(
        tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=num_common, num_false_matches=20
    )
    models, (attempt,) = join_models(parts.models, parts.database, parts.evidence)
    assert models == list(parts.models) and not attempt.is_joined
    assert attempt.num_points < FEWEST_POINTS and attempt.num_candidates > 100
    assert "photos that show what both show would join them" in str(attempt)


def test_two_places_that_hold_things_of_one_look_are_not_joined(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=SIDE_BY_SIDE, num_common_points=100)
    models, (attempt,) = join_models(parts.models, parts.database, parts.evidence)
    assert len(models) == 2 and attempt.num_points >= FEWEST_POINTS
    assert "folded" in attempt.reason


def test_equal_parts_give_equal_models(tmp_path: Path) -> None:
    made = [
        make_two_parts(tmp_path / name, angles_deg=APART, num_common_points=40, num_false_matches=10)
        for name in ("1.db", "2.db")
    ]
    first, second = (join_models(one.models, one.database, one.evidence)[0][0] for one in made)
    for image_id, image in first.images.items():
        other = second.images[image_id].cam_from_world()
        np.testing.assert_array_equal(image.cam_from_world().matrix(), other.matrix())


def test_the_models_that_are_joined_are_not_changed(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    before = [
        {name: (view.rotation.tolist(), view.translation.tolist()) for name, view in views_of(one).items()}
        for one in parts.models
    ]
    join_models(parts.models, parts.database, parts.evidence)
    after = [
        {name: (view.rotation.tolist(), view.translation.tolist()) for name, view in views_of(one).items()}
        for one in parts.models
    ]
    assert before == after


def test_models_that_share_photos_are_joined_by_them(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=(range(0, 80, 10), ()), num_common_points=80)
    (whole, _) = parts.models
    first, second = pycolmap.Reconstruction(whole), pycolmap.Reconstruction(whole)
    for model, gone in ((first, ("a6.jpg", "a7.jpg")), (second, ("a0.jpg", "a1.jpg", "a2.jpg"))):
        for name in gone:
            model.deregister_frame(model.find_image_with_name(name).frame_id)
    second.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(), [1.0, 2.0, 3.0]))
    models, (attempt,) = join_models([first, second], parts.database, parts.evidence)
    assert attempt.is_joined and len(models) == 1
    assert relative_pose_differences_deg(views_of(models[0]), views_of(parts.truth)).max() < 0.6


def test_a_joined_model_that_is_larger_than_the_first_takes_its_place(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    # Without points nothing can join it.
    empty = pycolmap.Reconstruction(parts.models[0])
    empty.deregister_frame(empty.find_image_with_name("a4.jpg").frame_id)
    for point_id in list(empty.points3D):
        empty.delete_point3D(point_id)
    models, attempts = join_models([empty, *parts.models], parts.database, parts.evidence)
    assert [model.num_reg_images() for model in models] == [10, 4]
    assert [attempt.is_joined for attempt in attempts] == [False, False, True, False]


def test_the_mapper_hands_its_models_on_to_be_joined(tmp_path: Path) -> None:
    parts = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)

    def join(models: list[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
        return join_models(models, parts.database, parts.evidence)[0]

    config = ReconstructionConfig(refine_intrinsics=False)
    apart = reconstruct(parts.database, None, tmp_path / "apart", config=config, num_threads=1)
    joined = reconstruct(parts.database, None, tmp_path / "joined", config=config, num_threads=1, join=join)
    assert [model.num_images for model in apart] == [5, 5]
    assert [model.num_images for model in joined] == [10]
    views = views_of(pycolmap.Reconstruction(tmp_path / "joined" / "0"))
    assert relative_pose_differences_deg(views, views_of(parts.truth)).max() < 0.6


def observed(points: np.ndarray, seen_from: np.ndarray) -> Observed:
    """Points seen by a photo that looks along z from a place before them."""
    num = len(points)
    in_camera = points - seen_from
    return Observed(
        points=points,
        rotations=np.tile(np.eye(3), (num, 1, 1)),
        translations=np.tile(-seen_from, (num, 1)),
        rays=in_camera[:, :2] / in_camera[:, 2:],
        focal_px=np.full(num, 500.0),
    )


def test_a_similarity_is_found_among_false_correspondences() -> None:
    generator = np.random.default_rng(1)
    b = generator.uniform(-1, 1, (100, 3))
    rotation = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    a = 2.5 * b @ rotation.T + [1.0, 2.0, 3.0]
    a[40:] = generator.permutation(a[40:])
    sides = observed(a, np.array([1.0, 2.0, -9.0])), observed(b, np.array([0.0, 0.0, -5.0]))
    found = find_similarity(*sides, max_error_px=3.0)
    assert found is not None
    similarity, agreeing = found
    assert agreeing[:40].all() and agreeing.sum() < 45
    np.testing.assert_allclose(similarity.rotation, rotation, atol=1e-9)
    assert similarity.scale == pytest.approx(2.5)
    np.testing.assert_allclose(similarity.invert(similarity.apply(b)), b, atol=1e-9)


def test_points_on_a_line_or_too_few_give_no_similarity() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert fit_similarity(line, line) is None
    few = observed(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]]), np.array([0.0, 0.0, -5.0]))
    assert find_similarity(few, few, max_error_px=3.0) is None
