"""Where every file of a workspace lies.

::

    WORKSPACE/
    ├── workspace.json      format version, image folder, per stage fingerprint, options and seconds
    ├── frames/             frames of a video, and frames.json with their times
    ├── converted/          JPEGs of HEIC and AVIF photos, and links to the other photos
    ├── images.txt          names of the photos, one per line
    ├── images.json         photos and cameras as corrsfm knows them
    ├── features.db         keypoints and descriptors
    ├── pairs.txt           pairs to match, ``name0 name1``
    ├── pair_origins.tsv    the strategies that proposed each pair
    ├── matches.db          putative matches
    ├── pruned/METHOD.db    matches that passed pruning, for each method that was tried
    ├── .shards/            items that workers of a cluster made and that were not merged yet
    ├── cameras.json        which photos share a camera, and by what evidence
    ├── database.db         COLMAP database with verified two-view geometries
    ├── sparse/0, 1, …      models, the largest first
    ├── evidence.json       why the first model was chosen, and the verdict on it
    ├── added.json          photos that `corrsfm add` put into finished models, and what became of each
    ├── adding.json         those of an addition that has not finished
    ├── sparse.old/         models that could not be made again when others replaced them; then sparse.old.2
    ├── warnings.json       what each stage warned of
    ├── report.json, report.html
    ├── .seeds/SEED/        workspaces of further seeds, for `corrsfm compare` and `corrsfm evaluate scene`
    ├── run.json            versions, options, hashes and seconds of the last `corrsfm run`
    └── log.txt             what pycolmap had to say
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["Layout"]


class Layout:
    """The paths of a workspace.

    Parameters
    ----------
    root : Path
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.manifest = root / "workspace.json"
        self.frames = root / "frames"
        self.converted = root / "converted"
        self.images_txt = root / "images.txt"
        self.images_json = root / "images.json"
        self.photo_cache = root / ".photos.json"
        self.features = root / "features.db"
        self.pairs = root / "pairs.txt"
        self.pair_origins = root / "pair_origins.tsv"
        self.matches = root / "matches.db"
        self.shards = root / ".shards"
        self.cameras_json = root / "cameras.json"
        self.database = root / "database.db"
        self.sparse = root / "sparse"
        self.evidence = root / "evidence.json"
        self.added = root / "added.json"
        self.adding = root / "adding.json"
        self.candidates = root / ".candidates"
        self.warnings_json = root / "warnings.json"
        self.seeds = root / ".seeds"
        self.report_json = root / "report.json"
        self.report_html = root / "report.html"
        self.run_json = root / "run.json"
        self.log = root / "log.txt"
