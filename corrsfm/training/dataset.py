"""Real pairs → training batches, assembled on the training device.

All pairs of a data set fit in the memory of any accelerator (a few bytes per match), so a batch is a handful
of indexing operations on the device, without worker processes. A batch depends only on the seed, the step and
the rank: a resumed run sees the same batches as a straight one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from corrsfm.colmap.cameras import pinhole_parameters
from corrsfm.config import MatchInput
from corrsfm.errors import InputError, first_few
from corrsfm.geometry import INLIER_THRESHOLD, essential_from_pose, relative_pose
from corrsfm.images.cameras import DEFAULT_FOCAL_FACTOR
from corrsfm.labelled.compact import RATIO_STEPS, CompactScene, is_compact, quantise_ratios, read_scenes
from corrsfm.labelled.oanet import OANetPair, read_pairs
from corrsfm.model.network import symmetric_epipolar_squared
from corrsfm.prune.correspondences import side_channels
from corrsfm.training.config import AugmentConfig

__all__ = ["Batch", "RealPairs", "augment", "concatenate", "generator_for", "side_information"]

# A pair with fewer inliers teaches nothing.
_MIN_INLIERS = 20


@dataclass
class Batch:
    """B pairs of N correspondences.

    Attributes
    ----------
    correspondences : (B, N, 4) float32
        ``x0 y0 x1 y1`` normalised as in inference.
    true_correspondences : (B, N, 4) float32
        The same without lens distortion; what the matrix explains.
    matrix : (B, 3, 3) float32
        ``x1ᵀ F x0 = 0`` for inliers among ``true_correspondences``; essential unless intrinsics are jittered.
    ratios, mutual, log_scale_ratios, rotations : (B, N) float32
        Side information before it becomes channels.
    mask : (B, N) bool
        False for padding.
    related : (B,) bool
        False for photos of two places, whose matches are all wrong.
    """

    correspondences: Tensor
    true_correspondences: Tensor
    matrix: Tensor
    ratios: Tensor
    mutual: Tensor
    log_scale_ratios: Tensor
    rotations: Tensor
    mask: Tensor
    related: Tensor

    def distances(self) -> Tensor:
        """Squared symmetric epipolar distances (B, N) to the truth.

        Infinite where two places are shown, and where two photos of one place leave no epipolar geometry.
        """
        distances = symmetric_epipolar_squared(self.true_correspondences, self.matrix)
        has_geometry = self.related & (self.matrix != 0).any(-1).any(-1)
        return distances.masked_fill(~has_geometry[:, None], torch.inf)

    def inliers(self) -> Tensor:
        """Matches (B, N) that agree with the truth; False for padding."""
        return (self.distances() < INLIER_THRESHOLD) & self.mask

    def __len__(self) -> int:
        return len(self.matrix)


def concatenate(batches: Sequence[Batch]) -> Batch:
    """Join batches that have the same number of matches."""
    if len(batches) == 1:
        return batches[0]
    columns = {name: torch.cat([getattr(batch, name) for batch in batches]) for name in _BATCH_FIELDS}
    return Batch(**columns)


def side_information(batch: Batch, num_channels: int) -> Tensor | None:
    """Side information (B, N, S) as `corrsfm.prune.correspondences` lays it out; None for no channels."""
    return side_channels(batch, num_channels, torch) if num_channels else None


_BATCH_FIELDS = tuple(entry.name for entry in fields(Batch))


def generator_for(seed: int, step: int, rank: int, device: torch.device, stream: int = 0) -> torch.Generator:
    """Random generator of one step of one process; ``stream`` separates its uses."""
    words = np.random.SeedSequence([seed, step, rank, stream]).generate_state(2, np.uint32)
    return torch.Generator(device).manual_seed(int(words[0]) << 31 ^ int(words[1]))


class RealPairs:
    """Labelled pairs of compact files, kept on the device.

    Parameters
    ----------
    scenes : sequence of CompactScene or OANetPair
        Scenes of compact files, or pairs of files in OANet's layout, one after the other.
    device : torch.device
    scene_power : float
        A scene is drawn in proportion to its number of pairs to this power: 0 treats scenes alike, 1 treats
        pairs alike.
    match_input : MatchInput
        Matches to yield: all, or the mutual ones.
    negative_share : float
        Share of drawn pairs that show two places.

    Attributes
    ----------
    num_pairs : int
    inlier_ratios : (P,) tensor
    has_shapes : bool
        Whether all keypoints have scale and orientation.
    """

    def __init__(
        self,
        scenes: Sequence[CompactScene | OANetPair],
        device: torch.device,
        scene_power: float = 0.5,
        match_input: MatchInput = MatchInput.ALL,
        negative_share: float = 0.0,
    ) -> None:
        self.device = device
        names = [scene.name if isinstance(scene, CompactScene) else scene.scene for scene in scenes]
        self.scene_names = list(dict.fromkeys(names))
        number = {name: index for index, name in enumerate(self.scene_names)}
        parts: dict[str, list[np.ndarray]] = {}
        num_keys = num_matches = 0
        for name, scene in zip(names, scenes, strict=True):
            if isinstance(scene, CompactScene) and not len(scene.pairs):
                continue
            if isinstance(scene, CompactScene):
                arrays = _flatten_scene(scene, num_keys, num_matches, match_input)
            else:
                arrays = _flatten_pair(scene, num_keys, num_matches, match_input)
            arrays["scene"] = np.full(len(arrays["matrix"]), number[name])
            for key, values in arrays.items():
                parts.setdefault(key, []).append(values)
            num_keys += len(arrays["points"])
            num_matches += len(arrays["key0"])
        if not parts:
            raise InputError("no scene to train on")
        self._arrays = {
            name: torch.from_numpy(np.concatenate(values)).to(device) for name, values in parts.items()
        }
        self.num_pairs = len(self._arrays["scene"])
        self.has_shapes = not bool(self._arrays["log_scales"].isnan().any())
        self.inlier_ratios, num_inliers = self._count_inliers()
        self._weights = self._pair_weights(num_inliers, scene_power)
        if negative_share > 0:
            negatives = self._negative_weights(scene_power)
            self._weights = (1 - negative_share) * self._weights / self._weights.sum()
            self._weights += negative_share * negatives / negatives.sum()

    @classmethod
    def from_files(cls, paths: Sequence[Path], device: torch.device, **options: Any) -> RealPairs:
        """Read compact files and files in OANet's layout; the options are those of the class."""
        scenes: list[CompactScene | OANetPair] = []
        for path in paths:
            scenes.extend(read_scenes(path) if is_compact(path) else read_pairs(path))
        try:
            return cls(scenes, device, **options)
        except InputError as error:
            raise InputError(f"{first_few(map(str, paths))}: {error}") from error

    def _count_inliers(self) -> tuple[Tensor, Tensor]:
        ratios, counts = [], []
        for start in range(0, self.num_pairs, 64):
            pairs = torch.arange(start, min(start + 64, self.num_pairs), device=self.device)
            width = int(self._arrays["num_matches"][pairs].max())
            batch = self._gather(pairs, torch.arange(width, device=self.device).expand(len(pairs), -1))
            inliers = batch.inliers()
            counts.append(inliers.sum(1))
            ratios.append(inliers.sum(1) / batch.mask.sum(1).clamp(min=1))
        return torch.cat(ratios), torch.cat(counts)

    def _pair_weights(self, num_inliers: Tensor, scene_power: float) -> Tensor:
        scene = self._arrays["scene"]
        usable = num_inliers >= _MIN_INLIERS
        if not usable.any():
            raise InputError(f"no pair has {_MIN_INLIERS} inliers; check the poses of the training scenes")
        # Within a scene, the fifths of the range of inlier ratios that occur are drawn equally often.
        level = (self.inlier_ratios.clamp(max=0.999) ** 0.5 * 5).long()
        cell = scene * 5 + level
        per_cell = torch.bincount(cell[usable], minlength=5 * len(self.scene_names)).double()
        per_scene = torch.bincount(scene[usable], minlength=len(self.scene_names)).double()
        levels = (per_cell.view(-1, 5) > 0).sum(1).clamp(min=1)
        # Half of the draws follow the levels, the other half all pairs alike.
        share = 0.5 / (per_cell[cell] * levels[scene]).clamp(min=1) + 0.5 / per_scene[scene].clamp(min=1)
        return torch.where(usable, share * per_scene[scene] ** scene_power, 0.0)

    def _negative_weights(self, scene_power: float) -> Tensor:
        scene, negative = self._arrays["scene"], ~self._arrays["related"]
        # Matches, too: a network cannot read a pair of none.
        negative = negative & (self._arrays["num_matches"] >= _MIN_INLIERS)
        if not negative.any():
            raise InputError(
                "no pair of photos that share nothing, but negative_share is above 0; "
                "make some with: corrsfm train prepare --negatives"
            )
        per_scene = torch.bincount(scene[negative], minlength=len(self.scene_names)).double()
        return torch.where(negative, per_scene[scene].clamp(min=1) ** (scene_power - 1), 0.0)

    def _gather(self, pairs: Tensor, columns: Tensor, lost: Tensor | None = None) -> Batch:
        """Matches ``columns`` (B, N) of ``pairs`` (B,).

        Columns beyond a pair's matches are padding, and so are those ``lost`` (B, N).
        """
        a = self._arrays
        mask = columns < a["num_matches"][pairs][:, None]
        if lost is not None:
            mask &= ~lost
        rows = a["match_start"][pairs][:, None] + torch.where(mask, columns, 0)
        key0, key1 = a["key0"][rows].long(), a["key1"][rows].long()
        pinhole = torch.cat([a["points"][key0], a["points"][key1]], -1)
        return Batch(
            correspondences=pinhole,
            true_correspondences=pinhole + torch.cat([a["corrections"][key0], a["corrections"][key1]], -1),
            matrix=a["matrix"][pairs],
            ratios=a["ratios"][rows].float() / RATIO_STEPS,
            mutual=a["mutual"][rows].float(),
            log_scale_ratios=(a["log_scales"][key1] - a["log_scales"][key0]).float(),
            rotations=a["orientations"][key1] - a["orientations"][key0],
            mask=mask,
            related=a["related"][pairs],
        )

    def sample(
        self, num_pairs: int, num_matches: int, config: AugmentConfig, generator: torch.Generator
    ) -> Batch:
        """Draw and augment a batch of ``num_pairs`` pairs of ``num_matches`` correspondences."""
        pairs = torch.multinomial(self._weights, num_pairs, replacement=True, generator=generator)
        available = self._arrays["num_matches"][pairs]
        width = int(available.max())
        # A random order of each pair's matches, padding last. Thinning loses some inliers, which makes the
        # pair as hard as a wider baseline would.
        order = torch.rand(num_pairs, width, device=self.device, generator=generator)
        columns = torch.arange(width, device=self.device)
        lost = columns >= available[:, None]
        if config.thin_probability > 0:
            batch = self._gather(pairs, columns.expand(num_pairs, -1))
            inliers = batch.inliers()
            draw = torch.rand(num_pairs, 2, 1, device=self.device, generator=generator)
            keep = torch.where(draw[:, 0] < config.thin_probability, 0.15 + 0.85 * draw[:, 1], 1.0)
            thinned = inliers & (torch.rand(num_pairs, width, device=self.device, generator=generator) > keep)
            # A network cannot read a pair of none.
            enough = available - thinned.sum(1) >= _MIN_INLIERS
            lost = lost | (thinned & enough[:, None])
        chosen = order.masked_fill(lost, torch.inf).argsort(1)[:, :num_matches]
        batch = self._gather(pairs, chosen, lost.gather(1, chosen))
        guess = self._arrays["guess"][pairs]
        return augment(batch, guess, config, generator)


