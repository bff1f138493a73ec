"""A model is laid on the ground by GPS positions, of which some may be wrong, or refused with a reason."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from click.testing import CliRunner
from export_readers import read_nerfstudio
from finished_scene import FinishedScene, make_finished_scene
from numpy.typing import NDArray

from corrsfm import export_scene
from corrsfm.cli import main
from corrsfm.errors import InputError
from corrsfm.export.gps import fit_to_gps
from corrsfm.export.world import held_upright
from corrsfm.geometry import Pose
from corrsfm.workspace import Workspace
from corrsfm.workspace.lists import Index, read_index, write_index

ORIGIN = (47.3769, 8.5417, 408.0)


def turned(*quaternion: float) -> NDArray[np.float64]:
    return np.array(pycolmap.Rotation3d(np.array(quaternion) / np.linalg.norm(quaternion)).matrix())


def geodetic(enu: NDArray[np.float64]) -> dict[str, tuple[float, float, float]]:
    """Positions (N, 3) in metres east, north and up of `ORIGIN` as latitude, longitude and altitude."""
    found = pycolmap.GPSTransform().enu_to_ellipsoid(enu, *ORIGIN)
    return {f"{i}.jpg": (float(a), float(b), float(c)) for i, (a, b, c) in enumerate(found)}


def cameras(centres: NDArray[np.float64]) -> dict[str, Pose]:
    """Cameras at centres (N, 3), all turned the same way."""
    rotation = turned(0.1, 0.3, -0.2, 0.9)
    return {f"{i}.jpg": (rotation, -rotation @ centre) for i, centre in enumerate(centres)}


def in_model(enu: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same places in a model of another scale, turned and moved."""
    rotation = turned(0.5, -0.1, 0.2, 0.8)
    return (enu - [3.0, 4.0, 5.0]) @ rotation / 20.0


def flight(num: int = 20) -> NDArray[np.float64]:
    return np.random.default_rng(1).uniform([-60, -40, 0], [60, 40, 15], (num, 3))


def placed(enu: NDArray[np.float64], *, is_upright: bool = False) -> NDArray[np.float64]:
    """Where a fit to exact positions puts the cameras, around the origin of the fit."""
    poses = cameras(in_model(enu) if not is_upright else enu @ spun.T / 7.0)
    fit = fit_to_gps(poses, geodetic(enu), is_upright=is_upright)
    centres = np.array([-rotation.T @ translation for rotation, translation in poses.values()])
    return fit.scale * centres @ np.array(fit.rotation).T + fit.translation


spun = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("is_upright", [False, True])
def test_cameras_come_to_lie_where_they_were(is_upright: bool) -> None:
    enu = flight()
    found = placed(enu, is_upright=is_upright)
    # A degree of longitude bends by less than a millimetre over the flight.
    np.testing.assert_allclose(found - found.mean(axis=0), enu - enu.mean(axis=0), atol=2e-3)


@pytest.mark.parametrize("is_upright", [False, True])
def test_cameras_on_both_sides_of_the_180th_meridian(
    monkeypatch: pytest.MonkeyPatch, is_upright: bool
) -> None:
    monkeypatch.setitem(globals(), "ORIGIN", (-17.0, 180.0, 20.0))
    enu = flight()
    longitudes = {position[1] for position in geodetic(enu).values()}
    assert min(longitudes) < -179.9 and max(longitudes) > 179.9
    found = placed(enu, is_upright=is_upright)
    np.testing.assert_allclose(found - found.mean(axis=0), enu - enu.mean(axis=0), atol=2e-3)


def test_wrong_positions_do_not_move_the_model() -> None:
    enu = flight()
    noise = np.random.default_rng(2).normal(0, 1.0, enu.shape)
    wrong = enu + noise
    wrong[:6] += [300.0, -200.0, 50.0]
    fit = fit_to_gps(cameras(in_model(enu)), geodetic(wrong))
    assert fit.scale == pytest.approx(20.0, rel=0.03)
    assert (fit.num_photos, fit.num_agreeing) == (20, 14)
    assert 0.5 < fit.residual_m < 5.0


def test_positions_on_a_line_need_up_from_the_cameras() -> None:
    enu = np.outer(np.linspace(-1, 1, 9), [40.0, 30.0, 0.0])
    with pytest.raises(InputError, match="on a line.*add --upright"):
        placed(enu)
    found = placed(enu, is_upright=True)
    np.testing.assert_allclose(found - found.mean(axis=0), enu - enu.mean(axis=0), atol=2e-3)
    noisy = enu + np.random.default_rng(4).normal(0, 2.0, enu.shape)
    with pytest.raises(InputError, match="on a line.*add --upright"):
        fit_to_gps(cameras(in_model(enu)), geodetic(noisy))


