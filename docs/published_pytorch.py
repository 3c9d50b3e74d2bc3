"""Time of the point predictor of the published size in PyTorch, to compare with `snapsnap reconstruct -v`.

Random weights, inference mode, two photographs of 512x512 pixels. Encoder: 24 blocks of width 1024. Decoders: 2 x 12 blocks of
width 768. Heads: four, layer_dims 96/192/384/768, feature_dim 256, last_dim 128. --bf16 means torch.autocast(DEVICE,
torch.bfloat16) with images in channels-last order. The order of the 1x1 convolution and the enlargement in a fusion block is
the published one (enlarge first); --commute swaps them as snapsnap does. --device cuda measures an NVIDIA card, with --tf32 in
PyTorch's lower precision of f32 products.

    python docs/published_pytorch.py --threads 2 --runs 5 [--bf16] [--commute] [--device cuda [--tf32]]
"""

import argparse
import time

import torch
from torch import nn
from torch.nn.functional import interpolate, relu

import step_pytorch


def double(x):
    return interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


class ResidualConvUnit(nn.Module):
    def __init__(self, features):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x):
        return x + self.conv2(relu(self.conv1(relu(x))))


class Fusion(nn.Module):
    def __init__(self, features, commute):
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        self.unit1 = ResidualConvUnit(features)
        self.unit2 = ResidualConvUnit(features)
        self.commute = commute

    def forward(self, coarse, fine=None):
        x = coarse if fine is None else coarse + self.unit1(fine)
        x = self.unit2(x)
        return double(self.out_conv(x)) if self.commute else self.out_conv(double(x))


class Head(nn.Module):
    def __init__(self, commute, widths=(1024, 768, 768, 768), dims=(96, 192, 384, 768), features=256, last=128):
        super().__init__()
        first = [nn.Conv2d(w, d, 1) for w, d in zip(widths, dims)]
        self.branches = nn.ModuleList(
            [
                nn.Sequential(first[0], nn.ConvTranspose2d(dims[0], dims[0], 4, stride=4)),
                nn.Sequential(first[1], nn.ConvTranspose2d(dims[1], dims[1], 2, stride=2)),
                first[2],
                nn.Sequential(first[3], nn.Conv2d(dims[3], dims[3], 3, stride=2, padding=1)),
            ]
        )
        self.narrow = nn.ModuleList([nn.Conv2d(d, features, 3, padding=1, bias=False) for d in dims])
        self.fusions = nn.ModuleList([Fusion(features, commute) for _ in dims])
        self.out0 = nn.Conv2d(features, features // 2, 3, padding=1)
        self.out2 = nn.Conv2d(features // 2, last, 3, padding=1)
        self.out4 = nn.Conv2d(last, 4, 1)

    def forward(self, maps):
        fine = [narrow(branch(m)) for narrow, branch, m in zip(self.narrow, self.branches, maps)]
        path = self.fusions[3](fine[3])
        for i in (2, 1, 0):
            path = self.fusions[i](path, fine[i])
        return self.out4(relu(self.out2(double(self.out0(path)))))


def blocks(width, crossed, count):
    step_pytorch.WIDTH, step_pytorch.HEADS = width, width // 64
    return nn.ModuleList(step_pytorch.Block(crossed) for _ in range(count))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--bf16", action="store_true")
    parser.add_argument("--commute", action="store_true")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--tf32", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(1)
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = arguments.tf32
    torch.set_default_device(arguments.device)

    def now():
        if arguments.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    order = torch.channels_last if arguments.bf16 else torch.contiguous_format
    digits = 1 if arguments.device == "cuda" else 0
    grid = (32, 32)
    table = step_pytorch.tables(*grid, 64)
    with torch.inference_mode(), torch.autocast(arguments.device, torch.bfloat16, enabled=arguments.bf16):
        patches = nn.Conv2d(3, 1024, 16, 16)
        encoder, embed = blocks(1024, False, 24), nn.Linear(1024, 768)
        norm, last = nn.LayerNorm(1024, eps=1e-6), nn.LayerNorm(768, eps=1e-6)
        decoders = [blocks(768, True, 12) for _ in range(2)]
        heads = [Head(arguments.commute).eval().to(memory_format=order) for _ in range(4)]
        images = torch.randn(2, 3, 512, 512).contiguous(memory_format=order)
        for run in range(arguments.runs):
            times = [now()]
            x = patches(images).flatten(2).transpose(1, 2)
            for block in encoder:
                x = block(x, None, table)
            x = norm(x)
            times.append(now())
            pairs = [x.chunk(2)]
            pairs.append(tuple(embed(x) for x in pairs[0]))
            for first, second in zip(*decoders):
                x, y = pairs[-1]
                pairs.append((first(x, y, table), second(y, x, table)))
            pairs.append(tuple(last(x) for x in pairs.pop()))
            times.append(now())
            sides = [[pairs[i][side] for i in (0, 7, 10, 13)] for side in (0, 1)]
            fused = [(a + b) * 0.5 for a, b in zip(*sides)]
            for head, maps in zip(heads, (*sides, fused, fused)):
                head([m.transpose(1, 2).unflatten(2, grid) for m in maps])
            times.append(now())
            parts = [1e3 * (b - a) for a, b in zip(times, times[1:])]
            names = ("encoder", "decoders", "heads (4)")
            print(f"run {run}:", ", ".join(f"{n} {t:.{digits}f}" for n, t in zip(names, parts)) + f", all {sum(parts):.{digits}f} ms", flush=True)


if __name__ == "__main__":
    main()