def _flatten_pair(
    pair: OANetPair, first_key: int, first_match: int, match_input: MatchInput
) -> dict[str, np.ndarray]:
    """Arrays of a pair in OANet's layout; its keypoints are those of image 0, then of image 1."""
    num = len(pair)
    zeros = np.zeros(num, np.float32)
    # YFCC100M has more keypoints than 32 bits can count.
    dtype = np.int32 if first_key + 2 * num < 2**31 else np.int64
    read = np.flatnonzero(pair.mutual) if match_input is MatchInput.MUTUAL else np.arange(num)
    rows = first_key + read
    return {
        "points": pair.correspondences.reshape(num, 2, 2).transpose(1, 0, 2).reshape(-1, 2),
        "corrections": np.zeros((2 * num, 2), np.float32),
        "log_scales": np.concatenate([zeros, pair.log_scale_ratios]).astype(np.float16),
        "orientations": np.concatenate([zeros, pair.rotations]),
        "key0": rows.astype(dtype),
        "key1": (rows + num).astype(dtype),
        "ratios": quantise_ratios(pair.ratios[read]),
        "mutual": pair.mutual[read],
        "num_matches": np.array([len(read)]),
        "related": np.array([True]),
        "match_start": np.array([first_match]),
        "guess": np.ones((1, 2), np.float32),
        "matrix": essential_from_pose(pair.rotation, pair.translation)[None].astype(np.float32),
    }


