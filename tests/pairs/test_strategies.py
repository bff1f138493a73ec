"""Every strategy proposes sensible pairs, once, and says where they came from."""

import itertools
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from corrsfm.config import PairsConfig, PairStrategy
from corrsfm.errors import ConfigError, InputError
from corrsfm.graph import connected_components, describe_components
from corrsfm.pairs.strategies import (
    covisible_pairs,
    make_pairs,
    natural_order,
    read_pairs_file,
    sequential_pairs,
    spatial_pairs,
)
from corrsfm.types import Features, ImageRecord, PairList

EXHAUSTIVE, SEQUENTIAL, RETRIEVAL = PairStrategy.EXHAUSTIVE, PairStrategy.SEQUENTIAL, PairStrategy.RETRIEVAL
SPATIAL, FILE, COVISIBILITY = PairStrategy.SPATIAL, PairStrategy.FILE, PairStrategy.COVISIBILITY


def record(name: str, gps: tuple[float, float, float] | None = None) -> ImageRecord:
    return ImageRecord(name=name, camera_id=0, sha256="", gps=gps)


def features(seed: int, num: int = 40) -> Features:
    """Descriptors that drift slowly with the seed, as along a video."""
    base = np.random.default_rng(0).gamma(0.4, 60, (200, 128))
    noise = np.random.default_rng(seed).normal(0, 5, (num, 128))
    none = np.zeros(num, np.float32)
    return Features(
        keypoints=np.zeros((num, 2), np.float32),
        scales=none,
        orientations=none,
        scores=none,
        descriptors=np.clip(base[(8 * seed + np.arange(num)) % 200] + noise, 0, 255).astype(np.uint8),
        image_size=(1, 1),
    )


def video(num: int) -> list[ImageRecord]:
    """Frames about 11 m apart on a line to the north."""
    return [record(f"img{index}.jpg", (50.0 + 1e-4 * index, 7.0, 0.0)) for index in range(num)]


def load(name: str) -> Features:
    return features(int(name[3:-4]))


@pytest.fixture
def inputs(tmp_path: Path) -> dict[str, Path]:
    """A pairs file and a model for the frames of a video of 12."""
    pairs_file = tmp_path / "pairs.txt"
    pairs_file.write_text("".join(f"img{i}.jpg img{(i + 3) % 12}.jpg\n" for i in range(12)))
    return {"pairs_file": pairs_file, "covisible_model": write_model(tmp_path / "model", 12)}


