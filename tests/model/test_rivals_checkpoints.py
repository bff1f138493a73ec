"""Checkpoints of the rivals: published ones are recognised, everything else is refused with the reason."""

import functools
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from published_weights import published_state

from corrsfm.errors import CheckpointError, ConfigError
from corrsfm.model import CorrAdaptor, NetworkConfig, load_network, read_provenance, save_network
from corrsfm.model.rivals import ARCHITECTURES, Rival, RivalConfig, build_rival
from corrsfm.model.rivals.lmcnet import LMCNet

every_rival = pytest.mark.parametrize("architecture", ARCHITECTURES)


def published_form(network: Rival) -> dict[str, torch.Tensor]:
    """A network's tensors as the published code stores them: its linear layers are convolutions."""
    wide = re.compile(r"\b(sce\d+|embed_0\.4)\.conv\.[03]\.weight$")
    state = {}
    for name, value in network.state_dict().items():
        if value.ndim == 2 and wide.search(name):  # (out, width * in) of an annular convolution
            width = 3 if value.shape[1] == 6 * value.shape[0] or ".3." not in name else None
            width = width or value.shape[1] // value.shape[0]
            value = value.unflatten(1, (width, -1)).transpose(1, 2)[:, :, None].contiguous()
        elif value.ndim == 2:
            value = value[:, :, None, None]
        state[name] = value
    return state


def tensorflow_form(network: Rival) -> dict[str, np.ndarray]:
    """PointCN's tensors as the published checkpoint names them, with what its optimiser keeps beside them."""
    arrays = {}
    for name, value in network.state_dict().items():
        if name.endswith("num_batches_tracked"):
            continue
        place, _, kind = name.rpartition(".")
        if place in ("input", "output"):
            prefix = "Matchnet/hidden-input" if place == "input" else "Matchnet/output"
        else:
            _, block, unit, layer = place.split(".")
            prefix = f"Matchnet/hidden-{block}/conv-branch/conv{int(unit) + 1}"
        names = {
            "weight": "self-conv/weights",
            "bias": "self-conv/biases",
            "running_mean": "bn/batch_normalization/moving_mean",
            "running_var": "bn/batch_normalization/moving_variance",
        }
        arrays[f"{prefix}/{names[kind]}"] = (
            value.mT[None, None].numpy() if kind == "weight" else value.numpy()
        )
    arrays["Matchnet/output/self-conv/weights/Adam"] = np.zeros((1, 1, 128, 1), np.float32)
    arrays["Matchnet/hidden-3/conv-branch/conv1/bn/batch_normalization/gamma"] = np.ones(128, np.float32)
    arrays["beta1_power"] = np.float32(0.9)
    return arrays


@functools.cache
def published_rival(architecture: str, **options: int) -> Rival:
    """A network with fresh weights, for reading only."""
    torch.manual_seed(0)
    return build_rival(RivalConfig(architecture=architecture, **options))


def assert_same_state(one: torch.nn.Module, other: torch.nn.Module) -> None:
    expected = other.state_dict()
    assert one.state_dict().keys() == expected.keys()
    for name, value in one.state_dict().items():
        assert torch.equal(value, expected[name]), name


@every_rival
def test_published_checkpoint_is_recognised(architecture, tmp_path):
    network, path = published_rival(architecture), tmp_path / "model_best.pth"
    behind_module = {f"module.{name}": value for name, value in published_form(network).items()}
    torch.save({"epoch": 7, "state_dict": behind_module}, path)
    loaded = load_network(path)
    assert type(loaded) is ARCHITECTURES[architecture]
    assert loaded.config == RivalConfig(architecture=architecture)
    assert not loaded.training
    assert_same_state(loaded, network)


@pytest.mark.parametrize("key", ["state_dict", "model", "network_state_dict", None])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_tensors_are_found_where_published_checkpoints_keep_them(key, prefix, tmp_path):
    network, path = published_rival("clnet"), tmp_path / "model_best.pth"
    state = {prefix + name: value for name, value in published_form(network).items()}
    torch.save(state if key is None else {"epoch": 7, key: state}, path)
    assert_same_state(load_network(path), network)
    assert read_provenance(path) == {}


