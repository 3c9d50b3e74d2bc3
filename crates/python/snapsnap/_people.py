"""Photographs become people."""

from __future__ import annotations

import json
import os
import threading
from typing import Any, Sequence, Union

import numpy as np

from . import _native
from ._gaussians import Path, Person, of_native

# A path, a PIL picture, or an array [H,W], [H,W,3] or [H,W,4]: uint8, or floats from 0 to 1.
Picture = Union[Path, Any]


class Networks:
    """Networks on a device, for many people. `weights` is a file of `snapsnap import-weights`, or the package's own without one.
    `device` is auto, cpu, ndarray, or wgpu and what else `snapsnap doctor` lists."""

    def __init__(self, weights: Path | None = None, *, device: str = "auto") -> None:
        self._native = _native.Networks(None if weights is None else os.fspath(weights), device)

    def reconstruct(
        self,
        front: Picture,
        back: Picture,
        masks: Sequence[Picture] | None = None,
        *,
        cutout: str = "auto",
        strict: bool = False,
        height: float | None = None,
        focal: float | None = None,
        distance: float | None = None,
        elevation: float | None = None,
    ) -> Person:
        """The person in a front and a back photograph: paths, PIL pictures, or arrays.

        Two files in the wrong order are exchanged, with a warning; pictures in memory are not.

        masks      of front and back, white on the person; without them, transparency or a network separates the person
        cutout     auto, network (ignore transparency) or none (refuse a picture without mask and transparency)
        strict     raise InputError for photographs that look wrong, instead of `warnings`
        height     of the person in metres [1.72]
        focal      of both photographs in millimetres of 35 mm film [the files' own, else unknown]
        distance   of both cameras in metres, instead of `focal`
        elevation  how far the cameras look down at the person's middle, degrees [the files' own, else 8]
        """
        if masks is not None and len(masks) != 2:
            raise _native.InputError(f"masks: there are {len(masks)}, expected those of front and back")
        front_mask, back_mask = (None, None) if masks is None else masks
        arrays, report, cutouts = _native.reconstruct(
            self._native,
            (_photograph("front", front, front_mask), _photograph("back", back, back_mask)),
            cutout=cutout,
            strict=strict,
            height=height,
            focal=focal,
            distance=distance,
            elevation=elevation,
        )
        person: Person = of_native(Person, arrays)
        person.report = json.loads(report)
        person.warnings = person.report.pop("doubts")
        person.cutouts = [
            np.dstack([np.frombuffer(rgb, np.uint8).reshape(h, w, 3), np.frombuffer(mask, np.uint8).reshape(h, w)])
            for w, h, rgb, mask in cutouts
        ]
        return person


_networks: dict[tuple[str | None, str], Networks] = {}
_lock = threading.Lock()


def reconstruct(
    front: Picture, back: Picture, masks: Sequence[Picture] | None = None, *, weights: Path | None = None, device: str = "auto", **options: Any
) -> Person:
    """`Networks.reconstruct` with networks that stay loaded for the next call."""
    key = (None if weights is None else os.fspath(weights), device)
    with _lock:
        if key not in _networks:
            _networks.clear()
            _networks[key] = Networks(weights, device=device)
        networks = _networks[key]
    return networks.reconstruct(front, back, masks, **options)


def _is_path(picture: Picture) -> bool:
    return isinstance(picture, (str, os.PathLike))


def _photograph(name: str, picture: Picture, mask: Picture | None) -> tuple[Any, Any, Any]:
    """A photograph for the native half: path or name, pixels, path of the mask."""
    mask_path = os.fspath(mask) if mask is not None and _is_path(mask) else None
    if _is_path(picture):
        if mask is not None and mask_path is None:
            raise _native.InputError(f"{name}: its mask is an array, so the photograph must be an array or a PIL picture as well")
        return os.fspath(picture), None, mask_path
    pixels = _bytes(name, picture)
    height, width = pixels.shape[:2]
    alpha = None
    if mask is not None and mask_path is None:
        given = _bytes(f"{name}'s mask", mask)[..., 0]
        if given.shape != (height, width):
            raise _native.InputError(f"{name}: the mask has the shape {list(given.shape)}, its picture {[height, width]}")
        alpha = given.tobytes()
    elif mask is None and pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        alpha = pixels[..., 3].tobytes()
    return name, (pixels[..., :3].tobytes(), width, height, alpha), mask_path


def _bytes(name: str, picture: Picture) -> np.ndarray:
    """A picture in memory as uint8 [H,W,3] or [H,W,4]."""
    if hasattr(picture, "getexif"):
        from PIL import ImageOps

        # As a viewer shows it: a telephone stores how it was held.
        picture = ImageOps.exif_transpose(picture)
        picture = picture.convert("RGBA" if picture.has_transparency_data else "RGB")
    array = np.asarray(picture)
    if array.dtype == bool or np.issubdtype(array.dtype, np.floating):
        if array.size and not (np.isfinite(array).all() and 0 <= array.min() and array.max() <= 1):
            raise _native.InputError(f"{name}: floats must be from 0 to 1")
        array = np.rint(array * 255.0).astype(np.uint8)
    if array.dtype != np.uint8:
        raise _native.InputError(f"{name}: is of {array.dtype}, expected uint8, or floats from 0 to 1")
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise _native.InputError(f"{name}: has the shape {list(array.shape)}, expected [H,W], [H,W,3] or [H,W,4]")
    return np.repeat(array, 3, axis=2) if array.shape[2] == 1 else array
