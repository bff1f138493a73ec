"""How far two models of one scene agree."""

import dataclasses

import numpy as np
import pytest
from scene_of_points import bend, make_scene, moved

from corrsfm.reconstruction.agreement import agreement, relative_pose_differences_deg


def test_frame_and_scale_do_not_matter() -> None:
    views = make_scene().views
    assert relative_pose_differences_deg(views, moved(views)) == pytest.approx(np.zeros(10), abs=1e-4)
    common = agreement(views, moved(views))
    assert (common.num_photos, common.share) == (5, 1.0)


def test_a_turned_photo_disagrees_about_its_pairs() -> None:
    views = make_scene().views
    bent = {**views, "2.jpg": bend(views["2.jpg"], 7.0)}
    assert agreement(views, bent).share == 0.6  # six of ten pairs are without it
    differences = relative_pose_differences_deg(views, moved(bent))
    pairs = [(i, j) for i in range(5) for j in range(i + 1, 5)]
    assert [round(float(d), 3) for d in differences] == [7.0 if 2 in pair else 0.0 for pair in pairs]


def test_the_direction_of_a_baseline_has_a_sign() -> None:
    views = make_scene(2).views
    view0, view1 = views.values()
    mirrored = 2 * view0.centre - view1.centre
    other = {**views, "1.jpg": dataclasses.replace(view1, translation=-view1.rotation @ mirrored)}
    assert relative_pose_differences_deg(views, other) == pytest.approx([180.0])


def test_photos_from_one_place_have_no_direction_between_them() -> None:
    views = make_scene(3).views
    here = views["0.jpg"].centre
    shifted = {
        **views,
        "1.jpg": dataclasses.replace(views["1.jpg"], translation=-views["1.jpg"].rotation @ here),
    }
    again = {
        **shifted,
        "1.jpg": dataclasses.replace(
            views["1.jpg"], translation=-views["1.jpg"].rotation @ (here + [0.0, 0.001, 0.0])
        ),
    }
    assert agreement(shifted, again).share == 1.0


def test_only_common_photos_are_compared() -> None:
    views = make_scene(4).views
    part = {name: views[name] for name in ("1.jpg", "3.jpg")}
    common = agreement(views, part)
    assert (common.num_photos, common.share) == (2, 1.0)


@pytest.mark.parametrize("names", [[], ["0.jpg"]])
def test_models_without_a_common_pair_do_not_agree(names: list[str]) -> None:
    views = make_scene(3).views
    common = agreement(views, {name: views[name] for name in names})
    assert (common.num_photos, common.share) == (len(names), 0.0)


def test_models_without_any_extent_compare_rotations_alone() -> None:
    views = {
        name: dataclasses.replace(view, translation=np.zeros(3)) for name, view in make_scene(3).views.items()
    }
    assert agreement(views, views).share == 1.0
