"""From proposed cameras to cameras by evidence: confirmed, split or undone by the votes of the pairs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from corrsfm.colmap.cameras import with_focal_length
from corrsfm.database.focal_votes import FocalVotes, VoteDecision
from corrsfm.errors import first_few
from corrsfm.types import Camera, ImageRecord

__all__ = ["assign_by_votes", "cameras_that_vote"]

CameraIds = tuple[int, ...]


def cameras_that_vote(cameras: Sequence[Camera], records: Sequence[ImageRecord]) -> list[CameraIds]:
    """Proposed cameras whose focal length is open, those that may be one camera upright and turned together.

    Parameters
    ----------
    cameras : sequence of Camera
    records : sequence of ImageRecord

    Returns
    -------
    list of tuple of int
        Indices into the cameras: those with unknown focal length and, alone or turned, two photos or more. A
        camera stands beside another if each is the only one of its size and the sizes are swapped.
    """
    num_photos = [0] * len(cameras)
    for record in records:
        num_photos[record.camera_id] += 1
    of_size: dict[tuple[int, int], list[int]] = defaultdict(list)
    for index, camera in enumerate(cameras):
        if not camera.has_prior_focal_length and num_photos[index]:
            of_size[(camera.width, camera.height)].append(index)
    together: list[CameraIds] = []
    for (width, height), indices in of_size.items():
        turned = of_size.get((height, width), []) if width != height else []
        if len(indices) == len(turned) == 1:
            if indices < turned:
                together.append((indices[0], turned[0]))
        else:
            together.extend((index,) for index in indices)
    return sorted(ids for ids in together if sum(num_photos[index] for index in ids) > 1)


def assign_by_votes(
    cameras: Sequence[Camera], records: Sequence[ImageRecord], votes: Mapping[CameraIds, FocalVotes]
) -> tuple[list[Camera], list[int], list[str]]:
    """Confirm, split or undo proposed cameras.

    Parameters
    ----------
    cameras : sequence of Camera
        As proposed.
    records : sequence of ImageRecord
        Their ``camera_id`` counts into the cameras.
    votes : mapping of tuple of int to FocalVotes
        By the cameras that voted together, see `cameras_that_vote`; the others stay as they are.

    Returns
    -------
    cameras : list of Camera
        In the order of the first photo of each. Focal lengths that were voted count as known.
    camera_ids : list of int
        Index into these, one per record.
    remarks : list of str
        What was decided and why, one line for each vote.
    """
    names = [[r.name for r in records if r.camera_id == index] for index in range(len(cameras))]
    key_of: dict[str, tuple] = {r.name: (r.camera_id,) for r in records}
    camera_of: dict[tuple, Camera] = {(index,): camera for index, camera in enumerate(cameras)}
    remarks = []
    for ids, outcome in sorted(votes.items()):
        own = sorted(name for index in ids for name in names[index])
        remarks.append(_remark(own, cameras[ids[0]], outcome))
        if outcome.decision is VoteDecision.SCATTERED:
            for name in own:
                key_of[name] = (*key_of[name], name)
                camera_of[key_of[name]] = cameras[key_of[name][0]]
            continue
        for number, (members, focal_px) in enumerate(_groups(own, outcome)):
            for name in members:
                index = key_of[name][0]
                key_of[name] = (index, number)
                camera_of[key_of[name]] = with_focal_length(cameras[index], focal_px)
    position: dict[tuple, int] = {}
    for record in records:
        position.setdefault(key_of[record.name], len(position))
    return (
        [camera_of[key] for key in position],
        [position[key_of[record.name]] for record in records],
        remarks,
    )


def _groups(names: Sequence[str], outcome: FocalVotes) -> list[tuple[list[str], float]]:
    """Photos of one focal length each; none if the votes decided nothing.

    A photo without a vote goes with the larger group: a wrong focal length costs it less than a camera that
    nothing else holds.
    """
    if outcome.decision is VoteDecision.DECIDED:
        return [(list(names), outcome.focal_px)]
    if outcome.decision is not VoteDecision.TWO_GROUPS:
        return []
    members = [[name for name in names if name in set(group.names)] for group in outcome.groups]
    placed = {name for group in members for name in group}
    max(members, key=len).extend(name for name in names if name not in placed)
    return [(group, one.focal_px) for group, one in zip(members, outcome.groups, strict=True)]


def _remark(names: Sequence[str], camera: Camera, outcome: FocalVotes) -> str:
    """One line for the log and the report."""
    photos = f"{len(names)} photos of {camera.width}×{camera.height} pixels"
    pairs = f"{outcome.num_votes} {'pair' if outcome.num_votes == 1 else 'pairs'}"
    match outcome.decision:
        case VoteDecision.DECIDED:
            return (
                f"{photos} share a camera of focal length {outcome.focal_px:.0f} px "
                f"({outcome.focal_ratio:.2f} of the longest side), by the matches of {pairs}"
            )
        case VoteDecision.TWO_GROUPS:
            small, large = outcome.groups
            return (
                f"{photos} are of two focal lengths, by the matches of {pairs}: {small.focal_px:.0f} px "
                f"({first_few(small.names)}) and {large.focal_px:.0f} px ({first_few(large.names)}); "
                "each gets a camera"
            )
        case VoteDecision.SCATTERED:
            return (
                f"{photos} seem to be of many cameras: the matches of {pairs} agree on no focal length; each "
                "photo gets a camera, unless a model with one for all predicts as many matches; if one "
                "camera took them, use --camera-mode single"
            )
    return (
        f"{photos} share a camera of a guessed focal length: the matches of {pairs} do not determine it; "
        "if several cameras took them, use --camera-mode per-image"
    )
