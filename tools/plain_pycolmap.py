"""Plain pycolmap in steps, each a process of its own for `tools/whole_scenes.py`.

    python tools/plain_pycolmap.py match IMAGES DATABASE [--high]
    python tools/plain_pycolmap.py verify DATABASE VERIFIED --seed 0 [--high]
    python tools/plain_pycolmap.py map VERIFIED IMAGES MODEL --cameras one --mapper global --seed 0 [--high]

Without --high all options are pycolmap's defaults: up to 8,192 SIFT features, all pairs, SIMPLE_RADIAL
cameras. With --high they are what COLMAP's automatic reconstruction sets for quality High: affine shapes,
photos up to 2,400 px, guided matching, and in incremental mapping 30 and 75 iterations of local and
global bundle adjustment and 3 local refinements. Global mapping comes after `calibrate_view_graph`, as
there, because focal lengths are not known. Everything runs on one thread of the processor.
"""

import argparse
import shutil
import tempfile
from pathlib import Path

import corrsfm  # noqa: F401 – before pycolmap, see its top

import pycolmap  # isort: skip

CAMERA_MODES = {"one": pycolmap.CameraMode.SINGLE, "each": pycolmap.CameraMode.PER_IMAGE}


def _matching_options(high: bool) -> pycolmap.FeatureMatchingOptions:
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = 1
    options.guided_matching = high
    return options


def match(images: Path, database: Path, *, high: bool) -> None:
    """Extract features and match all pairs; verification is left to the seeds."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = 1
    if high:
        extraction.max_image_size = 2400
        extraction.sift.estimate_affine_shape = True
    pycolmap.extract_features(
        database,
        images,
        camera_mode=CAMERA_MODES["each"],
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
    matching = _matching_options(high)
    matching.skip_geometric_verification = True
    pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)


def verify(database: Path, verified: Path, *, seed: int, high: bool) -> None:
    """Verify the matches of a copy of a database, and with ``high`` match again along epipolar lines.

    With ``high`` the outcome is the same for every seed: pycolmap 4.2.1 was seen not to heed it there.
    """
    shutil.copy(database, verified)
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = seed
    if high:
        # Matches that are there are not sought again: this verifies them and adds the guided ones.
        pycolmap.match_exhaustive(
            verified,
            matching_options=_matching_options(high),
            verification_options=geometry,
            device=pycolmap.Device.cpu,
        )
    else:
        verifier = pycolmap.GeometricVerifierOptions()
        verifier.num_threads = 1
        pycolmap.geometric_verification(verified, verifier, two_view_geometry_options=geometry)


def with_cameras(verified: Path, images: Path, mode: pycolmap.CameraMode, output: Path) -> None:
    """Write a database with the verified matches of another, and its photos' cameras set up in a mode.

    Focal lengths are not known before or after, so verification would find the same.
    """
    # Database.open makes the file that import_images wants.
    pycolmap.Database.open(output).close()
    pycolmap.import_images(output, images, camera_mode=mode)
    with pycolmap.Database.open(verified) as old, pycolmap.Database.open(output) as new:
        if any(camera.has_prior_focal_length for camera in old.read_all_cameras()):
            raise ValueError(f"{images}: photos with EXIF have to be verified with their cameras")
        ids = {image.name: image.image_id for image in new.read_all_images()}
        # With one camera pycolmap leaves out photos of another size.
        old_to_new = {image.image_id: ids[image.name] for image in old.read_all_images() if image.name in ids}
        for old_id, new_id in old_to_new.items():
            new.write_keypoints(new_id, old.read_keypoints(old_id))
        for first, second in ((i, j) for i in old_to_new for j in old_to_new if i < j):
            pair = old_to_new[first], old_to_new[second]
            if old.exists_matches(first, second):
                new.write_matches(*pair, old.read_matches(first, second))
            if old.exists_two_view_geometry(first, second):
                new.write_two_view_geometry(*pair, old.read_two_view_geometry(first, second))


def map_models(
    database: Path, images: Path, output: Path, *, mapper: str, seed: int, high: bool
) -> dict[int, pycolmap.Reconstruction]:
    """Map a database of its own, which global mapping changes."""
    pycolmap.set_random_seed(seed)
    if mapper == "global":
        calibration = pycolmap.ViewGraphCalibrationOptions()
        calibration.random_seed = seed
        pycolmap.calibrate_view_graph(database, calibration)
        general = pycolmap.GlobalPipelineOptions()
        general.num_threads = general.mapper.num_threads = 1
        general.random_seed = general.mapper.random_seed = seed
        for part in ("rotation_averaging", "global_positioning", "retriangulation"):
            getattr(general.mapper, part).random_seed = seed
        return pycolmap.global_mapping(database, images, output, general)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    if high:
        options.ba_local_max_num_iterations = 30
        options.ba_local_max_refinements = 3
        options.ba_global_max_num_iterations = 75
    return pycolmap.incremental_mapping(database, images, output, options)


def write_largest(
    verified: Path, images: Path, model: Path, *, cameras: str, mapper: str, seed: int, high: bool
) -> None:
    """Map verified matches and write the model with most photos, if there is one."""
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        with_cameras(verified, images, CAMERA_MODES[cameras], database)
        models = map_models(database, images, Path(folder) / "out", mapper=mapper, seed=seed, high=high)
    if models:
        model.mkdir(parents=True, exist_ok=True)
        largest = max(models.values(), key=lambda one: (one.num_reg_images(), one.num_points3D()))
        largest.write_binary(model)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("step", choices=["match", "verify", "map"])
    parser.add_argument("paths", type=Path, nargs="+")
    parser.add_argument("--high", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cameras", choices=list(CAMERA_MODES), default="one")
    parser.add_argument("--mapper", choices=["incremental", "global"], default="incremental")
    options = parser.parse_args()
    pycolmap.logging.minloglevel = 2
    if options.step == "match":
        match(*options.paths, high=options.high)
    elif options.step == "verify":
        verify(*options.paths, seed=options.seed, high=options.high)
    else:
        write_largest(
            *options.paths,
            cameras=options.cameras,
            mapper=options.mapper,
            seed=options.seed,
            high=options.high,
        )


if __name__ == "__main__":
    main()