def _flatten_scene(
    scene: CompactScene, first_key: int, first_match: int, match_input: MatchInput
) -> dict[str, np.ndarray]:
    """Arrays of a scene with indices into the concatenation of all scenes."""
    images = range(len(scene.image_names))
    points = [scene.normalised(image, undistorted=False) for image in images]
    only_mutual = match_input is MatchInput.MUTUAL
    found = [scene.matched(index, only_mutual=only_mutual) for index in range(len(scene.pairs))]
    counts = np.array([len(index0) for index0, _ in found], np.int64)
    matched = [scene.match_offsets[index] + index0 for index, (index0, _) in enumerate(found)]
    rows = np.concatenate(matched) if matched else np.zeros(0, np.int64)
    key = [
        np.concatenate(
            [
                first_key + scene.keypoint_offsets[scene.pairs[index, side]] + found[index][side]
                for index in range(len(found))
            ]
        ).astype(np.int32)
        for side in (0, 1)
    ]
    matrices, guesses = [], []
    for image0, image1 in scene.pairs:
        pose = relative_pose(
            scene.rotations[image0],
            scene.translations[image0],
            scene.rotations[image1],
            scene.translations[image1],
        )
        matrices.append(essential_from_pose(*pose))
        guesses.append([_guess_factor(scene, int(image)) for image in (image0, image1)])
    return {
        "points": np.concatenate(points).astype(np.float32),
        "corrections": scene.corrections,
        "log_scales": scene.log_scales.astype(np.float16),
        "orientations": scene.orientations,
        "key0": key[0],
        "key1": key[1],
        "ratios": quantise_ratios(scene.ratios[rows]),
        "mutual": scene.mutual[rows],
        "num_matches": counts,
        "related": scene.covisible > 0,
        "match_start": first_match + np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64),
        "guess": np.array(guesses, np.float32),
        "matrix": np.array(matrices, np.float32),
    }


