"""The options of every stage: one frozen dataclass each, the only home of a default.

The command line is generated from these classes (a field is a flag, its metadata the help), a pipeline file
in TOML overrides them, and the hash of their values decides what a resumed run may keep. Stages take a
config at the door and hand plain arguments inwards.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from corrsfm.config.fields import LARGEST_INT, from_dict, load_toml, option
from corrsfm.config.usage import FeatureKind

__all__ = [
    "CameraMode",
    "DatabaseConfig",
    "Extractor",
    "FeaturesConfig",
    "ImagesConfig",
    "ImportedConfig",
    "Mapper",
    "Matcher",
    "MatchesConfig",
    "OperatingPoint",
    "PairStrategy",
    "PairsConfig",
    "PipelineConfig",
    "Precision",
    "PruneConfig",
    "PruneMethod",
    "ReconstructionConfig",
    "RunConfig",
    "load_pipeline",
]


class CameraMode(StrEnum):
    """Which photos share a camera."""

    AUTO = "auto"
    SINGLE = "single"
    PER_FOLDER = "per-folder"
    PER_IMAGE = "per-image"


class Extractor(StrEnum):
    """What finds and describes keypoints: two implementations of SIFT, and networks."""

    OPENCV = "opencv"
    PYCOLMAP = "pycolmap"
    ALIKED = "aliked"
    DISK = "disk"
    SUPERPOINT = "superpoint"

    @property
    def kind(self) -> FeatureKind:
        """What its features are."""
        sift = self in (Extractor.OPENCV, Extractor.PYCOLMAP)
        return FeatureKind.SIFT if sift else FeatureKind(self.value)


class Matcher(StrEnum):
    """Ways to find putative matches."""

    NEAREST = "nearest"
    LIGHTGLUE = "lightglue"


class PairStrategy(StrEnum):
    """Ways to choose which photos are matched."""

    AUTO = "auto"
    EXHAUSTIVE = "exhaustive"
    SEQUENTIAL = "sequential"
    RETRIEVAL = "retrieval"
    SPATIAL = "spatial"
    FILE = "file"
    COVISIBILITY = "covisibility"


class PruneMethod(StrEnum):
    """Ways to prune putative matches: none, classical ones, and networks."""

    NONE = "none"
    RATIO = "ratio"
    LORANSAC = "loransac"
    MAGSAC = "magsac"
    CORRADAPTOR = "corradaptor"
    CASCADE = "cascade"
    POINTCN = "pointcn"
    OANET = "oanet"
    LMCNET = "lmcnet"
    MS2DGNET = "ms2dgnet"
    CLNET = "clnet"
    PGFNET = "pgfnet"
    CONVMATCH = "convmatch"
    NCMNET = "ncmnet"
    MGNET = "mgnet"
    UMATCH = "umatch"

    @property
    def architecture(self) -> str | None:
        """The network that it asks, as `corrsfm.model.load_network` calls it; None if it asks none."""
        if self in (PruneMethod.NONE, PruneMethod.RATIO, PruneMethod.LORANSAC, PruneMethod.MAGSAC):
            return None
        return str(PruneMethod.CORRADAPTOR if self is PruneMethod.CASCADE else self)

    @property
    def bundled(self) -> str | None:
        """The name of the checkpoint that it asks if none is given; None if it asks none or needs one."""
        bundled = {"corradaptor": "small-mutual", "oanet": "small-oanet"}
        return bundled.get(self.architecture or "")


class OperatingPoint(StrEnum):
    """How strict the learned pruner is."""

    SFM = "sfm"
    POSE = "pose"


class Precision(StrEnum):
    """Number formats of the network."""

    AUTO = "auto"
    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"


class Mapper(StrEnum):
    """pycolmap's mapping pipelines."""

    INCREMENTAL = "incremental"
    GLOBAL = "global"
    HIERARCHICAL = "hierarchical"


@dataclass(frozen=True, kw_only=True)
class ImagesConfig:
    """Which photos, and what is known about their cameras."""

    image_list: Path | None = option(None, "Text file with one photo name per line; only these are used")
    mask_dir: Path | None = option(
        None, "Folder of masks named like the photos plus '.png'; zero means ignore"
    )
    camera_mode: CameraMode = option(
        CameraMode.AUTO,
        "Which photos share a camera; auto groups equal size, make, model and focal length, and photos of "
        "one size without EXIF unless their matches object",
    )
    camera_model: str = option("SIMPLE_RADIAL", "COLMAP camera model")
    skip_unreadable: bool = option(False, "Go on without photos that cannot be read instead of stopping")
    camera_params: str = option("", "Known intrinsics as comma-separated numbers in COLMAP's order")
    frames: int = option(
        0,
        "Frames taken from a video, the sharpest of as many stretches of equal motion; 0 for as many as its "
        "motion asks for, up to 300",
        minimum=0,
    )
    every: str = option(
        "", "From a video the sharpest frame of each stretch of this time, such as 0.5s, where it moves"
    )