def write_model(folder: Path, num_images: int) -> Path:
    """A synthetic model whose images are named like the frames of a video."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=num_images, num_points3D=50
    )
    model = pycolmap.synthesize_dataset(options)
    for number, image in enumerate(sorted(model.images.values(), key=lambda image: image.image_id)):
        image.name = f"img{number}.jpg"
    folder.mkdir()
    model.write_binary(folder)
    return folder


def check(pair_list: PairList, names: list[str]) -> None:
    """What holds for the pairs of any strategy."""
    assert list(pair_list.pairs) == sorted(set(pair_list.pairs))
    assert all(name0 < name1 and {name0, name1} <= set(names) for name0, name1 in pair_list.pairs)
    assert all(origin and list(origin) == sorted(set(origin)) for origin in pair_list.origins)
    assert {name for pair in pair_list.pairs for name in pair} == set(names)


COMBINATIONS = [
    *itertools.combinations(
        [EXHAUSTIVE, SEQUENTIAL, RETRIEVAL, SPATIAL, FILE, COVISIBILITY, PairStrategy.AUTO], 1
    ),
    *itertools.combinations([SEQUENTIAL, RETRIEVAL, SPATIAL, FILE, COVISIBILITY], 2),
    (SEQUENTIAL, RETRIEVAL, SPATIAL, FILE, COVISIBILITY, EXHAUSTIVE),
]


@pytest.mark.parametrize("pairing", COMBINATIONS, ids="+".join)
@pytest.mark.parametrize("loop_closure", [False, True])
def test_no_pair_repeats_and_every_photo_has_one(
    pairing: tuple[PairStrategy, ...], loop_closure: bool, inputs: dict[str, Path]
) -> None:
    records = video(12)
    config = PairsConfig(
        pairing=pairing,
        loop_closure=loop_closure,
        sequential_overlap=2,
        num_retrieved=3,
        num_spatial=3,
        num_covisible=3,
        **inputs,
    )
    pair_list = make_pairs(records, config, load_features=load)
    check(pair_list, [r.name for r in records])
    assert make_pairs(records[::-1], config, load_features=load) == pair_list


def test_a_union_remembers_every_origin(inputs: dict[str, Path]) -> None:
    config = PairsConfig(pairing=(FILE, SEQUENTIAL), sequential_overlap=3, pairs_file=inputs["pairs_file"])
    pair_list = make_pairs(video(12), config)
    origins = dict(zip(pair_list.pairs, pair_list.origins, strict=True))
    assert origins["img0.jpg", "img3.jpg"] == ("file", "sequential")
    assert origins["img0.jpg", "img1.jpg"] == ("sequential",)
    assert origins["img0.jpg", "img9.jpg"] == ("file",)
    assert all(type(text) is str for origin in pair_list.origins for text in origin)


def test_auto_is_exhaustive_for_small_scenes_and_retrieval_for_large_ones() -> None:
    small = make_pairs(video(30), PairsConfig())
    assert len(small) == 30 * 29 // 2
    assert set(small.origins) == {("exhaustive",)}
    large = make_pairs(video(201), PairsConfig(num_retrieved=4), load_features=load)
    assert set(large.origins) == {("retrieval",)}
    assert len(large) <= 201 * 4


def test_auto_takes_the_pairs_file_and_the_model_that_are_given(inputs: dict[str, Path]) -> None:
    listed = make_pairs(video(12), PairsConfig(pairs_file=inputs["pairs_file"]))
    assert listed == make_pairs(video(12), PairsConfig(pairing=(FILE,), pairs_file=inputs["pairs_file"]))
    both = make_pairs(video(12), PairsConfig(**inputs))
    assert {name for origin in both.origins for name in origin} == {"file", "covisibility"}
    union = make_pairs(video(12), PairsConfig(pairing=(EXHAUSTIVE,), **inputs))
    assert set(union.origins) == {("exhaustive",)}


def test_loop_closure_adds_retrieval_pairs_to_a_sequence_only(caplog: pytest.LogCaptureFixture) -> None:
    config = PairsConfig(pairing=(SEQUENTIAL,), sequential_overlap=1, loop_closure=True, num_retrieved=2)
    # The made-up descriptors repeat after 25 frames.
    pair_list = make_pairs(video(50), config, load_features=load)
    origins = dict(zip(pair_list.pairs, pair_list.origins, strict=True))
    assert "loop-closure" in origins["img0.jpg", "img25.jpg"]
    assert all("sequential" in origins[tuple(sorted((f"img{i}.jpg", f"img{i + 1}.jpg")))] for i in range(49))
    assert not caplog.messages
    exhaustive = make_pairs(video(5), PairsConfig(loop_closure=True))
    assert caplog.messages == [
        "--loop-closure adds to --pairing sequential only, which is not chosen: exhaustive"
    ]
    assert set(exhaustive.origins) == {("exhaustive",)}


def test_names_are_ordered_as_people_count() -> None:
    names = ["b/img1.jpg", "img10.jpg", "img2.jpg", "IMG3.jpg", "img02b.jpg", "a/x²9.jpg", "a/x²10.jpg"]
    ordered = [names[index] for index in natural_order(names)]
    assert ordered == [
        "a/x²9.jpg",
        "a/x²10.jpg",
        "b/img1.jpg",
        "img2.jpg",
        "img02b.jpg",
        "IMG3.jpg",
        "img10.jpg",
    ]


def test_a_sequence_pairs_neighbours() -> None:
    names = [f"{index}.jpg" for index in range(20)]
    distances = {j - i for i, j in sequential_pairs(names, 3)}
    assert distances == {1, 2, 3}
    assert len(sequential_pairs(names, 3)) == 19 + 18 + 17
    assert {j - i for i, j in sequential_pairs(names, 1, quadratic=True)} == {1, 2, 4, 8, 16}


def test_a_sequence_may_be_shorter_than_its_overlap() -> None:
    assert sequential_pairs(["a", "b", "c"], 10, quadratic=True) == {(0, 1), (0, 2), (1, 2)}
    # Counted up to, it would take an hour.
    assert sequential_pairs(["a", "b", "c"], 2**31 - 1) == {(0, 1), (0, 2), (1, 2)}


def test_spatial_pairs_are_near_by_the_metre() -> None:
    # A degree of latitude at 50° north is 111,229 m: frames are 11.12 m apart.
    assert spatial_pairs(video(5), 10, 11.2) == {(0, 1), (1, 2), (2, 3), (3, 4)}
    assert spatial_pairs(video(5), 10, 11.0) == set()
    assert len(spatial_pairs(video(5), 10, 22.3)) == 4 + 3


def test_spatial_pairs_cross_the_date_line_and_ignore_altitude() -> None:
    records = [record("a", (0.0, 179.9999, 0.0)), record("b", (0.0, -179.9999, 900.0)), record("c")]
    # 0.0002° of the equator are 22.26 m.
    assert spatial_pairs(records, 5, 22.3) == {(0, 1)}
    assert spatial_pairs(records, 5, 22.2) == set()


def test_spatial_pairs_take_the_nearest_first() -> None:
    places = [0.0, 1.0, 3.0, 7.0]
    records = [record(str(i), (50.0 + 1e-4 * x, 7.0, 0.0)) for i, x in enumerate(places)]
    assert spatial_pairs(records, 1, 1e6) == {(0, 1), (1, 2), (2, 3)}


def test_spatial_pairs_need_positions() -> None:
    with pytest.raises(InputError, match="1 of 2 photos have a GPS position"):
        spatial_pairs([record("a"), record("b", (1.0, 2.0, 3.0))], 5, 100.0)


NAMES = ["a b.jpg", "c.jpg", "d e.jpg", "it's.jpg"]


@pytest.mark.parametrize(
    "line",
    [
        "a b.jpg\td e.jpg",
        '"a b.jpg" "d e.jpg"',
        "a b.jpg d e.jpg",
        "'d e.jpg' 'a b.jpg'",
        "  d e.jpg  a b.jpg ",
    ],
)
def test_names_with_spaces_are_read_in_every_way_of_writing(line: str, tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text(f"# name0 name1\n\n{line}\n")
    assert read_pairs_file(path, NAMES) == {(0, 2)}


def test_an_apostrophe_is_no_quote(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("c.jpg it's.jpg\n")
    assert read_pairs_file(path, NAMES) == {(1, 3)}


def test_an_ambiguous_line_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("a a a\n")
    with pytest.raises(InputError, match="line 1: 'a a a'"):
        read_pairs_file(path, ["a", "a a"])


def test_a_pairs_file_with_unknown_photos_is_refused_line_by_line(tmp_path: Path) -> None:
    path = tmp_path / "pairs.txt"
    path.write_text("c.jpg it's.jpg\nc.jpg nobody.jpg\nc.jpg c.jpg\nc.jpg\n")
    with pytest.raises(InputError, match=r"3 lines.*line 2: 'c\.jpg nobody\.jpg', line 3.*line 4: 'c\.jpg';"):
        read_pairs_file(path, NAMES)


def test_an_empty_or_missing_pairs_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="pairs.txt: no such file"):
        read_pairs_file(tmp_path / "pairs.txt", NAMES)
    (tmp_path / "pairs.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="names no pair"):
        read_pairs_file(tmp_path / "pairs.txt", NAMES)


@pytest.mark.parametrize("strategy, option", [(FILE, "--pairs-file"), (COVISIBILITY, "--covisible-model")])
def test_a_missing_option_is_named(strategy: PairStrategy, option: str) -> None:
    with pytest.raises(ConfigError, match=f"--pairing {strategy} needs {option}"):
        make_pairs(video(3), PairsConfig(pairing=(strategy,)))


def test_covisible_pairs_are_those_that_share_most_points(tmp_path: Path) -> None:
    model = write_model(tmp_path / "model", 9)
    names = sorted(f"img{index}.jpg" for index in range(8))  # one image of the model is not in the scene
    images = {image.name: image for image in pycolmap.Reconstruction(model).images.values()}
    seen = [{p.point3D_id for p in images[name].points2D if p.has_point3D()} for name in names]
    for num_covisible in (1, 3):
        expected = set()
        for i, mine in enumerate(seen):
            others = sorted((j for j in range(8) if j != i), key=lambda j: (-len(mine & seen[j]), j))
            expected |= {tuple(sorted((i, j))) for j in others[:num_covisible] if mine & seen[j]}
        assert covisible_pairs(model, names, num_covisible) == expected


def test_models_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none: COLMAP model cannot be read"):
        covisible_pairs(tmp_path / "none", NAMES, 5)
    model = write_model(tmp_path / "model", 3)
    with pytest.raises(InputError, match="none of its images is among the photos"):
        covisible_pairs(model, NAMES, 5)
    with pytest.raises(InputError, match="no two photos share a point"):
        covisible_pairs(model, ["img0.jpg"], 5)


def test_components_are_sorted_by_size() -> None:
    pairs = [("a", "b"), ("d", "e"), ("e", "f")]
    assert connected_components("abcdef", pairs) == [["d", "e", "f"], ["a", "b"], ["c"]]


def test_components_of_a_long_chain_are_found() -> None:
    names = [f"{index:05d}" for index in range(5000)]
    assert len(connected_components(names, zip(names[:-1], names[1:], strict=True))) == 1


def test_only_disconnected_photos_are_described() -> None:
    names = ["a", "b", "c", "d", "e"]
    assert describe_components(names, itertools.pairwise(names)) == ""
    text = describe_components(names, [("a", "b"), ("b", "c")])
    assert "groups of 3, 1, 1 photos" in text
    assert text.splitlines()[1:] == [
        "not connected to the largest group: d",
        "not connected to the largest group: e",
    ]
