"""Figures of scikit-image, scipy and trimesh, which the metrics are held to: writes
tests/data/metrics/expected.json and the meshes beside it. Needs numpy, scipy, scikit-image, trimesh, rtree, torch,
torchvision and lpips from PyPI; nothing is downloaded.

    python docs/metrics_reference.py
"""

import json
from pathlib import Path

import numpy as np
import trimesh
from lpips_reference import numbers
from PIL import Image
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

ROOT = Path(__file__).parent.parent
OUT = ROOT / "tests/data/metrics"


def noise(stream, h, w):
    return np.floor(256 * numbers(stream, 3 * h * w)).astype(np.uint8).reshape(h, w, 3)


def slope(h, w):
    y, x, c = np.meshgrid(np.arange(h), np.arange(w), np.arange(3), indexing="ij")
    return ((2 * x + y + 40 * c) % 256).astype(np.uint8)


def people(x, y, w, h):
    """A part of the sheet of people, which is in the repository."""
    return np.asarray(Image.open(ROOT / "tests/data/metrics/people.png").convert("RGB"))[y : y + h, x : x + w]


def figures(a, b, inside=None):
    """Of two float pictures in [0, 1]; `inside` says which pixels count."""
    with np.errstate(divide="ignore"):
        if inside is None:
            psnr = peak_signal_noise_ratio(b, a, data_range=1)
            ssim = structural_similarity(a, b, data_range=1, channel_axis=2)
        else:
            psnr = -10 * np.log10(((a - b)[inside] ** 2).mean())
            _, values = structural_similarity(a, b, data_range=1, channel_axis=2, full=True)
            inner = np.zeros_like(inside)
            inner[3:-3, 3:-3] = inside[3:-3, 3:-3]
            ssim = values[inner].mean()
    return psnr, ssim


h, w = 256, 160
cases = {
    "noise": (noise(1, h, w), noise(2, h, w)),
    "noise on a slope": (slope(h, w), (slope(h, w) // 2 + noise(3, h, w) // 2)),
    "flat and slope": (np.full((h, w, 3), 77, np.uint8), slope(h, w)),
    "flat and flat": (np.full((h, w, 3), 77, np.uint8), np.full((h, w, 3), 80, np.uint8)),
    "people, shifted": (people(11, 40, w, h), people(10, 40, w, h)),
    "other people": (people(300, 40, w, h), people(20, 40, w, h)),
    "large": (people(0, 0, 600, 512), people(2, 1, 600, 512)),
}
expected = {"pictures": {}}
for name, (a8, b8) in cases.items():
    a, b = a8.astype(np.float64) / 255, b8.astype(np.float64) / 255
    height, width = b.shape[:2]
    psnr, ssim = figures(a, b)
    # The paper's window: 1000 × 500 of 1024, around the box of what is not exactly black, pushed inside.
    lit = np.argwhere((b8 != 0).any(axis=2))
    (top, left), (bottom, right) = lit.min(0), lit.max(0)
    wh, ww = min(round(1000 * height / 1024), height), min(round(500 * height / 1024), width)
    y = min(max((top + bottom) // 2 - wh // 2, 0), height - wh)
    x = min(max((left + right) // 2 - ww // 2, 0), width - ww)
    paper = figures(a[y : y + wh, x : x + ww], b[y : y + wh, x : x + ww])
    # The mask: a disc, with 8 pixels of 1024 around it.
    rows, columns = np.ogrid[:height, :width]
    mask = (rows - height // 2) ** 2 + (columns - width // 3) ** 2 < (width // 4) ** 2
    margin = -(-8 * height // 1024)
    inside = ndimage.binary_dilation(mask, np.ones((2 * margin + 1, 2 * margin + 1)))
    masked = figures(a, b, inside)
    expected["pictures"][name] = {
        "all": [psnr, ssim],
        "paper": [*paper, int(x), int(y), ww, wh],
        "mask": [*masked, int(inside.sum())],
    }

points = lambda stream, n: (2 * numbers(stream, 3 * n) - 1).reshape(n, 3).astype(np.float32)
a, b = points(1, 500), points(2, 800) * np.float32([0.5, 1.2, 0.8])
expected["chamfer"] = [float(cKDTree(b).query(a)[0].mean()), float(cKDTree(a).query(b)[0].mean())]

torus = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
(OUT / "torus.obj").write_text(torus.export(file_type="obj", digits=6))
torus = trimesh.load(OUT / "torus.obj", process=False)
_, distances, _ = trimesh.proximity.closest_point(torus, a.astype(np.float64))
expected["point_to_surface"] = float(distances.mean())

motion = trimesh.transformations.rotation_matrix(np.radians(12), [0.2, 1.0, -0.4]) 
motion[:3, 3] = [0.05, -0.1, 0.08]
cloud = points(5, 600)
moved = trimesh.transform_points(cloud, motion).astype(np.float32)
matrix, _, cost = trimesh.registration.icp(cloud, moved, threshold=1e-12, max_iterations=100, reflection=False, scale=False)
expected["icp"] = {"motion": motion.tolist(), "found": np.asarray(matrix).tolist(), "cost": float(cost)}

OUT.mkdir(parents=True, exist_ok=True)
(OUT / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
print(json.dumps(expected, indent=1))
