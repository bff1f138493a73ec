"""What a scene's features and matches are: made here, or brought in by `corrsfm import`.

Imported features carry the fingerprint ``imported PHOTO CONTENT``, two hashes: they hold as long as the photo
does, and no extractor could make them again. Their file says where they came from, so that a workspace that
lost its manifest, or an import that was killed, is not taken for one that has no features yet.
"""

from __future__ import annotations

import json
import logging
import shlex
from collections.abc import Sequence
from typing import Any

from corrsfm import config as cfg
from corrsfm.config.fields import flags_of
from corrsfm.errors import ConfigError, DamageError, WorkspaceError, first_few
from corrsfm.types import Pair, PairList
from corrsfm.workspace.commands import label_of
from corrsfm.workspace.folder import Workspace
from corrsfm.workspace.lists import read_index, read_pairs, write_pairs
from corrsfm.workspace.manifest import StageRecord
from corrsfm.workspace.stores import features_of, matches_of

__all__ = [
    "drop_foreign_record",
    "fingerprint_of_imported",
    "imported_features",
    "imported_from",
    "imported_matches",
    "is_unfinished_import",
    "record_imported_pairs",
    "traits_of",
    "traits_to_come",
    "traits_with",
    "warn_of_no_effect",
]

logger = logging.getLogger("corrsfm")

_IMPORTED = "imported"


def imported_from(workspace: Workspace, stage: str) -> cfg.ImportedConfig | None:
    """Where what a stage left was imported from; None if the stage made it itself, or has nothing yet.

    Raises
    ------
    WorkspaceError
        If an import was not finished.
    """
    record = workspace.record_of(stage)
    if record is not None and "has_shapes" in record.config:
        return _source(workspace, record.config)
    # The manifest may have been lost, or be that of another workspace.
    store = features_of(workspace) if stage == "features" else matches_of(workspace)
    try:
        origin = store.origin()
    except DamageError:
        return None
    if origin is None:
        return None
    config = json.loads(origin)
    if store.seal() is None:
        command = workspace.command_for(stage, imported=config)
        raise WorkspaceError(f"{store.path}: an import was not finished; run: {command}")
    return _source(workspace, config)


def _source(workspace: Workspace, config: dict[str, Any]) -> cfg.ImportedConfig:
    return cfg.from_dict(cfg.ImportedConfig, config, str(workspace.manifest))


def drop_foreign_record(workspace: Workspace, stage: str) -> None:
    """Forget what a manifest says of a stage whose items were imported: it is that of another workspace."""
    record = workspace.record_of(stage)
    if record is None or "has_shapes" in record.config:
        return
    if imported_from(workspace, stage) is not None:
        workspace.forget(stage)


def is_unfinished_import(workspace: Workspace) -> bool:
    """Whether an import into the workspace was begun and came to no end."""
    origins = {"features": features_of(workspace).origin(), "matches": matches_of(workspace).origin()}
    return any(workspace.record_of(stage) is None and origin is not None for stage, origin in origins.items())


def fingerprint_of_imported(photo_sha256: str, content: str) -> str:
    """Fingerprint of imported features of one photo."""
    return f"{_IMPORTED} {photo_sha256} {content}"


def imported_features(workspace: Workspace) -> dict[str, str]:
    """Fingerprints of the imported features of every photo of the index.

    Raises
    ------
    WorkspaceError
        If a photo is new or has changed since the import.
    """
    records = read_index(workspace).records
    store = features_of(workspace)
    source = imported_from(workspace, "features")
    held = store.held([record.name for record in records])
    lacking = [
        record.name
        for record in records
        if not held.get(record.name, "").startswith(f"{_IMPORTED} {record.sha256} ")
    ]
    if lacking:
        command = workspace.command_for("features", imported=cfg.to_dict(source))
        raise WorkspaceError(
            f"{workspace.features}: was imported and holds no features of {first_few(lacking)}, new or "
            f"changed since; import a file that does, with: {command}; or leave these photos out with "
            "--image-list"
        )
    return {record.name: held[record.name] for record in records}