_SIFT = ("extractor", (Extractor.OPENCV, Extractor.PYCOLMAP))
_SUPERPOINT = ("extractor", (Extractor.SUPERPOINT,))


@dataclass(frozen=True, kw_only=True)
class FeaturesConfig:
    """Keypoints and descriptors."""

    extractor: Extractor = option(
        Extractor.OPENCV,
        "SIFT by OpenCV or pycolmap, or a network: aliked and disk need the extra learned-features, "
        "superpoint weights of yours",
    )
    max_features: int = option(4096, "Keypoints kept per photo, strongest first", minimum=1)
    max_image_size: int = option(
        1600, "Larger photos are scaled down to this longest side", unit="px", minimum=16
    )
    root_sift: bool = option(True, "Hellinger-normalise descriptors (RootSIFT)", used_with=_SIFT)
    # The checksum of the file is part of what decides about equal features, not its path.
    superpoint_weights: Path | None = option(
        None,
        "SuperPoint's published state dict, such as superpoint_v1.pth",
        affects_result=False,
        used_with=_SUPERPOINT,
    )


@dataclass(frozen=True, kw_only=True)
class ImportedConfig:
    """Features or matches of another tool, in place of the options of the stage that makes them."""

    features: Path | None = option(None, "File of hloc that the features came from")
    matches: Path | None = option(None, "File of hloc that the matches came from")
    database: Path | None = option(None, "COLMAP database that both came from")
    kind: FeatureKind = option(FeatureKind.OTHER, "What the features are")
    has_shapes: bool = option(False, "Whether keypoints came with scale and orientation")


_SEQUENTIAL = ("pairing", (PairStrategy.SEQUENTIAL, PairStrategy.AUTO))
_SPATIAL = ("pairing", (PairStrategy.SPATIAL,))
_FILE = ("pairing", (PairStrategy.FILE, PairStrategy.AUTO))
_COVISIBILITY = ("pairing", (PairStrategy.COVISIBILITY, PairStrategy.AUTO))


@dataclass(frozen=True, kw_only=True)
class PairsConfig:
    """Which photos are matched with each other."""

    pairing: tuple[PairStrategy, ...] = option(
        (PairStrategy.AUTO,),
        "How photos are paired; give it several times for the union. auto: what --pairs-file or "
        "--covisible-model say if given, else neighbours in time and loops of a video, else exhaustive up to "
        "200 photos, then retrieval",
    )
    sequential_overlap: int = option(
        10, "Neighbours on each side in natural name order", minimum=1, used_with=_SEQUENTIAL
    )
    sequential_quadratic: bool = option(False, "Also pair photos 2, 4, 8 … apart", used_with=_SEQUENTIAL)
    loop_closure: bool = option(False, "Add retrieval pairs to a sequence, to close loops")
    num_retrieved: int = option(30, "Most similar photos paired with each photo", minimum=1)
    num_spatial: int = option(
        30, "Nearest photos by GPS paired with each photo", minimum=1, used_with=_SPATIAL
    )
    max_distance_m: float = option(150.0, "Farthest GPS neighbour", unit="m", above=0, used_with=_SPATIAL)
    pairs_file: Path | None = option(
        None, "Text file with 'name0 name1' per line, for the strategy file", used_with=_FILE
    )
    covisible_model: Path | None = option(
        None, "COLMAP model folder, for the strategy covisibility", used_with=_COVISIBILITY
    )
    num_covisible: int = option(
        30, "Photos with most shared points paired with each photo", minimum=1, used_with=_COVISIBILITY
    )


@dataclass(frozen=True, kw_only=True)
class MatchesConfig:
    """Putative matches."""

    matcher: Matcher = option(
        Matcher.NEAREST,
        "Nearest neighbours of descriptors, or LightGlue, which needs the extra learned-features and the "
        "features of aliked or disk",
    )
    block_size: int = option(
        4096, "Descriptors compared at a time; bounds memory", minimum=64, affects_result=False
    )


_NETWORK = ("method", tuple(method for method in PruneMethod if method.architecture))
_ESTIMATOR = ("method", (PruneMethod.LORANSAC, PruneMethod.MAGSAC))
_RATIO = ("method", (PruneMethod.RATIO, PruneMethod.LORANSAC, PruneMethod.MAGSAC, PruneMethod.CASCADE))