@every_rival
def test_saved_network_of_any_size_loads_as_what_it_is(architecture, tmp_path):
    sizes = {"channels": 32, "side_channels": 3}
    if architecture in ("oanet", "mgnet"):
        sizes["clusters"] = 7
    network, path = published_rival(architecture, **sizes), tmp_path / "network.pt"
    save_network(network, path, provenance={"steps": 5})
    for loaded in (load_network(path), load_network(path, architecture)):
        assert loaded.config == RivalConfig(architecture=architecture, **sizes)
        assert_same_state(loaded, network)
    assert read_provenance(path) == {"steps": 5}


def test_lmcnet_with_all_features_is_recognised(tmp_path):
    network, path = published_rival("lmcnet", side_channels=136), tmp_path / "model_best.pth"
    torch.save({"network_state_dict": published_form(network)}, path)
    loaded = load_network(path)
    assert isinstance(loaded, LMCNet)
    assert loaded.side_channels == 136
    assert_same_state(loaded, network)


def test_tensorflow_arrays_of_pointcn_load(tmp_path):
    network, path = published_rival("pointcn"), tmp_path / "pointcn.npz"
    np.savez(path, **tensorflow_form(network))
    loaded = load_network(path)
    assert loaded.config == RivalConfig(architecture="pointcn")
    assert_same_state(loaded, network)


def test_checkpoint_of_corradaptor_is_still_recognised(shared_dir, tmp_path):
    path = tmp_path / "model_best.pth"
    torch.save({"model": published_state(shared_dir / "parity" / "published_network_state_dict.txt")}, path)
    for loaded in (load_network(path), load_network(path, "corradaptor")):
        assert isinstance(loaded, CorrAdaptor)
        assert loaded.config == NetworkConfig()


@every_rival
def test_listed_tensors_are_recognised(shared_dir, architecture, tmp_path):
    state = {}
    for line in (shared_dir / f"parity/rivals/{architecture}_state_dict.txt").read_text().splitlines():
        name, text = line.split()
        shape = [] if text == "scalar" else [int(size) for size in text.split("x")]
        state[name] = torch.zeros(shape, dtype=torch.int64 if "num_batches" in name else torch.float32)
    path = tmp_path / "model_best.pth"
    torch.save(state, path)
    assert load_network(path).config == RivalConfig(architecture=architecture)


@pytest.mark.parametrize(
    ("architecture", "unused"),
    [("pgfnet", "weights_init.pretrain_conv1.0.weight"), ("ms2dgnet", "weights_init.att1_1.conv11.weight")],
)
def test_tensors_that_nothing_uses_are_dropped(architecture, unused, tmp_path):
    state, path = published_form(published_rival(architecture)), tmp_path / "model_best.pth"
    torch.save({"state_dict": {**state, unused: torch.zeros(3)}}, path)
    assert load_network(path).config == RivalConfig(architecture=architecture)


@every_rival
def test_missing_and_unexpected_tensors_are_listed(architecture, tmp_path):
    state, path = published_form(published_rival(architecture)), tmp_path / "model_best.pth"
    missing = max(name for name in state if name.endswith("bias"))
    state["module.surprise"] = state.pop(missing)
    torch.save({"state_dict": state}, path)
    with pytest.raises(CheckpointError) as error:
        load_network(path)
    assert f"{path}: not a checkpoint of this network ({architecture})" in str(error.value)
    assert f"1 missing keys: {missing}" in str(error.value)
    assert "1 unexpected keys: surprise" in str(error.value)


@every_rival
def test_published_checkpoint_of_another_width_is_refused(architecture, tmp_path):
    path = tmp_path / "model_best.pth"
    torch.save({"state_dict": published_form(published_rival(architecture, channels=32))}, path)
    with pytest.raises(CheckpointError, match=rf"this network \({architecture}\).* has shape .*, expected"):
        load_network(path)


