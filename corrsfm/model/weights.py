"""Checkpoints of the network: load, save, verify.

A checkpoint is one file that `torch.load` reads with ``weights_only=True``::

    {"format": "corrsfm-network-1",
     "config": {...},         the fields of `NetworkConfig`
     "state_dict": {...},     parameters and running statistics, in float32 or half precision
     "usage": {...},          the fields of `NetworkUsage`; defaults if missing, and for published formats
     "provenance": {...}}     plain values: data, licence, steps, seed, scores, ...

The published formats load as well: of CorrAdaptor and of its rivals, tensors under ``state_dict`` or
``model`` or bare, names perhaps behind ``module.``; PointCN's TensorFlow arrays as an ``.npz``. Bundled
checkpoints lie beside this file and are listed in `REGISTRY`; their hash is checked at every loading.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_origin, get_type_hints, overload

import torch
from torch import Tensor, nn

from corrsfm.config import NetworkUsage, PruneMethod, from_dict, to_dict
from corrsfm.errors import CheckpointError, ConfigError
from corrsfm.files import atomic_path, sha256_of
from corrsfm.model.network import CorrAdaptor, NetworkConfig
from corrsfm.model.published import from_published
from corrsfm.model.rivals import ARCHITECTURES, Rival, RivalConfig, build_rival
from corrsfm.model.rivals.checkpoints import (
    from_published_rival,
    numbers_allowed,
    overlap,
    read_arrays,
    recognise,
    tensors_of,
)

__all__ = [
    "DEFAULT_CHECKPOINTS",
    "FORMAT",
    "REGISTRY",
    "BundledCheckpoint",
    "build_network",
    "checkpoint_sha256",
    "fill_network",
    "load_network",
    "read_provenance",
    "save_network",
]

FORMAT = "corrsfm-network-1"

CORRADAPTOR = "corradaptor"

# Networks share names with their ancestors; a file with fewer in common than this is of none of them.
SMALLEST_OVERLAP = 0.5

# Of any number in a configuration: a hostile one may ask for a network larger than all memory.
_LARGEST_OPTION = 4096

CHECKPOINT_DIR = Path(__file__).parent / "checkpoints"


@dataclass(frozen=True, kw_only=True)
class BundledCheckpoint:
    """A checkpoint that comes with the package; its model card says more."""

    name: str
    """How users refer to it."""
    file: str
    """File name below ``corrsfm/model/checkpoints``."""
    sha256: str
    """Hash of the file."""
    config: NetworkConfig | RivalConfig
    """Architecture."""
    licence: str
    """Licence of the weights."""
    training_data: str
    """What it was trained on."""
    score: str
    """Measured result, with the data it was measured on."""

    @property
    def architecture(self) -> str:
        """The network, as `load_network` calls it."""
        return self.config.architecture if isinstance(self.config, RivalConfig) else CORRADAPTOR


_SMALL = NetworkConfig(
    channels=32,
    clusters=48,
    neighbors=(6, 3),
    heads=2,
    mlp_ratio=2,
    motion_stacking=1,
    oa_filters=1,
    side_channels=5,
)

REGISTRY: dict[str, BundledCheckpoint] = {
    row.name: row
    for row in (
        BundledCheckpoint(
            name="small-mutual",
            file="small-mutual.pt",
            sha256="9ce2716b19095a16a456d76b62b12687ebe1acb5c68963efa3b50cc26fc711c4",
            config=_SMALL,
            licence="Apache-2.0",
            training_data="5,873 pairs of 54 photo scenes with COLMAP poses; the model card names them",
            score="AUC@5° 75.0 against 69.2 of ratio + mutual, 240 validation pairs, 4,096 keypoints",
        ),
        BundledCheckpoint(
            name="small-aliked",
            file="small-aliked.pt",
            sha256="c07c5a74c003691b98d90089bb75ef07c8b0c8ed2b99519e773ceae17859ca2e",
            config=dataclasses.replace(_SMALL, side_channels=2),
            licence="Apache-2.0",
            training_data="1,882 pairs of 54 photo scenes with COLMAP poses; the model card names them",
            score="AUC@5° 49.7 against 51.3 of mutual and 44.3 of ratio + mutual, 135 validation pairs",
        ),
        BundledCheckpoint(
            name="small-oanet",
            file="small-oanet.pt",
            sha256="87bdb992d1262d5f1c3cf39cd7c5c59511e0a5a4d32366abb3dfaa1d92ab8e02",
            config=RivalConfig(architecture="oanet", channels=32, clusters=48, side_channels=5),
            licence="Apache-2.0",
            training_data="pairs of 54 photo scenes with COLMAP poses; the model card says which",
            score="AUC@5° 72.7 against 68.9 of ratio + mutual, 240 validation pairs, 4,096 keypoints",
        ),
    )
}
"""Bundled checkpoints by name."""

DEFAULT_CHECKPOINTS = {
    str(method): method.bundled for method in PruneMethod if method.bundled and method.architecture == method
}
"""Architecture → name of the checkpoint that is loaded for it by default."""


def build_network(config: NetworkConfig | RivalConfig) -> CorrAdaptor | Rival:
    """The network that a configuration describes, with fresh weights; it keeps it as ``config``."""
    return build_rival(config) if isinstance(config, RivalConfig) else CorrAdaptor.from_config(config)


@overload
def load_network(
    path: Path | str | None = None,
    *,
    architecture: Literal["corradaptor"],
    map_location: str | torch.device = "cpu",
) -> CorrAdaptor: ...


@overload
def load_network(
    path: Path | str | None = None,
    architecture: str | None = None,
    *,
    map_location: str | torch.device = "cpu",
) -> Any: ...


def load_network(
    path: Path | str | None = None,
    architecture: str | None = None,
    *,
    map_location: str | torch.device = "cpu",
) -> Any:
    """Network with the weights of a checkpoint, in evaluation mode, float32: a `CorrAdaptor` or a `Rival`.

    Parameters
    ----------
    path : path or str, optional
        A checkpoint of any format, or the name of a bundled one. The bundled one of the architecture if not
        given, which is then ``corradaptor`` by default.
    architecture : str, optional
        Refuse any other network: ``corradaptor`` or one of `corrsfm.model.rivals.ARCHITECTURES`. Recognised
        from the tensors' names where it is not given.
    map_location : str or torch.device
        Device of its parameters.

    Raises
    ------
    CheckpointError
        If the file is missing, damaged, of another format or of another network, or none of this network is
        bundled; missing and unexpected keys are listed. If a bundled file is not the one that was released.
    ConfigError
        If there is no such architecture.
    """
    if architecture not in (None, CORRADAPTOR, *ARCHITECTURES):
        raise ConfigError(
            f"architecture is {architecture!r}, expected one of {', '.join([CORRADAPTOR, *ARCHITECTURES])}"
        )
    file, released_sha256 = _locate(path, architecture)
    content = _read(file, map_location, expected_sha256=released_sha256)
    state: Any
    network: CorrAdaptor | Rival
    if content.get("format") == FORMAT:
        config, state = _read_config(content.get("config"), file), content.get("state_dict")
        found = config.architecture if isinstance(config, RivalConfig) else CORRADAPTOR
        network = build_network(config)
    elif "format" in content:
        raise CheckpointError(
            f"{file}: format {content['format']!r}, expected {FORMAT!r}; try a newer corrsfm"
        )
    else:
        state = tensors_of(content)
        found = CORRADAPTOR if state is None else _recognise(state, file)
        if state is not None and found == CORRADAPTOR:
            network, state = CorrAdaptor.from_config(NetworkConfig()), from_published(state)
        elif state is not None:
            network, state = from_published_rival(state, found)
    if not isinstance(state, Mapping):
        raise CheckpointError(
            f"{file}: holds no 'state_dict'; expected a checkpoint of corrsfm or the published code"
        )
    if architecture not in (None, found):
        raise CheckpointError(
            f"{file}: holds the network {found}, expected {architecture}; --method {found} reads it"
        )
    fill_network(network.to(map_location), state, f"{file}: not a checkpoint of this network ({found})")
    if "usage" in content:
        network.usage = _read_usage(content["usage"], file)
    return network.eval()


def save_network(
    network: CorrAdaptor | Rival,
    path: Path | str,
    *,
    provenance: Mapping[str, Any] | None = None,
    half: bool = False,
) -> str:
    """Write a checkpoint.

    Parameters
    ----------
    network : CorrAdaptor or Rival
        Built by `build_network`. Its ``usage`` is written, too.
    path : path or str
        Replaced in one step if it exists.
    provenance : mapping of plain values, optional
        Where the weights come from.
    half : bool
        Store weights in half precision, half the size; running statistics stay in single precision.

    Returns
    -------
    str
        Hex SHA-256 of the file, for the registry.
    """
    if network.config is None:
        raise CheckpointError(f"{path}: the network has no configuration; build it with build_network")
    state = {}
    for name, value in network.state_dict().items():
        value = value.detach().cpu()
        if half and value.is_floating_point() and "running_" not in name:
            value = value.half()
        state[name] = value.contiguous()
    content = {
        "format": FORMAT,
        "config": dataclasses.asdict(network.config),
        "state_dict": state,
        # Through JSON, because a checkpoint holds plain values only, no choices of ours.
        "usage": json.loads(json.dumps(to_dict(network.usage))),
        "provenance": dict(provenance or {}),
    }
    with atomic_path(Path(path)) as unfinished:
        torch.save(content, unfinished)
    return sha256_of(Path(path))


def read_provenance(path: Path | str | None = None) -> dict[str, Any]:
    """Where the weights of a corrsfm checkpoint come from; empty for one in the published format."""
    file, released_sha256 = _locate(path)
    provenance = _read(file, "cpu", expected_sha256=released_sha256).get("provenance", {})
    if not isinstance(provenance, dict):
        raise CheckpointError(
            f"{file}: its provenance is a {type(provenance).__name__}, expected a dictionary"
        )
    return provenance


def checkpoint_sha256(path: Path | str | None = None, architecture: str | None = None) -> str:
    """Hash of a checkpoint, given as for `load_network`.

    Raises
    ------
    CheckpointError
        If the checkpoint does not exist.
    """
    file, released_sha256 = _locate(path, architecture)
    return released_sha256 or sha256_of(file)


def _locate(path: Path | str | None, architecture: str | None = None) -> tuple[Path, str | None]:
    """File of a checkpoint, and the hash that it was released with if it is a bundled one."""
    if path is None:
        path = DEFAULT_CHECKPOINTS.get(architecture or CORRADAPTOR)
        if path is None:
            raise CheckpointError(f"no weights of the network {architecture} come with corrsfm; give a file")
    bundled = REGISTRY.get(str(path))
    file = CHECKPOINT_DIR / bundled.file if bundled else Path(str(path))
    if not file.is_file():
        names = ", ".join(REGISTRY)
        raise CheckpointError(
            f"{file}: no such checkpoint; expected a file or the name of a bundled one ({names})"
        )
    return file, bundled.sha256 if bundled else None


def _read(file: Path, map_location: str | torch.device, *, expected_sha256: str | None) -> dict[str, Any]:
    """The dictionary in a checkpoint file."""
    if expected_sha256 is not None and (found := sha256_of(file)) != expected_sha256:
        raise CheckpointError(
            f"{file}: SHA-256 is {found}, expected {expected_sha256}; the file is damaged: reinstall corrsfm"
        )
    if file.suffix == ".npz":
        return dict(read_arrays(file))
    try:
        with numbers_allowed():
            content = torch.load(file, map_location=map_location, weights_only=True)
    except OSError as error:
        raise CheckpointError(f"{file}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # torch may raise anything on a file that is not a checkpoint
        # Do not show torch's text: it suggests running the code that the file holds.
        forbidden = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        reason = f"holds {forbidden[1]}" if forbidden else "is damaged, or another kind of file"
        raise CheckpointError(
            f"{file}: not a checkpoint that can be read safely (it {reason}); expected one of corrsfm or the "
            "published code, with tensors and plain values only"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(
            f"{file}: holds a {type(content).__name__}, expected a dictionary with a 'state_dict'"
        )
    return content


def _recognise(state: Mapping[str, Any], file: Path) -> str:
    """The architecture of a published state dict."""
    rival, share = recognise(state)
    with torch.device("meta"):
        own = CorrAdaptor.from_config(NetworkConfig()).state_dict()
    own_share = overlap(own, from_published(state))
    if max(share, own_share) < SMALLEST_OVERLAP:
        names = sorted(state)
        more = "" if len(names) <= 10 else f" and {len(names) - 10} more"
        raise CheckpointError(
            f"{file}: no network that corrsfm knows has these {len(names)} unexpected keys: "
            f"{', '.join(names[:10])}{more}; it knows {', '.join([CORRADAPTOR, *ARCHITECTURES])}"
        )
    return CORRADAPTOR if own_share >= share else rival


def _read_config(values: Any, file: Path) -> NetworkConfig | RivalConfig:
    if not isinstance(values, dict):
        raise CheckpointError(f"{file}: holds no network configuration")
    described = RivalConfig if "architecture" in values else NetworkConfig
    known = [field.name for field in dataclasses.fields(described)]
    unknown = [str(name) for name in values if name not in known]
    if unknown:
        raise CheckpointError(
            f"{file}: unknown network options {', '.join(unknown)}; valid are {', '.join(known)}"
        )
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    kinds = get_type_hints(described)
    if strange := [name for name, value in values.items() if not _is_plausible(value, kinds[name])]:
        described_values = ", ".join(f"{name} is {str(values[name])[:40]}" for name in strange)
        raise CheckpointError(f"{file}: impossible network options: {described_values}")
    try:
        return described(**values)
    except (ConfigError, TypeError) as error:
        raise CheckpointError(f"{file}: {error}") from error


def _is_plausible(value: Any, kind: Any) -> bool:
    """Whether an option has the type of its field, and a size of which a network can be built."""
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_is_plausible(item, int) for item in value)
    if get_origin(kind) in (Union, UnionType):
        return value is None or _is_plausible(value, int)
    if kind is int:
        return type(value) is int and abs(value) <= _LARGEST_OPTION
    if kind is float:
        return type(value) in (int, float)
    return isinstance(value, bool if kind is bool else str)


def _read_usage(values: Any, file: Path) -> NetworkUsage:
    if not isinstance(values, dict):
        raise CheckpointError(f"{file}: its usage is a {type(values).__name__}, expected a dictionary")
    try:
        return from_dict(NetworkUsage, values, f"{file}: usage")
    except ConfigError as error:
        raise CheckpointError(str(error)) from error


def fill_network(network: nn.Module, state: Mapping[str, Any], complaint: str) -> None:
    """Copy a state dict into a network; names and shapes must match exactly.

    Parameters
    ----------
    network : Module
    state : mapping
        As it was read from a file: names to whatever was stored.
    complaint : str
        Begins the message if it does not fit.

    Raises
    ------
    CheckpointError
        Naming every difference.
    """
    own = network.state_dict()
    problems = []
    for title, names in [("missing", own.keys() - state.keys()), ("unexpected", state.keys() - own.keys())]:
        if names:
            problems.append(f"{len(names)} {title} keys: {', '.join(sorted(map(str, names)))}")
    for name in sorted(own.keys() & state.keys()):
        shape = tuple(getattr(state[name], "shape", ()))
        if not isinstance(state[name], Tensor):
            problems.append(f"{name} is not a tensor")
        elif shape != tuple(own[name].shape):
            problems.append(f"{name} has shape {shape}, expected {tuple(own[name].shape)}")
        elif not _holds_numbers_like(state[name], own[name]):
            problems.append(f"{name} is not a plain tensor of {_kind(own[name])} numbers")
        elif not state[name].isfinite().all():
            problems.append(f"{name} holds values that are not finite")
    if problems:
        raise CheckpointError(f"{complaint}: " + "; ".join(problems))
    network.load_state_dict(dict(state), strict=True)


def _holds_numbers_like(values: Tensor, expected: Tensor) -> bool:
    """Whether values are there, dense, and of the kind that the network counts with."""
    return (
        values.layout is torch.strided
        and values.device.type != "meta"
        and not values.is_quantized
        and _kind(values) == _kind(expected)
    )


def _kind(values: Tensor) -> str:
    return "complex" if values.is_complex() else "real" if values.is_floating_point() else "whole"
