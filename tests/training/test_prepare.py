"""Preparing pairs: splits, the choice of pairs, scenes of photos, both layouts; recipes."""

import dataclasses
import json
import resource
from pathlib import Path

import numpy as np
import pytest
import torch
from labelled_scene import make_scene

from corrsfm.config import FeatureKind, MatchInput
from corrsfm.errors import ConfigError, InputError, WorkspaceError
from corrsfm.features import create_extractor
from corrsfm.labelled.compact import read_labelled_pairs, read_scenes, write_scenes
from corrsfm.labelled.oanet import read_pairs, write_pairs
from corrsfm.model import CorrAdaptor, NetworkConfig, load_network
from corrsfm.training import prepare
from corrsfm.training.config import (
    NO_AUGMENTATION,
    PrepareConfig,
    TrainConfig,
    TrainRecipe,
    load_recipe,
)
from corrsfm.training.dataset import RealPairs, generator_for
from corrsfm.training.initial import initial_network, network_config
from corrsfm.training.loop import train
from corrsfm.training.prepare import (
    choose_pairs,
    prepare_file,
    prepare_oanet,
    prepare_scene,
    read_splits,
    scenes_of_split,
)
from corrsfm.workspace import StageRecord, Workspace


def test_splits_of_the_photo_scenes_are_disjoint(shared_dir):
    splits = read_splits(shared_dir / "photos" / "splits.json")
    assert {name: len(scenes) for name, scenes in splits.items()} == {"train": 54, "val": 6, "test": 13}
    everything = [scene for scenes in splits.values() for scene in scenes]
    assert len(set(everything)) == 73


def test_a_scene_in_two_splits_is_refused(tmp_path):
    path = tmp_path / "splits.json"
    path.write_text(json.dumps({"train": ["a", "b"], "test": ["b"]}))
    with pytest.raises(InputError, match="more than once: b"):
        read_splits(path)
    path.write_text(json.dumps({"train": ["a"], "val": ["a" * 5000]}))
    (tmp_path / "a").mkdir()
    assert scenes_of_split(tmp_path, path, "train") == [tmp_path / "a"]
    with pytest.raises(InputError, match="no split 'test'"):
        scenes_of_split(tmp_path, path, "test")
    with pytest.raises(InputError, match="names scenes that are not in"):
        scenes_of_split(tmp_path, path, "val")


def test_chosen_pairs_spread_over_the_range_of_difficulty():
    covisible = {(i, j): 1 + i + j for i in range(30) for j in range(i + 1, 30)}
    chosen = choose_pairs(covisible, 40, seed=0)
    assert len(chosen) == len(set(chosen)) == 40
    assert chosen == choose_pairs(covisible, 40, seed=0) != choose_pairs(covisible, 40, seed=1)
    counts = sorted(covisible[pair] for pair in chosen)
    expected = np.quantile(sorted(covisible.values()), [0.1, 0.5, 0.9])
    np.testing.assert_allclose(np.quantile(counts, [0.1, 0.5, 0.9]), expected, atol=4)
    assert choose_pairs(covisible, 0, seed=0) == sorted(covisible)


@pytest.fixture(scope="module")
def small_scene(shared_dir, tmp_path_factory) -> Path:
    """Three photos of a real scene."""
    source = shared_dir / "photos" / "olsson_statue_niche"
    folder = tmp_path_factory.mktemp("scenes") / "niche"
    (folder / "images").mkdir(parents=True)
    names = sorted(path.name for path in (source / "images").iterdir())[:3]
    for name in names:
        (folder / "images" / name).symlink_to(source / "images" / name)
    (folder / "cameras.txt").write_text((source / "cameras.txt").read_text())
    lines = (source / "images.txt").read_text().splitlines()
    kept = [f"{line}\n\n" for line in lines if line.split() and line.split()[-1] in names]
    (folder / "images.txt").write_text("".join(kept))
    (folder / "points3D.txt").write_text("")
    lines = (source / "covisibility.txt").read_text().splitlines()
    (folder / "covisibility.txt").write_text(
        "\n".join(line for line in lines if line.split()[0] in names and line.split()[1] in names)
    )
    return folder


CONFIG = PrepareConfig(max_features=300)


