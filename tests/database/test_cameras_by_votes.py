"""Proposed cameras confirmed, split and undone by votes."""

import cv2  # noqa: F401

from corrsfm.database.cameras_by_votes import assign_by_votes, cameras_that_vote
from corrsfm.database.focal_votes import FocalGroup, FocalVotes, VoteDecision
from corrsfm.types import Camera, ImageRecord

LANDSCAPE = Camera(model="SIMPLE_RADIAL", width=640, height=480, params=(768.0, 320.0, 240.0, 0.0))
PORTRAIT = Camera(model="SIMPLE_RADIAL", width=480, height=640, params=(768.0, 240.0, 320.0, 0.0))
KNOWN = Camera(
    model="SIMPLE_RADIAL",
    width=640,
    height=480,
    params=(500.0, 320.0, 240.0, 0.0),
    has_prior_focal_length=True,
)


def records(*camera_ids: int) -> list[ImageRecord]:
    return [
        ImageRecord(name=f"{number}.jpg", camera_id=index, sha256="")
        for number, index in enumerate(camera_ids)
    ]


def decided(focal_px: float) -> FocalVotes:
    return FocalVotes(
        decision=VoteDecision.DECIDED, focal_px=focal_px, focal_ratio=focal_px / 640, num_votes=9
    )


def test_cameras_with_an_open_focal_length_and_two_photos_vote() -> None:
    assert cameras_that_vote([LANDSCAPE, KNOWN], records(0, 0, 1, 1)) == [(0,)]
    assert cameras_that_vote([LANDSCAPE], records(0)) == []
    assert cameras_that_vote([], []) == []


def test_upright_and_turned_photos_vote_together() -> None:
    assert cameras_that_vote([PORTRAIT, LANDSCAPE], records(0, 1)) == [(0, 1)]


def test_a_turned_camera_that_could_belong_to_two_votes_alone() -> None:
    cameras = [LANDSCAPE, PORTRAIT, LANDSCAPE]
    assert cameras_that_vote(cameras, records(0, 0, 1, 1, 2, 2)) == [(0,), (1,), (2,)]


def test_square_photos_are_not_turned_ones_of_each_other() -> None:
    square = Camera(model="SIMPLE_PINHOLE", width=500, height=500, params=(600.0, 250.0, 250.0))
    assert cameras_that_vote([square], records(0, 0)) == [(0,)]


def test_a_decided_focal_length_counts_as_known_for_upright_and_turned_photos() -> None:
    cameras, ids, remarks = assign_by_votes(
        [LANDSCAPE, PORTRAIT, KNOWN], records(0, 1, 2, 0), {(0, 1): decided(600.0)}
    )
    assert ids == [0, 1, 2, 0]
    assert [camera.params[0] for camera in cameras] == [600.0, 600.0, 500.0]
    assert [(camera.width, camera.height) for camera in cameras] == [(640, 480), (480, 640), (640, 480)]
    assert all(camera.has_prior_focal_length for camera in cameras)
    assert len(remarks) == 1
    assert remarks[0].startswith("3 photos of 640×480 pixels share a camera of focal length 600 px (0.94 of")


def test_scattered_votes_give_every_photo_its_guess() -> None:
    votes = FocalVotes(decision=VoteDecision.SCATTERED, focal_px=2000.0, num_votes=9)
    cameras, ids, (remark,) = assign_by_votes([KNOWN, LANDSCAPE], records(1, 0, 1, 1), {(1,): votes})
    assert ids == [0, 1, 2, 3]
    assert cameras == [LANDSCAPE, KNOWN, LANDSCAPE, LANDSCAPE]
    assert "many cameras" in remark and "--camera-mode single" in remark


def test_two_groups_get_a_camera_each_and_photos_without_a_vote_join_the_larger() -> None:
    groups = (
        FocalGroup(names=("0.jpg", "2.jpg"), focal_px=600.0, focal_ratio=600 / 640),
        FocalGroup(names=("1.jpg", "3.jpg", "4.jpg"), focal_px=900.0, focal_ratio=900 / 640),
    )
    votes = FocalVotes(decision=VoteDecision.TWO_GROUPS, groups=groups, num_votes=20)
    cameras, ids, (remark,) = assign_by_votes([LANDSCAPE], records(0, 0, 0, 0, 0, 0), {(0,): votes})
    assert ids == [0, 1, 0, 1, 1, 1]
    assert [camera.params[0] for camera in cameras] == [600.0, 900.0]
    assert "600 px (0.jpg, 2.jpg)" in remark and "900 px (1.jpg, 3.jpg, 4.jpg)" in remark


def test_undecided_votes_leave_the_guess_and_say_so() -> None:
    cameras, ids, (remark,) = assign_by_votes(
        [LANDSCAPE], records(0, 0), {(0,): FocalVotes(decision=VoteDecision.UNDECIDED)}
    )
    assert (cameras, ids) == ([LANDSCAPE], [0, 0])
    assert "guessed focal length" in remark and "0 pairs" in remark


def test_without_votes_nothing_changes() -> None:
    assert assign_by_votes([LANDSCAPE, KNOWN], records(0, 1), {}) == ([LANDSCAPE, KNOWN], [0, 1], [])
