"""The operators of one training step of the small predictor, ours beside PyTorch's, forward and backward, each alone.

    pip install torch
    cargo bench --workspace --bench operators --no-run       # prints the program's path
    taskset -c 0,1 python docs/operators_pytorch.py PROGRAM [--threads 2] [--rounds 5] [--only NAME] [--check]

The predictor: images of 256x256 in batches of 2, patch 16, encoder 6 x 192, two decoders 4 x 192 (3 heads of 64), four DPT
heads (features 64, last 32, layers 32/64/96/128). A row is an operator with its shape and how often a step runs it. Rounds
alternate between the two programs and the fastest run of each counts, because others may run beside them. --check compares
values and all gradients with PyTorch's in f64 instead (relative L2 error).
"""
import argparse
import os
import subprocess
import tempfile
import time
from pathlib import Path

import torch
import torch.nn.functional as F

# name, sizes, how often. Sizes: see `build`.
ROWS = [
    ("conv3x3", (2, 32, 64, 64, 0, 0), 4),
    ("conv3x3", (2, 64, 64, 32, 0, 0), 4),
    ("conv3x3", (2, 96, 64, 16, 0, 0), 4),
    ("conv3x3", (2, 128, 64, 8, 0, 0), 4),
    ("conv3x3", (2, 64, 64, 8, 1, 1), 8),
    ("conv3x3", (2, 64, 64, 16, 1, 1), 16),
    ("conv3x3", (2, 64, 64, 32, 1, 1), 16),
    ("conv3x3", (2, 64, 64, 64, 1, 1), 16),
    ("conv3x3", (2, 64, 32, 128, 0, 1), 4),
    ("conv3x3", (2, 32, 32, 256, 0, 1), 4),
    ("conv1x1", (2, 192, 32, 16, 0), 4),
    ("conv1x1", (2, 192, 64, 16, 0), 4),
    ("conv1x1", (2, 192, 96, 16, 0), 4),
    ("conv1x1", (2, 192, 128, 16, 0), 4),
    ("conv1x1", (2, 64, 64, 8, 0), 4),
    ("conv1x1", (2, 64, 64, 16, 0), 4),
    ("conv1x1", (2, 64, 64, 32, 0), 4),
    ("conv1x1", (2, 64, 64, 64, 0), 4),
    ("conv1x1", (2, 32, 4, 256, 1), 4),
    ("halve", (2, 128, 128, 16), 4),
    ("resize", (2, 64, 8), 4),
    ("resize", (2, 64, 16), 4),
    ("resize", (2, 64, 32), 4),
    ("resize", (2, 64, 64), 4),
    ("resize", (2, 32, 128), 4),
    ("linear", (1024, 192, 576, 0), 6),
    ("linear", (1024, 192, 192, 0), 6),
    ("linear", (1024, 192, 768, 1), 6),
    ("linear", (1024, 768, 192, 0), 6),
    ("linear", (512, 192, 576, 0), 8),
    ("linear", (512, 192, 192, 0), 42),
    ("linear", (512, 192, 768, 1), 8),
    ("linear", (512, 768, 192, 0), 8),
    ("norm", (1024, 192), 13),
    ("norm", (512, 192), 34),
    ("attention", (4, 16, 16, 3, 64), 6),
    ("attention", (2, 16, 16, 3, 64), 16),
]


def rotate(x, cos, sin):
    """[B, heads, N, d]; halves (row, column) of two quarters each whose members pair up."""
    a, b, c, d = x.chunk(4, -1)
    return x * cos + torch.cat([b, a, d, c], -1) * sin


def tables(rows, columns, d, dtype):
    """cos, and sin with its sign: [N, d]."""
    quarter = d // 4
    omega = 100.0 ** (-torch.arange(quarter, dtype=torch.float64) / quarter)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    cos, sin = [], []
    for position in (y, x):
        angle = position.reshape(-1, 1) * omega
        cos += [angle.cos(), angle.cos()]
        sin += [-angle.sin(), angle.sin()]
    return torch.cat(cos, 1).to(dtype), torch.cat(sin, 1).to(dtype)


def build(name, size, dtype=torch.float32):
    """Tensors that are tracked, and the operator on them."""
    make = torch.Generator().manual_seed(1)
    random = lambda *shape: (torch.rand(*shape, generator=make) * 2 - 1).to(dtype).requires_grad_()
    if name == "conv3x3":
        b, i, o, h, rectified, biased = size
        inputs = [random(b, i, h, h), random(o, i, 3, 3)] + [random(o)] * biased
        run = lambda x, w, c=None: F.conv2d(F.relu(x) if rectified else x, w, c, padding=1)
    elif name == "conv1x1":
        b, i, o, h, rectified = size
        inputs = [random(b, i, h, h), random(o, i, 1, 1), random(o)]
        run = lambda x, w, c: F.conv2d(F.relu(x) if rectified else x, w, c)
    elif name == "halve":
        b, i, o, h = size
        inputs = [random(b, i, h, h), random(o, i, 3, 3), random(o)]
        run = lambda x, w, c: F.conv2d(x, w, c, stride=2, padding=1)
    elif name == "resize":
        b, c, h = size
        inputs = [random(b, c, h, h)]
        run = lambda x: F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
    elif name == "linear":
        rows, i, o, gelu = size
        inputs = [random(rows, i), (random(i, o).detach() * (3 / i) ** 0.5).requires_grad_(), random(o)]
        # PyTorch's own layout is [out, in].
        plain = lambda x, w, c: torch.addmm(c, x, w) if dtype == torch.float64 else F.linear(x, w, c)
        if dtype != torch.float64:
            inputs[1] = inputs[1].detach().t().contiguous().requires_grad_()
        run = (lambda x, w, c: F.gelu(plain(x, w, c))) if gelu else plain
    elif name == "norm":
        rows, c = size
        inputs = [random(rows, c), random(c), random(c)]
        run = lambda x, w, b: F.layer_norm(x, (c,), w, b, 1e-6)
    elif name == "attention":
        b, rows, columns, heads, d = size
        n = rows * columns
        inputs = [random(b, n, heads * d) for _ in range(3)]
        cos, sin = tables(rows, columns, d, dtype)
        split = lambda x: x.view(b, n, heads, d).transpose(1, 2)

        def run(q, k, v):
            q, k = rotate(split(q), cos, sin), rotate(split(k), cos, sin)
            return F.scaled_dot_product_attention(q, k, split(v)).transpose(1, 2).reshape(b, n, heads * d)
    return inputs, run