def test_prepared_pairs_of_photos_have_right_matches_on_their_epipolar_lines(small_scene):
    scene = prepare_scene(small_scene, CONFIG)
    assert len(scene.image_names) == 3 and len(scene.pairs) == 3
    pair = scene.pair(0)
    assert len(pair) == 300
    good = pair.mutual & (pair.ratios < 0.7)
    assert good.sum() > 20
    assert (pair.label_distances[good] < 1e-4).mean() > 0.9
    assert pair.inliers().mean() < 0.9
    # The lens of this camera is far from a pinhole.
    assert np.abs(scene.corrections).max() > 0.01


def test_both_layouts_train_alike(small_scene, tmp_path):
    assert prepare_file(tmp_path / "pairs.h5", [small_scene], CONFIG) == [("niche", 3)]
    assert prepare_oanet(tmp_path / "oanet.h5", [small_scene], CONFIG) == [("niche", 3)]
    assert len(read_scenes(tmp_path / "pairs.h5")) == 1
    assert len(list(read_pairs(tmp_path / "oanet.h5"))) == 3
    device = torch.device("cpu")
    compact, oanet = (
        RealPairs.from_files([tmp_path / name], device).sample(
            4, 200, NO_AUGMENTATION, generator_for(0, 0, 0, device)
        )
        for name in ("pairs.h5", "oanet.h5")
    )
    assert compact.correspondences.shape == oanet.correspondences.shape == (4, 200, 4)
    assert float(oanet.distances().min()) < 1e-5


def test_a_workspace_is_a_scene(small_scene, tmp_path):
    workspace = Workspace(tmp_path / "work", create=True)
    workspace.images_dir = small_scene / "images"
    workspace.finish("images", StageRecord(fingerprint="x"))
    model = tmp_path / "work" / "sparse" / "0"
    model.mkdir(parents=True)
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (model / name).write_text((small_scene / name).read_text())
    # Without covisibility.txt the pairs are those that share points of the model; this one has none.
    with pytest.raises(InputError, match="no two photos from different places share"):
        prepare_scene(tmp_path / "work", CONFIG)
    (tmp_path / "work" / "covisibility.txt").write_text((small_scene / "covisibility.txt").read_text())
    assert len(prepare_scene(tmp_path / "work", CONFIG).pairs) == 3


def test_rendered_views_are_training_data(repository):
    config = PrepareConfig(max_features=300, max_pairs_per_scene=4)
    scene = prepare_scene(repository / "sample_scenes" / "courtyard", config)
    pairs = [scene.pair(index) for index in range(len(scene.pairs))]
    assert len(pairs) == 4
    for pair in pairs:
        distinctive = pair.mutual & (pair.ratios < 0.7)
        # Exact cameras: distinctive matches lie on the true epipolar lines, most others do not.
        assert pair.inliers()[distinctive].mean() > 0.8
        assert pair.inliers()[~pair.mutual].mean() < 0.3


def test_photos_that_share_nothing_are_negatives(repository, tmp_path):
    scene = repository / "sample_scenes" / "colonnade"
    shared = tmp_path / "colonnade"
    shared.mkdir()
    for path in scene.iterdir():
        (shared / path.name).symlink_to(path)
    names = sorted(path.name for path in (scene / "images").iterdir())
    (shared / "covisibility.txt").write_text(f"{names[0]} {names[1]} 50\n{names[1]} {names[2]} 5\n")
    config = PrepareConfig(max_features=200, negatives=3)
    assert prepare_file(tmp_path / "pairs.h5", [shared], config) == [("colonnade", 4)]
    (prepared,) = read_scenes(tmp_path / "pairs.h5")
    covisible = {tuple(pair): count for pair, count in zip(prepared.pairs, prepared.covisible, strict=True)}
    # A pair that shares fewer points than asked for is neither related nor a negative.
    assert covisible.pop((0, 1)) == 50 and (1, 2) not in covisible
    assert list(covisible.values()) == [0, 0, 0]
    negative = prepared.pair(int(np.flatnonzero(prepared.covisible == 0)[0]))
    assert np.isinf(negative.label_distances).all() and not negative.inliers().any()
    # Evaluation and validation have no use for them.
    assert len(list(read_labelled_pairs(tmp_path / "pairs.h5"))) == 1
    with pytest.raises(ConfigError, match="--layout compact"):
        prepare_oanet(tmp_path / "oanet.h5", [shared], config)


