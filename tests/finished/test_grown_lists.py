"""The list of photos of a scene grows by new ones."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from photos import write_photos

from corrsfm.config import ImagesConfig
from corrsfm.finished.grown_lists import grown_index
from corrsfm.images.cache import PhotoCache
from corrsfm.images.index import index_images
from corrsfm.workspace.lists import Index


def test_masks_of_photos_that_were_converted_keep_the_names_of_the_photos(tmp_path: Path) -> None:
    names = write_photos(tmp_path / "photos", 3)
    records, cameras = index_images(tmp_path / "photos", ImagesConfig(), photos=names[:2])
    (tmp_path / "masks").mkdir()
    mask = f"{Path(names[0]).stem}.heic.png"
    cv2.imwrite(str(tmp_path / "masks" / mask), np.full((8, 8), 255, np.uint8))
    records[0] = dataclasses.replace(records[0], mask=mask, mask_sha256="of the mask")
    grown = grown_index(
        Index(records=tuple(records), cameras=tuple(cameras)),
        {names[2]: tmp_path / "photos" / names[2]},
        tmp_path / "photos",
        ImagesConfig(mask_dir=tmp_path / "masks"),
        PhotoCache(tmp_path / "cache.json"),
    )
    assert [record.mask for record in grown.records] == [mask, None, None]