def imported_matches(workspace: Workspace) -> dict[Pair, str]:
    """Fingerprints of imported matches, which are what they are."""
    return matches_of(workspace).fingerprints(read_pairs(workspace).pairs)


def warn_of_no_effect(stage: str, config: Any, *, overwrite: bool) -> None:
    """Say which options ask in vain for other items than the imported ones."""
    flags = flags_of(type(config), cfg.to_dict(config, only_result=True))
    if overwrite:
        flags.append("--overwrite")
    if flags:
        logger.warning(
            "%s: they were imported and are kept; no effect: %s", label_of(stage), shlex.join(flags)
        )


def record_imported_pairs(
    workspace: Workspace, pairs: Sequence[Pair], source: cfg.ImportedConfig
) -> PairList:
    """Write the pairs of imported matches, sorted, and record them as made by the import."""
    pair_list = PairList(pairs=tuple(pairs), origins=tuple(("import",) for _ in pairs))
    features = workspace.require("features").fingerprint
    write_pairs(workspace, pair_list)
    workspace.finish(
        "pairs",
        StageRecord(
            fingerprint=cfg.config_hash("imported pairs", pair_list.pairs, features),
            config=cfg.to_dict(source),
            inputs={"features": features},
            num_items=len(pair_list),
        ),
    )
    return pair_list


def traits_of(workspace: Workspace) -> cfg.MatchTraits:
    """What the matches of a workspace carry."""
    matcher = cfg.Matcher(_recorded(workspace, "matches").get("matcher", cfg.Matcher.NEAREST))
    return traits_with(workspace, cfg.MatchesConfig(matcher=matcher))


def traits_with(workspace: Workspace, matches: cfg.MatchesConfig) -> cfg.MatchTraits:
    """What the matches of the features of a workspace carry; raises as `traits_to_come`."""
    extractor = cfg.Extractor(_recorded(workspace, "features").get("extractor", cfg.Extractor.OPENCV))
    return traits_to_come(workspace, cfg.FeaturesConfig(extractor=extractor), matches)


def _recorded(workspace: Workspace, stage: str) -> dict[str, Any]:
    """The options that a stage recorded; those of imported items are not among them."""
    record = workspace.record_of(stage)
    return record.config if record is not None else {}


def traits_to_come(
    workspace: Workspace | None, features: cfg.FeaturesConfig, matches: cfg.MatchesConfig
) -> cfg.MatchTraits:
    """What the matches of a run with these options will carry.

    Parameters
    ----------
    workspace : Workspace or None
        Imported features and matches in it are kept.
    features : FeaturesConfig
    matches : MatchesConfig

    Raises
    ------
    ConfigError
        If the options ask for other features or matches than the imported ones, or the matcher does not know
        the features.
    """
    own_features = imported_from(workspace, "features") if workspace else None
    own_matches = imported_from(workspace, "matches") if workspace else None
    if own_features is not None and workspace is not None:
        _refuse_others(workspace, "features", features.extractor, cfg.FeaturesConfig().extractor)
        kind, has_shapes = own_features.kind, own_features.has_shapes
    else:
        kind, has_shapes = features.extractor.kind, features.extractor.kind == cfg.FeatureKind.SIFT
    if own_matches is not None and workspace is not None:
        _refuse_others(workspace, "matches", matches.matcher, cfg.MatchesConfig().matcher)
    learned = matches.matcher == cfg.Matcher.LIGHTGLUE
    if learned and kind not in cfg.LIGHTGLUE_KINDS:
        raise ConfigError(
            f"--matcher lightglue has weights for {' and '.join(cfg.LIGHTGLUE_KINDS)}, these features are "
            f"{kind}; use --matcher nearest, or --extractor {cfg.LIGHTGLUE_KINDS[0]} in another workspace"
        )
    return cfg.MatchTraits(
        features=kind, has_shapes=has_shapes, has_ratios=own_matches is None and not learned
    )


def _refuse_others(workspace: Workspace, what: str, wanted: str, default: str) -> None:
    if wanted != default:
        raise ConfigError(
            f"{workspace.root}: its {what} were imported and are kept; for those of {wanted} choose another "
            "folder"
        )
