"""Shape from shading (docs/notes/people.md): one small network in PyTorch, trained for the same time on different inputs.

    python docs/colors_pytorch.py people/makers --size 128 --minutes 4

Minutes are those of the processor, all threads together.

The folder holds `prepare`'s data sets synth, makehuman and avatars (configs/studies/makers.sh makes them). Each front and back photograph
is a sample by itself. The network predicts its relief: the depth without the coarse body, which is the mean depth of cells of 14 cm,
interpolated between them. It trains on windows of 128 pixels. Its input is the outline, the pixel's place, the coarse body, and:

outline      nothing else
photographs  the photograph with a random exposure of 0.7 stops
plain        cloth and skin of one random colour under one to three random lamps and a sky, without shadows
clay         white clay under one lamp that never changes
normals      the true normals
"""

import argparse, json, math, pathlib, time
import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

PLANES = {"outline": 0, "photographs": 3, "plain": 3, "clay": 1, "normals": 3}


def photograph(folder, person, view, camera):
    """Colour (3,H,W), mask (H,W), depth beside the plane in metres (H,W) and normals in the camera's frame (3,H,W)."""
    rgba = np.asarray(Image.open(folder / "img" / person / f"{view}.png"), np.float32) / 255
    depth = next(iter(np.load(folder / "depth" / person / f"{view}.npz").values())).astype(np.float64)
    height, width = depth.shape
    columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([(columns - camera["cx"]) / camera["fx"], (rows - camera["cy"]) / camera["fy"], np.ones_like(depth)])
    pose = np.array(camera["world_to_camera"])
    # The plane through the axis x = z = 0 that faces the camera, in the camera's frame.
    forward = pose[2, :3] * [1, 0, 1]
    normal = pose[:3, :3] @ (forward / np.linalg.norm(forward))
    plane = normal @ pose[:3, 3] / np.einsum("i,ihw->hw", normal, ray)
    valid = depth > 0
    points = ray * depth
    across = slope(points, valid, 2)
    down = slope(points, valid, 1)
    normals = np.cross(across, down, axis=0)
    length = np.linalg.norm(normals, axis=0)
    known = valid & (length > 0)
    normals = np.where(known, normals / np.maximum(length, 1e-12), 0)
    normals *= np.where((normals * ray).sum(0) > 0, -1, 1)
    color = rgba[..., :3].transpose(2, 0, 1) * valid
    return color, valid, np.where(valid, depth - plane, 0), normals


def slope(points, valid, axis):
    """Difference of neighbouring points along an axis, of the nearer neighbour where the surface breaks (by 4 cm)."""
    after = np.roll(points, -1, axis) - points
    before = points - np.roll(points, 1, axis)
    whole = lambda step, shift: np.roll(valid, shift, axis - 1) & valid & (np.abs(step[2]) < 0.04)
    a, b = whole(after, -1), whole(before, 1)
    return np.where(a & b, after + before, np.where(a, after, np.where(b, before, 0)))


def load(folder, split, size, views, makers=("synth", "makehuman", "avatars")):
    kept = []
    for maker in makers:
        for path in sorted((folder / maker / split / "cameras").glob("*.json")):
            cameras = json.loads(path.read_text())
            for view in views:
                color, valid, depth, normals = photograph(folder / maker / split, path.stem, view, cameras[view])
                step = color.shape[-1] // size
                block = lambda x: x.reshape(*x.shape[:-2], size, step, size, step).sum((-3, -1))
                count = block(valid.astype(np.float64))
                mask = count >= step * step / 2
                mean = lambda x: (block(x) / np.maximum(count, 1) * mask).astype(np.float16)
                kept.append((mean(color), mask, mean(depth), mean(normals), maker))
    stack = lambda at: torch.from_numpy(np.stack([row[at] for row in kept]))
    color, mask, depth, normals = (stack(at) for at in range(4))
    coarse = body(depth, mask)
    return color, mask, depth - coarse, normals, coarse, [row[4] for row in kept]


