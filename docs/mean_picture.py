"""What the mean picture of all training subjects, view by view, is worth on those set apart: a baseline that knows nobody's
pose, but no wrong colours either (masked PSNR as `train-stage2` prints it: inside the true mask and 8 pixels of 1024
around it, before black).

    pip install numpy pillow
    python docs/mean_picture.py people/synth people/makehuman

All data sets must have the same views (configs/data/small.toml).
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image


def load(path):
    """Colour before black and the mask of a view."""
    rgba = np.asarray(Image.open(path).convert("RGBA"), np.float32) / 255
    return rgba[..., :3] * rgba[..., 3:], rgba[..., 3] > 0


def around(mask):
    reach = -(-8 * mask.shape[0] // 1024)
    grown = np.pad(mask, reach)
    for axis in (0, 1):
        grown = np.any([np.roll(grown, d, axis) for d in range(-reach, reach + 1)], 0)
    return grown[reach:-reach, reach:-reach]


def subjects(split):
    return [folder for root in sys.argv[1:] for folder in sorted(Path(root, split, "img").iterdir())]


def psnr(square):
    return -10 * np.log10(square)


learned, shown = subjects("train"), subjects("val")
views = len(list(learned[0].glob("*.png")))
total, sides = [], []
means = [np.mean([load(folder / f"{view}.png")[0] for folder in learned], 0) for view in range(views)]
for folder in shown:
    squares = []
    for view in range(views):
        color, mask = load(folder / f"{view}.png")
        squares.append(np.mean((color - means[view])[around(mask)] ** 2))
    total.append(psnr(np.mean(squares)))
    sides.append(psnr(np.mean([squares[views // 4], squares[3 * views // 4]])))
print(f"{len(learned)} to learn from, {len(shown)} shown: {np.mean(total):.2f} dB, the two sides {np.mean(sides):.2f} dB")
