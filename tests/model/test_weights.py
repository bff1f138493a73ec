"""Checkpoints: both formats load, everything else is refused with the reason."""

import dataclasses
import hashlib

import pytest
import torch
from published_weights import published_state

from corrsfm.config import MatchInput, NetworkUsage
from corrsfm.errors import CheckpointError
from corrsfm.model import CorrAdaptor, NetworkConfig, load_network, read_provenance, save_network, weights

CONFIG = NetworkConfig(
    channels=16, clusters=12, heads=2, motion_stacking=1, neighbors=(6, 3), side_channels=2
)


@pytest.fixture
def network() -> CorrAdaptor:
    torch.manual_seed(0)
    return CorrAdaptor.from_config(CONFIG).eval()


@pytest.fixture
def checkpoint(network, tmp_path):
    path = tmp_path / "network.pt"
    save_network(network, path, provenance={"steps": 7, "licence": "CC0"})
    return path


def test_saved_network_loads_with_its_configuration_weights_and_provenance(network, checkpoint):
    loaded = load_network(checkpoint)
    assert loaded.config == CONFIG
    assert not loaded.training
    state = loaded.state_dict()
    for name, value in network.state_dict().items():
        assert torch.equal(state[name], value), name
    assert read_provenance(checkpoint) == {"steps": 7, "licence": "CC0"}


def test_save_returns_the_hash_of_the_file_and_leaves_nothing_else(network, tmp_path):
    path = tmp_path / "network.pt"
    assert save_network(network, path) == hashlib.sha256(path.read_bytes()).hexdigest()
    assert list(tmp_path.iterdir()) == [path]


def test_half_precision_halves_the_file_and_loads_as_float32(network, checkpoint, tmp_path):
    path = tmp_path / "half.pt"
    big = CorrAdaptor.from_config(dataclasses.replace(CONFIG, channels=64))
    save_network(big, tmp_path / "single.pt")
    save_network(big, path, half=True)
    assert path.stat().st_size < 0.65 * (tmp_path / "single.pt").stat().st_size
    loaded = load_network(path)
    state = loaded.state_dict()
    assert {value.dtype for value in state.values()} == {torch.float32, torch.int64}
    for name, value in big.state_dict().items():
        torch.testing.assert_close(state[name], value, atol=1e-4, rtol=1e-3)


def test_stored_weights_load_without_running_code(checkpoint):
    content = torch.load(checkpoint, weights_only=True)
    assert content["format"] == weights.FORMAT
    assert set(content) == {"format", "config", "state_dict", "usage", "provenance"}


def test_usage_travels_with_the_weights(network, tmp_path):
    path = tmp_path / "mutual.pt"
    network.usage = NetworkUsage(input=MatchInput.MUTUAL, sfm_min_score=0.2)
    save_network(network, path)
    assert load_network(path).usage == network.usage


def test_a_checkpoint_without_usage_reads_all_matches(checkpoint):
    content = torch.load(checkpoint, weights_only=True)
    del content["usage"]
    torch.save(content, checkpoint)
    assert load_network(checkpoint).usage == NetworkUsage()
    assert NetworkUsage().input is MatchInput.ALL


@pytest.mark.parametrize("prefix", ["", "module."])
def test_published_format_loads(shared_dir, tmp_path, prefix):
    state = published_state(shared_dir / "parity" / "published_network_state_dict.txt")
    path = tmp_path / "model_best.pth"
    torch.save({"epoch": 3, "state_dict": {prefix + name: value for name, value in state.items()}}, path)
    loaded = load_network(path)
    assert loaded.config == NetworkConfig()
    assert loaded.usage == NetworkUsage()
    weight = state["ds_0.aggregator1.conv1.0.weight"]  # (128,128,1,3)
    assert torch.equal(loaded.blocks[0].rounds[0].explicit.ring.weight[:, 128:256], weight[:, :, 0, 1])
    assert torch.equal(loaded.blocks[1].rounds[1].logit.bias, state["ds_1.linear_1.bias"])
    assert read_provenance(path) == {}


def test_missing_and_unexpected_keys_are_listed(checkpoint):
    content = torch.load(checkpoint, weights_only=True)
    content["state_dict"]["head.surprise"] = content["state_dict"].pop("head.linear1.weight")
    torch.save(content, checkpoint)
    with pytest.raises(CheckpointError) as error:
        load_network(checkpoint)
    assert "1 missing keys: head.linear1.weight" in str(error.value)
    assert "1 unexpected keys: head.surprise" in str(error.value)


@pytest.mark.parametrize(
    "change",
    [
        torch.Tensor.to_sparse,
        lambda values: values.to(torch.complex64),
        lambda values: values.to(torch.int8),
        lambda values: values.to("meta"),
        lambda values: torch.quantize_per_tensor(values.float(), 0.1, 0, torch.qint8),
    ],
    ids=["sparse", "complex", "whole", "absent", "quantised"],
)
@pytest.mark.filterwarnings("ignore")
def test_weights_that_are_no_plain_numbers_are_refused(checkpoint, change):
    content = torch.load(checkpoint, weights_only=True)
    content["state_dict"]["head.linear1.weight"] = change(content["state_dict"]["head.linear1.weight"])
    torch.save(content, checkpoint)
    with pytest.raises(CheckpointError, match="head.linear1.weight is not a plain tensor of real numbers"):
        load_network(checkpoint)