@dataclass(frozen=True, kw_only=True)
class PruneConfig:
    """Pruning of putative matches."""

    # The best on the validation scenes, see results/pose_val_scenes.json.
    method: PruneMethod = option(
        PruneMethod.CORRADAPTOR,
        "How putative matches are pruned: none to magsac without a network, corradaptor, cascade and oanet "
        "with a bundled one, all others with a network of yours (--model)",
    )
    model: Path | None = option(
        None,
        "Network checkpoint, or name of a bundled one; if not given, small-mutual, or for oanet small-oanet, "
        "both for SIFT",
        used_with=_NETWORK,
    )
    operating_point: OperatingPoint = option(
        OperatingPoint.SFM,
        "sfm keeps what mapping can use; pose is strict, for two-view poses",
        used_with=_NETWORK,
    )
    # With ALIKED a ratio of 0.8 costs 7 points of AUC@5, see results/pose_val_aliked.json.
    max_ratio: float | None = option(
        None,
        "Largest descriptor distance ratio of the ratio test; if not given 0.8 for SIFT, and mutual matches "
        "without a ratio test for other features",
        above=0,
        used_with=_RATIO,
    )
    max_error_px: float = option(
        4.0, "Inlier threshold of the robust estimators", unit="px", above=0, used_with=_ESTIMATOR
    )
    max_candidates: int = option(
        2000,
        "Matches per pair that the network sees, of the kind that it reads, best ratio first",
        minimum=16,
        used_with=_NETWORK,
    )
    precision: Precision = option(
        Precision.AUTO,
        "Number format of the network; auto is bfloat16 where it is faster",
        used_with=_NETWORK,
    )
    max_batch_matches: int = option(
        16000,
        "Matches in one network batch, padding included; bounds memory",
        minimum=16,
        affects_result=False,
        used_with=_NETWORK,
    )


@dataclass(frozen=True, kw_only=True)
class DatabaseConfig:
    """Geometric verification inside the COLMAP database."""

    min_num_inliers: int = option(15, "Fewest verified matches of a pair that mapping may use", minimum=1)
    verification_error_px: float = option(
        0.0,
        "Inlier threshold of the verification; 0 for 2 px with photos of up to 1,000 px, more with larger "
        "ones, at most COLMAP's 4 px",
        unit="px",
        minimum=0,
    )
    write_descriptors: bool = option(False, "Also write descriptors, for tools that need them")


_INCREMENTAL = ("mapper", (Mapper.INCREMENTAL,))


@dataclass(frozen=True, kw_only=True)
class ReconstructionConfig:
    """Mapping by pycolmap."""

    mapper: Mapper = option(Mapper.INCREMENTAL, "Mapping pipeline")
    max_models_tried: int = option(
        24,
        "Models mapped at most before one is chosen; further ones are tried only if the first does not "
        "explain the matches; 1 takes the first as it comes",
        minimum=1,
        used_with=_INCREMENTAL,
    )
    unfold: bool = option(
        True,
        "Map again without the pairs that fold a model by repeated structure, where it betrays itself",
        used_with=_INCREMENTAL,
    )
    join_models: bool = option(
        True,
        "Try to join several models; a joined one is kept if enough points agree on how its parts lie to "
        "each other, and it explains and predicts what they did",
    )
    min_model_size: int = option(3, "Smallest model worth keeping beside the first", unit="photos", minimum=2)
    multiple_models: bool = option(True, "Keep several models when the photos do not connect")
    refine_intrinsics: bool = option(
        True,
        "Estimate focal lengths and distortion; otherwise those of --camera-params or EXIF are kept",
    )
    refine_principal_point: bool = option(False, "Also estimate the principal point")
    snapshot_every: int = option(
        0, "Registered photos between snapshots; 0 for none", minimum=0, affects_result=False
    )
    max_runtime_minutes: float = option(
        0.0,
        "Stop mapping after this time and keep the models made so far; 0 for no limit",
        minimum=0,
        maximum=LARGEST_INT // 60,
    )


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """How to run, rather than what to compute."""

    seed: int = option(0, "Seed of everything random", minimum=0)
    device: str = option("auto", "auto, cpu, cuda or cuda:N", affects_result=False)
    threads: int = option(0, "Threads to use; 0 for all cores", minimum=0, maximum=1024, affects_result=False)
    verify: bool = option(
        False, "Read finished features and matches and make damaged ones again", affects_result=False
    )
    cluster: str | None = option(
        None,
        "Address of a Dask scheduler whose workers extract, match and prune; they see the same files",
        affects_result=False,
    )
    workers: int = option(
        0,
        "Extract, match and prune in so many processes instead",
        minimum=0,
        maximum=1024,
        affects_result=False,
    )


@dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """All stages of a run; each field is a table of a pipeline file."""

    images: ImagesConfig = field(default_factory=ImagesConfig)
    features: FeaturesConfig = field(default_factory=FeaturesConfig)
    pairs: PairsConfig = field(default_factory=PairsConfig)
    matches: MatchesConfig = field(default_factory=MatchesConfig)
    prune: PruneConfig = field(default_factory=PruneConfig)
    database: DatabaseConfig = field(default_factory=DatabaseConfig)
    reconstruction: ReconstructionConfig = field(default_factory=ReconstructionConfig)
    run: RunConfig = field(default_factory=RunConfig)


def load_pipeline(path: Path) -> PipelineConfig:
    """Read a pipeline file.

    Raises
    ------
    ConfigError
        If the file is missing, not TOML, or holds a key or value that does not exist.
    """
    return from_dict(PipelineConfig, load_toml(path, "a pipeline file"), str(path))
