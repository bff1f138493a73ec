"""Options of training, a frozen dataclass for each command: the only home of a default."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from corrsfm.config import Extractor, FeatureKind, MatchInput, from_dict, option
from corrsfm.config.fields import load_toml
from corrsfm.errors import ConfigError
from corrsfm.geometry import INLIER_THRESHOLD
from corrsfm.images.cameras import DEFAULT_FOCAL_FACTOR

__all__ = [
    "NO_AUGMENTATION",
    "AugmentConfig",
    "PrepareConfig",
    "Schedule",
    "SyntheticConfig",
    "TrainConfig",
    "TrainRecipe",
    "load_recipe",
]


@dataclass(frozen=True, kw_only=True)
class PrepareConfig:
    """Photo scenes to labelled pairs."""

    extractor: Extractor = option(Extractor.OPENCV, "SIFT by OpenCV or pycolmap, or a network")
    max_features: int = option(2000, "Keypoints kept per photo, strongest first", minimum=20)
    max_image_size: int = option(
        1600, "Larger photos are scaled down to this longest side", unit="px", minimum=16
    )
    max_photos_per_scene: int = option(0, "Photos of a scene, drawn at random; 0 for all", minimum=0)
    min_covisible: int = option(10, "Fewest shared points of a pair", minimum=1)
    max_pairs_per_scene: int = option(
        0, "Most pairs of a scene, spread evenly over its range of shared points; 0 for all", minimum=0
    )
    negatives: int = option(
        0, "Most pairs of a scene that share nothing, added to learn from as all wrong", minimum=0
    )
    seed: int = option(0, "Seed of the choice of photos and pairs", minimum=0)


@dataclass(frozen=True, kw_only=True)
class AugmentConfig:
    """Random changes of real pairs."""

    swap_probability: float = option(0.5, "Exchange the two photos", minimum=0, maximum=1)
    mirror_probability: float = option(0.5, "Mirror both photos", minimum=0, maximum=1)
    quarter_turn_probability: float = option(
        0.2, "Turn both photos by the same number of quarter turns", minimum=0, maximum=1
    )
    turn_probability: float = option(0.5, "Turn each photo a little", minimum=0, maximum=1)
    max_turn_deg: float = option(15.0, "Largest small turn", unit="deg", minimum=0)
    undistort_probability: float = option(
        0.5, "Remove the lens distortion from the input", minimum=0, maximum=1
    )
    jitter_probability: float = option(
        0.4, "Jitter the focal lengths; likewise the principal points", minimum=0, maximum=1
    )
    focal_jitter: float = option(
        0.08, "Standard deviation of the logarithm of a jittered focal length", minimum=0
    )
    principal_jitter: float = option(
        0.01, "Standard deviation of a principal point in focal lengths", minimum=0
    )
    unknown_focal_probability: float = option(
        0.15,
        f"Use {DEFAULT_FOCAL_FACTOR} times the longest side as the focal length, as where nothing is known",
        minimum=0,
        maximum=1,
    )
    thin_probability: float = option(0.3, "Drop up to 85 % of the inliers", minimum=0, maximum=1)


NO_AUGMENTATION = AugmentConfig(
    **{entry.name: 0.0 for entry in fields(AugmentConfig) if entry.name.endswith("probability")}
)
"""Leaves pairs as they are."""


class Schedule(StrEnum):
    """How the learning rate falls to zero."""

    ONE_CYCLE = "one-cycle"
    COSINE = "cosine"


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """A training run."""

    train_files: tuple[Path, ...] = option((), "Compact files of the training scenes")
    val_file: Path | None = option(None, "Compact file of the validation scenes")
    output: Path = option(Path("training"), "Folder of the run: log, checkpoints")
    initial: str = option("", "Checkpoint, or name of a bundled one, whose weights the run starts from")
    features: FeatureKind = option(FeatureKind.SIFT, "Features that the pairs are of, noted in the weights")
    input: MatchInput = option(
        MatchInput.ALL, "Matches that the network reads: all nearest neighbours, or only the mutual ones"
    )
    negative_share: float = option(
        0.0, "Share of real pairs that show two places, all wrong", minimum=0, maximum=0.9
    )
    synthetic_share: float = option(0.0, "Share of synthetic pairs in a batch", minimum=0, maximum=1)
    batch_size: int = option(32, "Pairs in a batch, on each device", minimum=1)
    num_matches: int = option(2000, "Matches drawn from each pair", minimum=32)
    max_steps: int = option(60_000, "Steps of a run that is not bounded by time", minimum=1)
    max_minutes: float = option(
        0.0, "Time of the run, which then drives the schedule; 0 for no bound", minimum=0, maximum=1e6
    )
    processor_time: bool = option(
        False, "Count the time of the processor in place of a clock's: the same work beside other programs"
    )
    learning_rate: float = option(1e-3, "Largest learning rate", minimum=0, maximum=1)
    schedule: Schedule = option(Schedule.ONE_CYCLE, "Course of the learning rate; both end at zero")
    warm_up: float = option(0.05, "Share of the run in which the learning rate rises", minimum=0, maximum=1)
    weight_decay: float = option(1e-4, "Decoupled weight decay of AdamW", minimum=0)
    max_gradient_norm: float = option(1.0, "Gradients are scaled down to this length", minimum=0)
    ema_decay: float = option(
        0.999, "Decay of the moving average of the weights; 0 for none", minimum=0, maximum=1
    )
    threshold: float = option(
        INLIER_THRESHOLD, "Largest squared symmetric epipolar distance of an inlier", minimum=0
    )
    essential_start: float = option(0.05, "Share of the run without the essential loss", minimum=0, maximum=1)
    essential_weight: float = option(0.5, "Weight of the essential loss", minimum=0)
    bfloat16: bool = option(False, "Compute in bfloat16 where that is safe")
    compile: bool = option(False, "Compile the network", affects_result=False)
    scene_power: float = option(
        0.5, "A scene is drawn in proportion to its number of pairs to this power", minimum=0, maximum=10
    )
    validate_minutes: float = option(
        10.0, "Time between validations", unit="min", minimum=0, affects_result=False
    )
    val_pairs_per_scene: int = option(20, "Validation pairs of a scene", minimum=1, affects_result=False)
    checkpoint_minutes: float = option(
        5.0, "Time between checkpoints", unit="min", minimum=0, affects_result=False
    )
    log_every: int = option(
        50, "Steps between lines of the log, a minute at most", minimum=1, affects_result=False
    )
    tensorboard: bool = option(False, "Also log to TensorBoard, in the run's folder", affects_result=False)
    seed: int = option(0, "Seed of weights, batches and augmentation", minimum=0)


@dataclass(frozen=True, kw_only=True)
class SyntheticConfig:
    """Synthetic pairs."""

    min_inlier_ratio: float = option(0.03, "Smallest share of inliers", minimum=0, maximum=1)
    max_inlier_ratio: float = option(0.9, "Largest share of inliers", minimum=0, maximum=1)
    noise_px: float = option(
        0.5, "Typical keypoint noise at a focal length of 1000", unit="px", minimum=0, maximum=1000
    )


@dataclass(frozen=True, kw_only=True)
class TrainRecipe:
    """A recipe file: tables ``train``, ``augment``, ``synthetic`` and ``network`` (as `NetworkConfig`)."""

    train: TrainConfig = field(default_factory=TrainConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    synthetic: SyntheticConfig = field(default_factory=SyntheticConfig)
    network: dict[str, Any] = field(default_factory=dict)


def load_recipe(path: Path) -> TrainRecipe:
    """Read a recipe.

    Raises
    ------
    ConfigError
        If the file is missing, not TOML, or holds an unknown key or a wrong value.
    """
    values = load_toml(path, "a training recipe")
    network = values.pop("network", {})
    unknown = set(values) - {"train", "augment", "synthetic"}
    if unknown:
        raise ConfigError(
            f"{path}: unknown tables {', '.join(sorted(unknown))}; "
            "valid are train, augment, synthetic, network"
        )
    for name, table in {"network": network, **values}.items():
        if not isinstance(table, dict):
            raise ConfigError(f"{path}: '{name}' must be one table, a line [{name}] and its options below it")
    return TrainRecipe(
        train=from_dict(TrainConfig, values.get("train", {}), f"{path}: train"),
        augment=from_dict(AugmentConfig, values.get("augment", {}), f"{path}: augment"),
        synthetic=from_dict(SyntheticConfig, values.get("synthetic", {}), f"{path}: synthetic"),
        network=network,
    )
