"""Gaussians, people and meshes as NumPy arrays."""

from __future__ import annotations

import os
import warnings
from typing import Any, Sequence, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native

Floats = NDArray[np.float32]
Path = Union[str, "os.PathLike[str]"]


def floats(name: str, values: ArrayLike, *shape: int) -> Floats:
    """`values` as contiguous float32 of this shape; -1 stands for any length."""
    array = np.ascontiguousarray(values, dtype=np.float32)
    if array.ndim != len(shape) or any(want not in (-1, have) for have, want in zip(array.shape, shape)):
        wanted = "[" + ",".join("N" if side < 0 else str(side) for side in shape) + "]"
        raise _native.InputError(f"{name}: has the shape {list(array.shape)}, expected {wanted}")
    return array


class Gaussians:
    """N anisotropic 3D Gaussians with one colour each, in a world with y up.

    means      [N,3] centres, metres
    scales     [N,3] standard deviations along the rotated axes, metres
    rotations  [N,4] unit quaternions (w, x, y, z)
    opacities  [N]   0 to 1
    colors     [N,3] red, green, blue, 0 to 1
    """

    means: Floats
    scales: Floats
    rotations: Floats
    opacities: Floats
    colors: Floats

    def __init__(
        self, means: ArrayLike, scales: ArrayLike, rotations: ArrayLike, opacities: ArrayLike, colors: ArrayLike
    ) -> None:
        self.means = floats("means", means, -1, 3)
        self.scales = floats("scales", scales, len(self.means), 3)
        self.rotations = floats("rotations", rotations, len(self.means), 4)
        self.opacities = floats("opacities", opacities, len(self.means))
        self.colors = floats("colors", colors, len(self.means), 3)

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {len(self)} Gaussians>"

    def _bytes(self) -> tuple[bytes, bytes, bytes, bytes, bytes]:
        n = len(self)
        # Checked again: the arrays may have been replaced.
        return (
            floats("means", self.means, n, 3).tobytes(),
            floats("rotations", self.rotations, n, 4).tobytes(),
            floats("scales", self.scales, n, 3).tobytes(),
            floats("opacities", self.opacities, n).tobytes(),
            floats("colors", self.colors, n, 3).tobytes(),
        )

    def save(self, path: Path, *, y_down: bool = False) -> None:
        """Writes a .ply, .spz, .glb (KHR_gaussian_splatting) or .sog, whole or not at all. `y_down` writes a PLY for viewers that expect
        the axes of INRIA's scenes, such as SuperSplat."""
        _native.write(os.fspath(path), self._bytes(), y_down)

    def render(
        self,
        cameras: Union[Path, Sequence[dict[str, Any]]],
        *,
        background: ArrayLike | None = None,
        device: str = "cpu",
    ) -> Floats:
        """Pictures [V,H,W,3] from `cameras`: a list as `snapsnap.orbit` makes, or the path of a cameras.json. Without a `background`
        (red, green, blue) it is black."""
        from ._rasterize import rasterize

        return rasterize(
            self.means, self.rotations, self.scales, self.opacities, self.colors, cameras, background=background, device=device
        )[0]

    def mesh(self, *, faces: int = 100_000, texture: int = 2048, device: str = "cpu") -> Mesh:
        """One closed surface with about `faces` triangles (0: all) and a texture of `texture` pixels (0: colours of positions)."""
        return Mesh(_native.mesh(self._bytes(), faces=faces, texture=texture, device=device))


class Person(Gaussians):
    """A person made of photographs.

    warnings  doubts about the photographs, as sentences
    cutouts   front and back [H,W,4] uint8 without their backgrounds
    report    what was done to each photograph, cameras, steps, and seconds of each step
    """

    warnings: list[str]
    cutouts: list[NDArray[np.uint8]]
    report: dict[str, Any]


class Mesh:
    """A closed triangle mesh.

    positions  [P,3] metres
    faces      [F,3] uint32 rows of positions, counter-clockwise from outside
    colors     [P,3] of the positions, or None with a texture
    texcoords  [F,3,2] of the faces' corners, (0, 0) at the texture's lower left, or None
    texture    [H,W,3] uint8, or None
    """

    def __init__(self, native: _native.Mesh) -> None:
        self._native = native
        self.positions = np.frombuffer(native.positions(), np.float32).reshape(-1, 3)
        self.faces = np.frombuffer(native.faces(), np.uint32).reshape(-1, 3)
        texture = native.texture()
        self.texture = self.texcoords = self.colors = None
        if texture is None:
            self.colors = np.frombuffer(native.colors(), np.float32).reshape(-1, 3)
        else:
            width, height, pixels = texture
            self.texture = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
            self.texcoords = np.frombuffer(native.texcoords(), np.float32).reshape(-1, 3, 2)

    def __repr__(self) -> str:
        return f"<Mesh of {len(self.faces)} triangles>"

    def save(self, path: Path) -> None:
        """Writes a .glb, .obj or .ply as the mesh was made; changes of the arrays are not saved."""
        self._native.save(os.fspath(path))


def of_native(kind: type[Gaussians], arrays: Sequence[bytearray]) -> Any:
    """Gaussians of the native half's arrays."""
    means, rotations, scales, opacities, colors = (np.frombuffer(array, np.float32) for array in arrays)
    rows = len(opacities)
    return kind(means.reshape(rows, 3), scales.reshape(rows, 3), rotations.reshape(rows, 4), opacities, colors.reshape(rows, 3))


def load(path: Path) -> Gaussians:
    """The Gaussians of a .ply, .spz or .glb, with colours as seen from everywhere (SH degree 0)."""
    arrays, degree = _native.read(os.fspath(path))
    if degree > 0:
        warnings.warn(f"{os.fspath(path)}: colours of SH degree {degree} become those of degree 0", stacklevel=2)
    return of_native(Gaussians, arrays)
