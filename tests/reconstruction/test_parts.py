"""A part that stands in the wrong place is put where most points say; one that stands right stays."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import pycolmap
import pytest
from two_parts import make_two_parts

from corrsfm.reconstruction import mending, parts
from corrsfm.reconstruction.agreement import relative_pose_differences_deg
from corrsfm.reconstruction.explained import Explained, ExplainedPair
from corrsfm.reconstruction.joining import join_models
from corrsfm.reconstruction.mending import Mender
from corrsfm.reconstruction.parts import put_together_again, weak_links
from corrsfm.reconstruction.views import views_of
from corrsfm.types import Pair

NEXT_TO = (range(0, 50, 10), range(50, 100, 10))
SIDE_BY_SIDE = (range(0, 50, 10), range(5, 55, 10))
LEFT, RIGHT = ("a", "b", "c", "d"), ("w", "x", "y")


def explained(counts: Mapping[Pair, tuple[int, int]]) -> Explained:
    """What a model explains, from verified and explained matches of pairs."""
    pairs = tuple(
        ExplainedPair(name0=pair[0], name1=pair[1], num_verified=num, num_explained=held, is_registered=True)
        for pair, (num, held) in sorted(counts.items())
    )
    return Explained(pairs=pairs, registered=tuple(sorted({name for pair in counts for name in pair})))


def within(part: tuple[str, ...], num: int = 200) -> dict[Pair, tuple[int, int]]:
    return {(one, two): (num, num) for i, one in enumerate(part) for two in part[i + 1 :]}


def test_parts_that_a_weak_pair_holds_together_are_named() -> None:
    (link,) = weak_links(explained({**within(LEFT), **within(RIGHT), ("a", "w"): (30, 25)}))
    assert (link.part0, link.part1) == (LEFT, RIGHT)
    assert link.strength == pytest.approx(25 / 200)


def test_parts_whose_pairs_all_contradict_the_model_are_held_by_nothing() -> None:
    (link,) = weak_links(explained({**within(LEFT), **within(RIGHT), ("a", "w"): (300, 40)}))
    assert (link.part0, link.part1, link.strength) == (LEFT, RIGHT, 0.0)


@pytest.mark.parametrize("across", [{("a", "w"): (90, 85)}, {("a", "w"): (60, 60), ("b", "y"): (80, 70)}])
def test_parts_that_are_held_as_their_photos_are_stay_one(across: dict[Pair, tuple[int, int]]) -> None:
    assert not weak_links(explained({**within(LEFT), **within(RIGHT), **across}))


def test_two_photos_are_no_part() -> None:
    assert not weak_links(explained({**within(LEFT), **within(RIGHT[:2]), ("a", "w"): (20, 20)}))


def test_the_weakest_link_comes_first_and_a_part_may_have_parts() -> None:
    others = ("m", "n", "o")
    links = weak_links(
        explained({
            **within(LEFT), **within(RIGHT), **within(others), ("a", "w"): (50, 50), ("c", "m"): (20, 20),
        })
    )  # fmt: skip
    assert [link.part1 for link in links] == [others, RIGHT]
    assert links[0].part0 == (*LEFT, *RIGHT) and links[1].part0 == LEFT


def as_one(a: pycolmap.Reconstruction, b: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The photos and points of b put into a where they stand in their own frame."""
    whole = pycolmap.Reconstruction(a)
    for image_id, image in sorted(b.images.items()):
        if image.has_pose:
            frame = whole.frames[whole.images[image_id].frame_id]
            frame.set_cam_from_world(image.camera_id, image.cam_from_world())
            whole.register_frame(frame.frame_id)
    for _, point in sorted(b.points3D.items()):
        track = pycolmap.Track()
        for element in point.track.elements:
            track.add_element(element)
        whole.add_point3D(point.xyz, track, point.color)
    return whole


def test_a_part_in_the_wrong_place_is_put_where_few_matches_of_many_pairs_say(tmp_path: Path) -> None:
    made = make_two_parts(
        tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=40, num_cross_matches=4, num_false_matches=8
    )
    wrong = as_one(*made.models)
    before = views_of(wrong)
    again = put_together_again(wrong, made.evidence.explain(before), made.database, made.evidence)
    assert again is not None
    assert relative_pose_differences_deg(views_of(again), views_of(made.truth)).max() < 0.6
    assert views_of(wrong).keys() == before.keys()
    assert all((views_of(wrong)[name].rotation == view.rotation).all() for name, view in before.items())


def test_a_part_where_most_verified_matches_across_say_is_not_moved(tmp_path: Path) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    held = ExplainedPair(
        name0="a4.jpg", name1="b0.jpg", num_verified=20, num_explained=12, is_registered=True
    )
    holding = Explained(pairs=(*found.pairs, held), registered=found.registered)
    assert weak_links(holding)
    assert put_together_again(model, holding, made.database, made.evidence) is None
    assert put_together_again(model, found, made.database, made.evidence) is not None


def test_no_other_place_is_tried_once_the_time_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    model = as_one(*made.models)
    clock = itertools.count(step=10)
    monkeypatch.setattr(parts, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    found = made.evidence.explain(views_of(model))
    given = model, found, made.database, made.evidence
    assert put_together_again(*given, max_runtime_seconds=5) is None
    assert put_together_again(*given) is not None


def test_parts_in_their_right_places_stay(tmp_path: Path) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=NEXT_TO, num_common_points=60)
    (right,), _ = join_models(made.models, made.database, made.evidence)
    found = made.evidence.explain(views_of(right))
    assert weak_links(found)
    assert put_together_again(right, found, made.database, made.evidence) is None


@pytest.mark.parametrize(("angles_deg", "num_common"), [(NEXT_TO, 6), (SIDE_BY_SIDE, 100)])
def test_parts_stay_where_too_little_speaks_or_a_fold_would_come(
    angles_deg: tuple[range, range], num_common: int, tmp_path: Path
) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=angles_deg, num_common_points=num_common)
    model = as_one(*made.models)
    found = made.evidence.explain(views_of(model))
    assert weak_links(found)
    assert put_together_again(model, found, made.database, made.evidence) is None


def test_photos_that_fell_out_are_registered_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_two_parts(tmp_path / "d.db", angles_deg=(range(0, 60, 10), ()), num_common_points=80)
    (whole, _) = made.models
    without = pycolmap.Reconstruction(whole)
    without.deregister_frame(without.find_image_with_name("a5.jpg").frame_id)
    monkeypatch.setattr(mending, "put_together_again", lambda *_, **__: without)
    mender = Mender(made.evidence, made.database, tmp_path / "work")
    mended = mender.mend(whole, made.evidence.explain(views_of(whole)))
    assert mended is not None
    assert relative_pose_differences_deg(views_of(mended), views_of(made.truth)).max() < 0.6
    assert len(views_of(mended)) == 6
