"""Time of the four DPT heads at full size in PyTorch, to compare with the line "heads (4)" of `snapsnap reconstruct -v`.

Random weights, float32, inference mode, one image (batch 1): 512x512 pixels, 32x32 tokens of 1024, 768, 768 and 768
channels, layer_dims 96/192/384/768, feature_dim 256, last_dim 128. The order of the 1x1 convolution and the enlargement
in a fusion block is the published one (enlarge first); --commute swaps them as snapsnap does.

    taskset -c 2,3 python heads_pytorch.py --threads 2 --runs 5 [--commute]
"""

import argparse
import time

import torch
from torch import nn
from torch.nn.functional import interpolate, relu


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--commute", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(1)
    with torch.inference_mode():
        heads = [Head(arguments.commute).eval() for _ in range(4)]
        maps = [torch.randn(1, c, 32, 32) for c in (1024, 768, 768, 768)]
        for run in range(arguments.runs):
            begin = time.perf_counter()
            for head in heads:
                head(maps)
            print(f"run {run}: heads (4) {1e3 * (time.perf_counter() - begin):.0f} ms", flush=True)


if __name__ == "__main__":
    main()