def test_published_format_with_other_keys_is_refused(tmp_path):
    path = tmp_path / "other.pth"
    torch.save({"state_dict": {"layer.weight": torch.zeros(2)}}, path)
    with pytest.raises(CheckpointError, match="unexpected keys: layer.weight"):
        load_network(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda content: content.update(format="corrsfm-network-9"), "format 'corrsfm-network-9'"),
        (lambda content: content.pop("config"), "no network configuration"),
        (lambda content: content["config"].update(channels=32), "has shape"),
        (lambda content: content["config"].update(channels=30), "channels is 30"),
        (lambda content: content["config"].update(colour=1), "unknown network options colour"),
        (
            lambda content: content["usage"].update(input="some"),
            "input is 'some', expected one of all, mutual",
        ),
        (lambda content: content["usage"].update(pose_min_score=2.0), "pose_min_score is 2.0"),
        (lambda content: content.update(usage="mutual"), "its usage is a str"),
        (lambda content: content.pop("state_dict"), "no 'state_dict'"),
        (lambda content: content["state_dict"]["head.output.bias"].fill_(torch.nan), "not finite"),
    ],
)
def test_wrong_checkpoint_is_refused_with_the_reason(checkpoint, change, expected):
    content = torch.load(checkpoint, weights_only=True)
    change(content)
    torch.save(content, checkpoint)
    with pytest.raises(CheckpointError, match=expected) as error:
        load_network(checkpoint)
    assert str(checkpoint) in str(error.value)


def test_file_that_is_no_checkpoint_is_refused(tmp_path):
    path = tmp_path / "photo.pt"
    for content in (b"\xff\xd8\xff\xe0 a photo", b"random text\n", b"PK\x03\x04 cut off", b"\x80\x02x", b""):
        path.write_bytes(content)
        with pytest.raises(CheckpointError, match="is damaged, or another kind of file") as caught:
            load_network(path)
        assert "weights_only" not in str(caught.value)
    torch.save([1, 2], path)
    with pytest.raises(CheckpointError, match="holds a list"):
        load_network(path)


def test_checkpoint_that_would_run_code_is_refused(tmp_path):
    path = tmp_path / "evil.pt"
    torch.save({"state_dict": {}, "hook": hashlib.sha256}, path)
    with pytest.raises(CheckpointError, match=r"read safely \(it holds \S*sha256\); expected"):
        load_network(path)


def test_missing_file_is_an_error_that_names_it(tmp_path):
    for use in (load_network, weights.checkpoint_sha256):
        with pytest.raises(CheckpointError, match=r"absent\.pt: no such checkpoint"):
            use(tmp_path / "absent.pt")


def bundle(monkeypatch, path, sha256: str) -> None:
    row = weights.BundledCheckpoint(
        name="test",
        file=path.name,
        sha256=sha256,
        config=CONFIG,
        licence="CC0",
        training_data="none",
        score="none",
    )
    monkeypatch.setattr(weights, "CHECKPOINT_DIR", path.parent)
    monkeypatch.setattr(weights, "REGISTRY", {"test": row})
    monkeypatch.setattr(weights, "DEFAULT_CHECKPOINTS", {"corradaptor": "test"})


def test_bundled_checkpoint_loads_by_default_and_by_name(monkeypatch, checkpoint):
    bundle(monkeypatch, checkpoint, hashlib.sha256(checkpoint.read_bytes()).hexdigest())
    assert load_network().config == load_network("test").config == CONFIG


def test_hash_of_a_checkpoint_is_that_of_its_file_or_of_its_release(monkeypatch, checkpoint):
    expected = hashlib.sha256(checkpoint.read_bytes()).hexdigest()
    assert weights.checkpoint_sha256(checkpoint) == expected
    bundle(monkeypatch, checkpoint, expected)
    assert weights.checkpoint_sha256() == weights.checkpoint_sha256("test") == expected


def test_bundled_checkpoint_with_another_hash_is_refused(monkeypatch, checkpoint):
    bundle(monkeypatch, checkpoint, "0" * 64)
    with pytest.raises(CheckpointError, match="SHA-256"):
        load_network()


def test_a_network_without_bundled_weights_needs_a_file():
    with pytest.raises(CheckpointError, match="no weights of the network clnet come with corrsfm"):
        load_network(architecture="clnet")


def test_every_registered_checkpoint_is_what_it_says():
    for architecture, name in weights.DEFAULT_CHECKPOINTS.items():
        assert weights.REGISTRY[name].architecture == architecture
    for name, row in weights.REGISTRY.items():
        assert name == row.name
        assert load_network(name).config == row.config
        assert row.licence and row.training_data and row.score
