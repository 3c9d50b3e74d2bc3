"""How far the silhouettes of right and of wrong pairs of photographs overlap (docs/notes/photographs.md):

    python docs/silhouettes_study.py people/held/synth people/held/makehuman people/held/avatars

The folders are data sets of views around a person (configs/data/evaluation.toml), whose first view is the front. Each front is compared with
its own back, with that of another person and with its own back mirrored, by two measures: both silhouettes scaled to their boxes, and both
scaled to one height and shifted to where they overlap most, as `reconstruct` does.
"""

import pathlib, random, sys
import numpy as np
from PIL import Image

GRID = 64


def silhouette(path):
    """The person's pixels within their box, and the width of the cells of a grid in the box's height."""
    mask = np.array(Image.open(path).convert("RGBA"))[..., 3] >= 128
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    return mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def cells(length, count):
    return ((2 * np.arange(count) + 1) * length / (2 * count)).astype(int)


def boxed(mask):
    return mask[np.ix_(cells(mask.shape[0], GRID), cells(mask.shape[1], GRID))]


def tall(mask):
    height, width = mask.shape
    columns = (width / 2 + (np.arange(2 * GRID) + 0.5 - GRID) * height / GRID).astype(int)
    out = np.zeros((GRID, 2 * GRID), bool)
    inside = (columns >= 0) & (columns < width)
    out[:, inside] = mask[np.ix_(cells(height, GRID), columns[inside])]
    return np.pad(out, ((0, 0), (GRID, GRID)))


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def main():
    people = [path for folder in sys.argv[1:] for path in sorted(pathlib.Path(folder, "test", "img").iterdir())]
    views = [len(list(person.glob("*.png"))) for person in people]
    fronts = [silhouette(person / "0.png") for person in people]
    backs = [silhouette(person / f"{count // 2}.png")[:, ::-1] for person, count in zip(people, views)]
    others = list(range(len(people)))
    random.seed(1)
    random.shuffle(others)
    pairs = {
        "own back": backs,
        "another's back": [backs[other] for other in others],
        "own back, mirrored": [back[:, ::-1] for back in backs],
    }
    best = lambda a, b: max(overlap(a, np.roll(b, shift, 1)) for shift in range(-GRID // 2, GRID // 2 + 1))
    for name, measure, least in (("boxes", lambda a, b: overlap(boxed(a), boxed(b)), 0.55), ("one height", lambda a, b: best(tall(a), tall(b)), 0.6)):
        for which, seconds in pairs.items():
            found = np.array([measure(front, second) for front, second in zip(fronts, seconds)])
            print(f"{name}, {which}: least {found.min():.2f}, median {np.median(found):.2f}, {(found < least).sum()} of {len(found)} below {least}")


if __name__ == "__main__":
    main()