@every_rival
def test_values_that_are_not_finite_are_refused(architecture, tmp_path):
    state, path = published_form(published_rival(architecture)), tmp_path / "model_best.pth"
    name = min(name for name in state if name.endswith("weight"))
    state[name] = state[name].detach().clone()
    state[name].view(-1)[0] = torch.nan
    torch.save({"state_dict": state}, path)
    with pytest.raises(CheckpointError, match=re.escape(f"{name} holds values that are not finite")):
        load_network(path)


def test_checkpoint_of_an_unknown_network_is_refused(tmp_path):
    path = tmp_path / "resnet.pth"
    torch.save({f"layer{number}.conv.weight": torch.zeros(2) for number in range(30)}, path)
    with pytest.raises(CheckpointError) as error:
        load_network(path)
    assert f"{path}: no network that corrsfm knows" in str(error.value)
    assert "layer0.conv.weight, " in str(error.value)
    assert "and 20 more; it knows corradaptor, pointcn, oanet" in str(error.value)


def test_another_network_than_the_one_asked_for_is_refused(tmp_path):
    path = tmp_path / "model_best.pth"
    torch.save(published_form(published_rival("clnet")), path)
    for wanted in ("ncmnet", "corradaptor"):
        with pytest.raises(CheckpointError, match=f"holds the network clnet, expected {wanted}"):
            load_network(path, wanted)
    with pytest.raises(ConfigError, match="architecture is 'supernet', expected one of corradaptor, pointcn"):
        load_network(path, "supernet")


def test_options_of_a_saved_network_are_checked(tmp_path):
    path = tmp_path / "network.pt"
    save_network(published_rival("umatch", channels=32), path)
    content = torch.load(path, weights_only=True)
    for change, reason in [
        ({"architecture": "supernet"}, "architecture is 'supernet'"),
        ({"channels": 30}, "channels is 30"),
        ({"colour": 1}, "unknown network options colour"),
    ]:
        torch.save({**content, "config": {**content["config"], **change}}, path)
        with pytest.raises(CheckpointError, match=reason):
            load_network(path)


class Executed:
    """Would leave a file behind if anything unpickled it."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


def test_nothing_in_a_checkpoint_is_executed(tmp_path):
    trace = tmp_path / "executed"
    state = published_form(published_rival("oanet"))
    torch.save({"state_dict": state, "options": Executed(trace)}, tmp_path / "evil.pth")
    objects = np.empty(1, object)
    objects[0] = Executed(trace)
    np.savez(tmp_path / "evil.npz", weights=objects)
    for name in ("evil.pth", "evil.npz"):
        with pytest.raises(CheckpointError, match=rf"{name}: not .* read safely"):
            load_network(tmp_path / name)
    assert not trace.exists()


class DisguisedObject:
    """Asks for a NumPy number of the type object."""

    def __init__(self, content: object) -> None:
        self.content = content

    def __reduce__(self):
        return np.float64(0).__reduce__()[0], (np.dtype("O"), self.content)


def test_numbers_of_numpy_beside_the_tensors_are_read_and_objects_are_not(tmp_path):
    network, path, trace = published_rival("oanet"), tmp_path / "model_best.pth", tmp_path / "executed"
    content = {"state_dict": published_form(network), "best_acc": np.float64(0.5), "epoch": np.int64(3)}
    torch.save(content, path)
    assert_same_state(load_network(path), network)
    for hidden in (Executed(trace), pickle.dumps(Executed(trace))):
        torch.save({**content, "best_acc": DisguisedObject(hidden)}, path)
        with pytest.raises(CheckpointError, match="read safely"):
            load_network(path)
    assert not trace.exists()


def test_archive_that_is_none_is_refused(tmp_path):
    path = tmp_path / "pointcn.npz"
    for content in (b"", b"PK\x03\x04 cut off", b"\xff\xd8\xff\xe0 a photo"):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match=r"pointcn\.npz: not an archive"):
            load_network(path)
    np.savez(path, **{"Matchnet/output/self-conv/weights": np.array(["text"])})
    with pytest.raises(CheckpointError, match=r"pointcn\.npz: not an archive"):
        load_network(path)