@pytest.mark.parametrize(
    ("enu", "text"),
    [
        (flight(2), "2 of 2 photos of the model have a GPS position in EXIF, at least three"),
        (np.zeros((5, 3)), "all photos have the same GPS position; give two photos"),
        (np.random.default_rng(0).normal(0, 1e-5, (5, 3)), "all photos have the same GPS position"),
    ],
)
def test_positions_that_tell_no_scale_are_refused(enu: NDArray[np.float64], text: str) -> None:
    with pytest.raises(InputError, match=text):
        fit_to_gps(cameras(flight(len(enu))), geodetic(enu))


def test_positions_coarser_than_the_scene_are_refused() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(InputError, match=r"differ from the model by .* m in the median, too much for"):
        fit_to_gps(cameras(rng.normal(0, 1, (12, 3))), geodetic(rng.normal(0, 4, (12, 3))))


@pytest.mark.parametrize(
    ("orientation", "gravity"), [(1, [0, 1, 0]), (3, [0, -1, 0]), (6, [1, 0, 0]), (8, [-1, 0, 0])]
)
def test_exif_turns_a_camera_as_colmap_reads_gravity_from_it(orientation: int, gravity: list[int]) -> None:
    # The directions that COLMAP 4.2 logs of photos with these flags.
    rotation, _ = held_upright((np.eye(3), np.zeros(3)), orientation)
    np.testing.assert_array_equal(rotation[1], gravity)
    assert np.linalg.det(rotation) == pytest.approx(1)


@pytest.fixture
def located(tmp_path: Path) -> FinishedScene:
    """A scene whose photos have the positions of its cameras, a unit being 4 m."""
    scene = make_finished_scene(tmp_path / "made", folder="")
    workspace = Workspace(scene.workspace)
    index = read_index(workspace)
    names = scene.names
    enu = np.array([scene.model.find_image_with_name(name).projection_center() for name in names]) * 4.0
    positions = dict(zip(names, geodetic(enu).values(), strict=True))
    records = [dataclasses.replace(record, gps=positions.get(record.name)) for record in index.records]
    write_index(workspace, Index(records=tuple(records), cameras=index.cameras))
    return scene


def test_an_export_is_in_metres_east_north_and_up(located: FinishedScene, tmp_path: Path) -> None:
    result = export_scene(located.workspace, tmp_path / "out", "nerfstudio", scale="gps")
    assert result.scale == pytest.approx(4.0, rel=1e-4)
    assert result.gps is not None and result.gps.residual_m < 1e-2
    read = read_nerfstudio(tmp_path / "out")
    expected = [
        located.model.find_image_with_name(path.name).projection_center() * 4.0 for path in read.paths
    ]
    found = read.camera_to_worlds[:, :3, 3]
    np.testing.assert_allclose(found - found.mean(0), expected - np.mean(expected, axis=0), atol=1e-2)


def test_the_command_takes_one_word_or_three(located: FinishedScene, tmp_path: Path) -> None:
    words = ["export", str(located.workspace), "--for", "csv"]
    result = CliRunner().invoke(main, [*words, str(tmp_path / "a.csv"), "--scale", "gps"])
    assert result.exit_code == 0, result.output
    assert "GPS: 5 of 5 positions agree, the median is 0.00 m off" in result.output
    equals = CliRunner().invoke(main, [*words, str(tmp_path / "b.csv"), "--scale=gps", "--json"])
    assert json.loads(equals.stdout)["gps"]["num_photos"] == 5
    three = CliRunner().invoke(main, [*words, str(tmp_path / "c.csv"), "--scale", "1.png", "2.png", "3"])
    assert three.exit_code == 0, three.output


def test_a_scene_without_positions_says_what_to_do(tmp_path: Path) -> None:
    scene = make_finished_scene(tmp_path / "made", folder="")
    words = ["export", str(scene.workspace), str(tmp_path / "a.csv"), "--for", "csv", "--scale", "gps"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 1
    assert "0 of 5 photos of the model have a GPS position" in result.output
    assert "--scale A B METRES" in result.output
    assert not (tmp_path / "a.csv").exists()