def _guess_factor(scene: CompactScene, image: int) -> float:
    """True focal length over the one assumed where nothing is known."""
    camera = scene.cameras[image]
    return pinhole_parameters(camera)[0] / (DEFAULT_FOCAL_FACTOR * max(camera.width, camera.height))


def augment(batch: Batch, guess: Tensor, config: AugmentConfig, generator: torch.Generator) -> Batch:
    """Change pairs into others that photos could show, truth and side information included.

    Parameters
    ----------
    batch : Batch
    guess : (B, 2) tensor
        True over assumed focal length of each image, for pairs whose intrinsics count as unknown.
    config : AugmentConfig
    generator : torch.Generator

    Returns
    -------
    Batch
    """
    device, num = batch.matrix.device, len(batch)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(num, *shape, device=device, generator=generator)

    def chance(probability: float) -> Tensor:
        return uniform() < probability

    undistort = chance(config.undistort_probability)[:, None, None]
    inputs = torch.where(undistort, batch.true_correspondences, batch.correspondences)
    # In-plane turns: quarter turns of both photos together, small ones of each.
    quarter = (
        torch.where(chance(config.quarter_turn_probability), (uniform() * 3).floor() + 1, 0.0) * torch.pi / 2
    )
    small = torch.deg2rad((2 * uniform(2) - 1) * config.max_turn_deg)
    angles = quarter[:, None] + torch.where(chance(config.turn_probability)[:, None], small, 0.0)
    mirror = torch.where(chance(config.mirror_probability), -1.0, 1.0)
    # Wrong intrinsics: the assumed focal length, or a jittered one; a shifted principal point.
    jitter = torch.exp(config.focal_jitter * torch.randn(num, 2, device=device, generator=generator))
    jitter = torch.where(chance(config.jitter_probability)[:, None], jitter, 1.0)
    focal = torch.where(chance(config.unknown_focal_probability)[:, None], guess, jitter)
    shift = config.principal_jitter * torch.randn(num, 2, 2, device=device, generator=generator)
    shift = torch.where(chance(config.jitter_probability)[:, None, None], shift, 0.0)

    transforms = _transforms(angles, mirror, focal, shift)
    points = [_apply(transforms[:, side], inputs[..., 2 * side : 2 * side + 2]) for side in (0, 1)]
    true = [
        _apply(transforms[:, side], batch.true_correspondences[..., 2 * side : 2 * side + 2])
        for side in (0, 1)
    ]
    inverse = torch.linalg.inv(transforms)
    matrix = inverse[:, 1].transpose(1, 2) @ batch.matrix @ inverse[:, 0]
    rotations = (batch.rotations + (angles[:, 1] - angles[:, 0])[:, None]) * mirror[:, None]

    swap = chance(config.swap_probability)
    flip, sign = swap[:, None, None], torch.where(swap, -1.0, 1.0)[:, None]
    return Batch(
        correspondences=torch.where(flip, torch.cat(points[::-1], -1), torch.cat(points, -1)),
        true_correspondences=torch.where(flip, torch.cat(true[::-1], -1), torch.cat(true, -1)),
        matrix=torch.where(flip, matrix.transpose(1, 2), matrix),
        ratios=batch.ratios,
        mutual=batch.mutual,
        log_scale_ratios=batch.log_scale_ratios * sign,
        rotations=rotations * sign,
        mask=batch.mask,
        related=batch.related,
    )


def _transforms(angles: Tensor, mirror: Tensor, focal: Tensor, shift: Tensor) -> Tensor:
    """Affine maps (B, 2, 3, 3) of normalised coordinates of both images: turn, mirror, scale and shift."""
    cosine, sine = angles.cos() * focal, angles.sin() * focal
    zero, one = torch.zeros_like(cosine), torch.ones_like(cosine)
    m = mirror[:, None]
    rows = [
        torch.stack([m * cosine, -m * sine, shift[..., 0]], -1),
        torch.stack([sine, cosine, shift[..., 1]], -1),
        torch.stack([zero, zero, one], -1),
    ]
    return torch.stack(rows, -2)


def _apply(transform: Tensor, points: Tensor) -> Tensor:
    """Affine maps (B, 3, 3) of points (B, N, 2)."""
    return points @ transform[:, :2, :2].transpose(1, 2) + transform[:, None, :2, 2]
