"""Cameras and the differentiable rasteriser."""

from __future__ import annotations

import json
import os
import sys
from typing import Any, Sequence, Union

import numpy as np
from numpy.typing import ArrayLike

from . import _native
from ._gaussians import Path, floats

Cameras = Union[Path, Sequence[dict[str, Any]]]


def orbit(views: int, size: int | tuple[int, int] = 1024) -> list[dict[str, Any]]:
    """Cameras around a standing person, the first in front, for pictures of `size` pixels or (width, height)."""
    width, height = (size, size) if isinstance(size, int) else size
    made: list[dict[str, Any]] = json.loads(_native.orbit(views, width, height))
    return made


def cameras(viewmats: ArrayLike, Ks: ArrayLike, width: int, height: int) -> list[dict[str, Any]]:
    """Cameras from matrices as gsplat takes them: world to camera [V,4,4] with OpenCV's axes, and intrinsics [V,3,3] in pixels."""
    views, intrinsics = np.asarray(viewmats, np.float64), np.asarray(Ks, np.float64)
    if views.ndim != 3 or views.shape[1:] != (4, 4) or intrinsics.shape != (len(views), 3, 3):
        raise _native.InputError(
            f"viewmats and Ks: have the shapes {list(views.shape)} and {list(intrinsics.shape)}, expected [V,4,4] and [V,3,3]"
        )
    return [
        {
            "width": width, "height": height, "fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2],
            "world_to_camera": view.tolist(),
        }
        for view, k in zip(views, intrinsics)
    ]


def rasterize(
    means: Any,
    rotations: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    cameras: Cameras,
    *,
    background: Any = None,
    preset: str = "inria",
    antialiased: bool = False,
    depth: bool = False,
    device: str = "cpu",
) -> tuple[Any, Any, Any]:
    """Colour [V,H,W,3], alpha [V,H,W], and depth [V,H,W] (metres times alpha) or None.

    Takes arrays [N,3], [N,4], [N,3], [N], [N,3] as in `Gaussians`. With tensors of PyTorch it returns tensors that are differentiable in
    all of them and in `background` [3]. `preset` names the constants: inria, or gsplat (1.5).
    """
    inputs = [means, rotations, scales, opacities, colors, background]
    options = {"cameras": cameras, "preset": preset, "antialiased": antialiased, "depth": depth, "device": device}
    torch = sys.modules.get("torch")
    if torch is not None and any(isinstance(value, torch.Tensor) for value in inputs):
        from ._torch import Rasterize

        return Rasterize.apply(options, *inputs)
    return forward(inputs, options, gradients=False)[0]


def forward(inputs: Sequence[Any], options: dict[str, Any], *, gradients: bool) -> tuple[tuple[Any, Any, Any], Any]:
    """The outputs as arrays, and the tape of the backward pass."""
    means = floats("means", inputs[0], -1, 3)
    rows = len(means)
    arrays = (
        means.tobytes(),
        floats("rotations", inputs[1], rows, 4).tobytes(),
        floats("scales", inputs[2], rows, 3).tobytes(),
        floats("opacities", inputs[3], rows).tobytes(),
        floats("colors", inputs[4], rows, 3).tobytes(),
    )
    background = None if inputs[5] is None else floats("background", inputs[5], 3).tobytes()
    views, options = options["cameras"], {key: value for key, value in options.items() if key != "cameras"}
    is_file = isinstance(views, (str, os.PathLike))
    shape, color, alpha, depth, tape = _native.rasterize(
        arrays,
        cameras_json=None if is_file else json.dumps(list(views)),
        cameras_path=os.fspath(views) if is_file else None,
        background=background,
        gradients=gradients,
        **options,
    )
    image = lambda buffer, *channels: None if buffer is None else np.frombuffer(buffer, np.float32).reshape(*shape, *channels)
    return (image(color, 3), image(alpha), image(depth)), tape
