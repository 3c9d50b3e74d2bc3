"""Cut-outs of made people in front of backgrounds (docs/notes/photographs.md): IoU and boundary IoU of what `reconstruct --save-cutouts` writes.

    snapsnap prepare avatars AVATARS --split test --subjects 5 --seed 5 --config configs/data/evaluation.toml --set views.count=2 -o people/cut
    pip install numpy pillow scipy scikit-image scikit-learn
    python docs/cutouts_study.py people/cut/test path/to/snapsnap OUT

Each of the five people stands in front of two backgrounds out of focus: photographs of scikit-image and scikit-learn, darker or brighter than
the person. Then they stand before hard ones: walls of the colour of their shirts, photographs in focus, and a smaller person. OUT receives
the pictures.
"""

import pathlib, subprocess, sys
import numpy as np
from PIL import Image, ImageFilter
from scipy import ndimage
import skimage, sklearn.datasets

SIDE = 1024
BACKGROUNDS = [("brick", 1.0), ("china", 1.0), ("grass", 0.7), ("motorcycle_left", 1.0), ("gravel", 1.3), ("rocket", 1.5),
               ("coffee", 0.8), ("china", 0.5), ("flower", 0.8), ("wall", 1.0)]
HARD = ["shirt", "shirt", "shirt", "shirt", "motorcycle_left", "motorcycle_left", "china", "flower", "person", "person"]


def photograph(name, gain, blur):
    folders = [pathlib.Path(skimage.__file__).parent / "data", pathlib.Path(sklearn.datasets.__file__).parent / "images"]
    path = next(p for folder in folders for p in folder.glob(f"{name}.*"))
    picture = Image.open(path).convert("RGB")
    scale = SIDE / min(picture.size)
    picture = picture.resize([round(side * scale) for side in picture.size], Image.LANCZOS)
    picture = picture.crop((0, 0, SIDE, SIDE)).filter(ImageFilter.GaussianBlur(blur))
    return np.clip(np.asarray(picture, np.float64) * gain, 0, 255)


def wall(upper, lower, seed):
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    values = np.where(y[..., None] > 0.82, np.array(lower) + 20 * x[..., None], np.array(upper) * (1 - 0.12 * x[..., None]))
    return np.clip(values + np.random.default_rng(seed).normal(0, 4, (SIDE, SIDE, 3)), 0, 255)


def put(person, behind):
    share = person[..., 3:] / 255
    return share * person[..., :3] + (1 - share) * behind


def hard(name, person, other):
    if name == "shirt":
        rows = np.flatnonzero((person[..., 3] > 127).any(1))
        chest = person[rows[0] + (rows[-1] - rows[0]) * 3 // 10 :][: SIDE // 10]
        color = np.median(chest[chest[..., 3] > 200], 0)[:3]
        return wall(color, 0.8 * color, 1)
    if name == "person":
        small = Image.fromarray(other.astype(np.uint8)).resize((SIDE * 7 // 10,) * 2)
        behind = np.zeros((SIDE, SIDE, 4))
        behind[SIDE // 6 : SIDE // 6 + small.height, : small.width // 2] = np.asarray(small)[:, small.width // 4 :][:, : small.width // 2]
        return put(behind, wall((170, 160, 150), (120, 90, 70), 2))
    return photograph(name, 1.0, 1.0)


def scores(found, truth):
    """IoU, and IoU of the pixels within 5 of the outlines (Cheng et al., "Boundary IoU", 2021)."""
    a, b = found > 0.5, truth > 0.5
    rim = lambda m: m & ~ndimage.binary_erosion(m, iterations=5)
    iou = lambda a, b: (a & b).sum() / max((a | b).sum(), 1)
    return iou(a, b), iou(rim(a), rim(b))


def cut_out(program, out, label, persons, backgrounds, names):
    paths, truths, rows = [], [], []
    for person, behind, name in zip(persons, backgrounds, names):
        paths.append(out / f"{label}-{len(paths)}-{name}.jpg")
        truths.append(person[..., 3] / 255)
        Image.fromarray(put(person, behind).round().astype(np.uint8)).save(paths[-1], quality=92)
    command = [program, "reconstruct", *paths, "-o", out / "human.ply", "--save-cutouts", out / f"cut-{label}", "--quiet"]
    subprocess.run(command, check=True)
    for path, truth, side in zip(paths, truths, ("front", "back")):
        cut = np.asarray(Image.open(out / f"cut-{label}" / f"{side}.png"))[..., 3] / 255
        rows.append(scores(cut, truth))
        print(path.stem, *(f"{value:.3f}" for value in rows[-1]), flush=True)
    return rows


def main():
    people, program, out = pathlib.Path(sys.argv[1]), sys.argv[2], pathlib.Path(sys.argv[3])
    out.mkdir(parents=True, exist_ok=True)
    names = sorted(p.name for p in (people / "img").iterdir())

    def seen(i, view):
        picture = Image.open(people / "img" / names[i] / f"{view}.png").convert("RGBA").resize((SIDE, SIDE))
        return np.asarray(picture, np.float64)

    for kind in ("soft", "hard"):
        rows = []
        for i in range(5):
            pair = [seen(i, view) for view in range(2)]
            if kind == "soft":
                labels, gains = zip(*BACKGROUNDS[2 * i : 2 * i + 2])
                behind = [wall((200, 190, 180), (120, 90, 70), 0) if name == "wall" else photograph(name, gain, 6) for name, gain in zip(labels, gains)]
            else:
                labels = HARD[2 * i : 2 * i + 2]
                behind = [hard(name, person, seen((i + 1) % 5, 0)) for name, person in zip(labels, pair)]
            rows += cut_out(program, out, f"{kind}-{i}", pair, behind, labels)
        groups = {"all": rows} if kind == "soft" else {"all": rows, "shirt": rows[:4], "in focus": rows[4:8], "person": rows[8:]}
        for name, part in groups.items():
            print(f"{kind}, {name}: mean", *(f"{value:.3f}" for value in np.mean(part, 0)), "least", *(f"{value:.3f}" for value in min(part)))


main()