@pytest.mark.parametrize("layout", ["compact", "oanet"])
def test_a_disk_that_takes_no_more_is_named_and_nothing_is_left(tmp_path, layout):
    scene = make_scene("a", num_keypoints=400)
    path = tmp_path / "pairs.h5"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))
    try:
        # Not what HDF5 says when it misses what it wrote.
        with pytest.raises(WorkspaceError, match="pairs.h5: cannot be written, it is larger than"):
            if layout == "compact":
                write_scenes(path, [scene])
            else:
                write_pairs(path, map(scene.pair, range(len(scene.pairs))))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_a_place_for_no_file_is_refused():
    with pytest.raises(WorkspaceError, match=r"/proc/pairs.h5: cannot be written"):
        write_scenes(Path("/proc/pairs.h5"), [])


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no COLMAP model"):
        prepare_scene(tmp_path, CONFIG)


@pytest.mark.parametrize("name", ["train_paper", "train_side", "train_small"])
def test_recipes_build_their_networks(repository, name):
    recipe = load_recipe(repository / "pipelines" / f"{name}.toml")
    config = network_config(recipe)
    assert config.side_channels == (0 if name == "train_paper" else 5)
    num_parameters = sum(p.numel() for p in CorrAdaptor.from_config(config).parameters())
    if name == "train_small":
        assert num_parameters <= 1_000_000
    else:
        assert config.channels == NetworkConfig().channels


def test_the_second_part_of_the_small_recipe_continues_the_first(repository):
    first, second = (
        load_recipe(repository / "pipelines" / f"{name}.toml") for name in ("train_small", "train_small_more")
    )
    assert Path(second.train.initial) == first.train.output / "latest.pt"
    assert second.network == {}
    assert second.train.train_files == first.train.train_files


def test_the_mutual_recipe_reads_mutual_matches_and_continues_a_network(repository):
    recipe = load_recipe(repository / "pipelines" / "train_mutual.toml")
    assert recipe.train.input is MatchInput.MUTUAL
    assert recipe.train.initial and recipe.network == {}


def test_a_recipe_with_an_unknown_key_is_refused(tmp_path):
    (tmp_path / "a.toml").write_text("[train]\nlearning_rat = 1e-3\n")
    with pytest.raises(ConfigError, match="learning_rat"):
        load_recipe(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_text("[trian]\n")
    with pytest.raises(ConfigError, match="trian"):
        load_recipe(tmp_path / "b.toml")


def test_the_network_for_aliked_starts_from_that_for_sift(repository):
    recipe = load_recipe(repository / "pipelines" / "train_aliked.toml")
    sift, aliked = load_network(), initial_network(recipe).eval()
    assert aliked.side_channels == 2 and aliked.usage.features == FeatureKind.ALIKED
    coordinates = 0.3 * torch.randn(1, 100, 4, generator=torch.Generator().manual_seed(0))
    ratio = torch.linspace(0, 1, 100).view(1, 100, 1)
    one, zero = torch.ones_like(ratio), torch.zeros_like(ratio)
    with torch.no_grad():
        expected = sift(coordinates, torch.cat([ratio, one, zero, one, zero], -1)).last_logits()
        found = aliked(coordinates, torch.cat([ratio, one], -1)).last_logits()
    torch.testing.assert_close(found, expected, atol=1e-3, rtol=1e-3)


def test_features_without_scale_are_prepared_as_such(repository, tmp_path, monkeypatch):
    photo = repository / "sample_scenes" / "courtyard"

    def without_shapes(config):
        extract = create_extractor(config)
        return lambda image, mask: dataclasses.replace(extract(image, mask), scales=None, orientations=None)

    monkeypatch.setattr(prepare, "create_extractor", without_shapes)
    config = PrepareConfig(max_features=300, max_pairs_per_scene=2, max_photos_per_scene=4)
    prepare_file(tmp_path / "pairs.h5", [photo], config)
    (scene,) = read_scenes(tmp_path / "pairs.h5")
    assert len(scene.image_names) == 4
    assert np.isnan(scene.log_scales).all() and np.isnan(scene.orientations).all()
    assert not scene.pair(0).as_correspondences().shapes_known
    options = TrainConfig(train_files=(tmp_path / "pairs.h5",), output=tmp_path / "run", max_steps=1)
    network = {"channels": 8, "clusters": 4, "neighbors": [6, 3], "heads": 2, "side_channels": 5}
    with pytest.raises(ConfigError, match="5 side channels read scale and orientation"):
        train(TrainRecipe(train=options, network=network), device="cpu")