def body(depth, mask):
    """Mean depth of cells of 14 cm, interpolated between the cells that have pixels."""
    size = mask.shape[-1]
    cells = [F.avg_pool2d(x[:, None].float(), size // 16) for x in (depth * mask, mask)]
    whole = [F.interpolate(x, size=(size, size), mode="bilinear") for x in cells]
    return ((whole[0] / whole[1].clamp_min(1e-6))[:, 0] * mask).to(depth.dtype)


class Net(torch.nn.Module):
    """A U-shaped network of five levels. (B,planes,H,W) -> (B,outputs,H,W)."""

    def __init__(self, planes, widths=(8, 16, 32, 64, 96), outputs=1):
        super().__init__()
        block = lambda a, b: torch.nn.Sequential(
            torch.nn.Conv2d(a, b, 3, padding=1), torch.nn.GroupNorm(8, b), torch.nn.GELU(),
            torch.nn.Conv2d(b, b, 3, padding=1), torch.nn.GroupNorm(8, b), torch.nn.GELU())
        self.down = torch.nn.ModuleList([block(a, b) for a, b in zip((planes, *widths), widths)])
        self.up = torch.nn.ModuleList([block(a + b, b) for a, b in zip(widths[1:], widths)])
        self.last = torch.nn.Conv2d(widths[0], outputs, 1)

    def forward(self, x):
        kept = []
        for level, block in enumerate(self.down):
            x = block(F.avg_pool2d(x, 2) if level else x)
            kept.append(x)
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([F.interpolate(x, scale_factor=2.0, mode="nearest"), kept[level]], 1))
        return self.last(x)


def shade(normals, random):
    """Light on normals (B,3,H,W) by one to three lamps and a sky, of a contrast from 1.2 to 6."""
    batch = len(normals)
    uniform = lambda *shape: torch.rand(*shape, generator=random)
    out = (0.6 - 0.4 * normals[:, 1]) * uniform(batch, 1, 1)
    lamps = uniform(batch, 3) * (torch.arange(3) < 1 + torch.floor(3 * uniform(batch, 1)))
    for lamp in range(3):
        toward = torch.nn.functional.normalize(torch.randn(batch, 3, generator=random) - torch.tensor([0, 0.7, 0.7]), dim=1)
        out = out + lamps[:, lamp, None, None] * torch.einsum("bihw,bi->bhw", normals, toward).clamp_min(0)
    return out[:, None] / out.amax((1, 2))[:, None, None, None]


def inputs(kind, color, mask, normals, coarse, place, random):
    batch = len(mask)
    uniform = lambda *shape: torch.rand(*shape, generator=random)
    gain = 2 ** (1.4 * uniform(batch, 1, 1, 1) - 0.7)
    light = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, -0.6]), dim=0)
    more = {
        "outline": lambda: [],
        "photographs": lambda: [color * gain],
        "plain": lambda: [uniform(batch, 3, 1, 1) * shade(normals, random)],
        "clay": lambda: [torch.einsum("bihw,i->bhw", normals, light)[:, None].clamp_min(0)],
        "normals": lambda: [normals],
    }[kind]()
    return torch.cat([mask[:, None].float(), *[m * mask[:, None] for m in [place, 10 * coarse[:, None], *more]]], 1)


def window(data, rows, random):
    """A window of 128 pixels around a random pixel of each person."""
    size, side = data[1].shape[-1], 128
    line = torch.linspace(-1, 1, size)
    place = torch.stack([line.expand(size, size), line[:, None].expand(size, size)])
    cut = []
    for row in rows:
        at = data[1][row].nonzero()
        at = at[torch.randint(len(at), (), generator=random)]
        y, x = ((at - side // 2).clamp(0, size - side)).tolist()
        cut.append([part[..., y : y + side, x : x + side] for part in (*(data[k][row] for k in range(5)), place)])
    return [torch.stack(parts) for parts in zip(*cut)]


def study(kind, options, train, held_out):
    torch.manual_seed(0)
    random = torch.Generator().manual_seed(1)
    net = Net(4 + PLANES[kind]).to(memory_format=torch.channels_last)
    average = torch.optim.swa_utils.AveragedModel(net, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.99))
    optimizer = torch.optim.AdamW(net.parameters(), lr=2e-3, weight_decay=0.02)

    def predict(model, color, mask, _, normals, coarse, place):
        x = inputs(kind, color.float(), mask, normals.float(), coarse.float(), place, random)
        with torch.autocast("cpu", torch.bfloat16):
            return model(x.contiguous(memory_format=torch.channels_last))[:, 0].float()

    start, steps, share = time.process_time(), 0, 0.0
    while share < 1:
        share = (time.process_time() - start) / (60 * options.minutes)
        for group in optimizer.param_groups:
            group["lr"] = 2e-3 * min(1, (steps + 1) / 50) * (0.01 + 0.99 * (1 + math.cos(math.pi * min(share, 1))) / 2)
        sample = window(train, torch.randint(len(train[1]), (8,), generator=random).tolist(), random)
        error = (predict(net, *sample) - sample[2].float() * 20).abs() * sample[1]
        loss = error.sum() / sample[1].sum()
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        average.update_parameters(net)
        steps += 1
    figures = {}
    random.manual_seed(2)
    line = torch.linspace(-1, 1, options.size)
    place = torch.stack([line.expand(options.size, options.size), line[:, None].expand(options.size, options.size)])
    with torch.no_grad():
        for row, maker in enumerate(held_out[5]):
            sample = [part[row][None] for part in held_out[:5]]
            error = (predict(average, *sample, place[None])[0] / 20 - sample[2][0].float()).abs()[sample[1][0]]
            figures.setdefault((maker, "front" if row % 2 == 0 else "back"), []).append(1000 * error.mean().item())
    means = {key: sum(row) / len(row) for key, row in figures.items()}
    print(f"{options.size}² {kind}: {steps} steps, {sum(p.numel() for p in net.parameters()) / 1e6:.2f} M parameters; mm:",
          ", ".join(f"{maker} {side} {value:.1f}" for (maker, side), value in means.items()),
          f"; mean {sum(means.values()) / len(means):.2f}", flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--minutes", type=float, default=4)
    parser.add_argument("--inputs", choices=list(PLANES), nargs="+", default=list(PLANES))
    options = parser.parse_args()
    train = load(options.folder, "train", options.size, (0, 1, 4, 5))
    held_out = load(options.folder, "val", options.size, (0, 1))
    relief = [1000 * depth[mask].float().abs().mean().item() for mask, depth in zip(held_out[1], held_out[2])]
    print(f"{options.size}² the coarse body alone: {sum(relief) / len(relief):.2f} mm", flush=True)
    for kind in options.inputs:
        study(kind, options, train, held_out)


if __name__ == "__main__":
    main()