def time_torch(name, size, seconds):
    """Fastest forward and backward run in ms."""
    inputs, run = build(name, size)
    tracked = [x for x in inputs if x.requires_grad]
    gradient = torch.rand_like(run(*inputs).detach())
    forward = backward = 1e9
    end = time.perf_counter() + seconds
    count = 0
    while count < 3 or time.perf_counter() < end:
        a = time.perf_counter()
        y = run(*inputs)
        b = time.perf_counter()
        torch.autograd.grad(y, tracked, gradient)
        c = time.perf_counter()
        forward, backward, count = min(forward, b - a), min(backward, c - b), count + 1
    return forward * 1e3, backward * 1e3


class Ours:
    """The Rust benchmark: one line in, one line out."""

    def __init__(self, path):
        self.process = subprocess.Popen([path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def ask(self, *words):
        print(*words, file=self.process.stdin, flush=True)
        return self.process.stdout.readline().split()

    def time(self, name, size, seconds):
        return tuple(map(float, self.ask("time", seconds, name, *size)))

    def check(self, name, size, folder):
        inputs, run = build(name, size, torch.float64)
        # The operators see the same f32 values.
        inputs = [x.detach().float().double().requires_grad_(x.requires_grad) for x in inputs]
        y = run(*inputs)
        gradient = torch.rand_like(y.detach()).mul(2).sub(1).float().double()
        tracked = [x for x in inputs if x.requires_grad]
        expected = [y, *torch.autograd.grad(y, tracked, gradient)]
        for i, x in enumerate([*inputs, gradient]):
            x.detach().float().numpy().tofile(Path(folder) / f"in{i}")
        count = int(self.ask("check", folder, name, *size)[0])
        assert count == len(expected), (count, len(expected))
        errors = []
        for i, x in enumerate(expected):
            got = torch.from_file(str(Path(folder) / f"out{i}"), size=x.numel(), dtype=torch.float32).double().view(x.shape)
            errors.append(float((got - x.detach()).norm() / x.detach().norm()))
        return errors


def main():
    parse = argparse.ArgumentParser()
    parse.add_argument("program")
    parse.add_argument("--rounds", type=int, default=5)
    parse.add_argument("--seconds", type=float, default=0.1)
    parse.add_argument("--only", default="")
    parse.add_argument("--check", action="store_true")
    parse.add_argument("--threads", type=int, default=2)
    arguments = parse.parse_args()
    torch.set_num_threads(arguments.threads)
    os.environ["RAYON_NUM_THREADS"] = str(arguments.threads)
    ours = Ours(arguments.program)
    rows = [row for row in ROWS if arguments.only in row[0]]
    if arguments.check:
        with tempfile.TemporaryDirectory() as folder:
            for name, size, _ in rows:
                print(f"{name:10} {str(size):28}", *(f"{e:.1e}" for e in ours.check(name, size, folder)), flush=True)
        return
    print("| operator | shape | count | ours forward | backward | PyTorch forward | backward | ratio |\n|---|---|---|---|---|---|---|---|")
    best = {row: [[1e9, 1e9], [1e9, 1e9]] for row in rows}
    # Rounds are outermost, so that a busy moment of the machine meets every row once instead of one row always.
    for _ in range(arguments.rounds):
        for name, size, count in rows:
            sides = best[name, size, count]
            for side, run in enumerate([ours.time, time_torch]):
                sides[side] = [min(old, new) for old, new in zip(sides[side], run(name, size, arguments.seconds))]
    total, families = [0.0, 0.0], {}
    for (name, size, count), ((a, b), (c, d)) in best.items():
        for sums in (total, families.setdefault(name, [0.0, 0.0])):
            sums[0] += count * (a + b)
            sums[1] += count * (c + d)
        print(f"| {name} | {size} | {count} | {a:.3f} | {b:.3f} | {c:.3f} | {d:.3f} | {(a + b) / (c + d):.2f} |")
    for name, sums in [*families.items(), ("all", total)]:
        print(f"{name}: ours {sums[0]:.1f} ms, PyTorch {sums[1]:.1f} ms, ratio {sums[0] / sums[1]:.2f}")


if __name__ == "__main__":
    main()
