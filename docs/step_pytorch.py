"""A training step in PyTorch beside ours, on the same cores: a predictor and the regressor, in f32 and in bf16.

    pip install torch
    cargo bench --workspace --bench step --no-run       # prints the program's path
    python docs/step_pytorch.py PROGRAM [--threads 2] [--seconds 20] [--side 256] [--batch 2]
    python docs/step_pytorch.py PROGRAM --network default --side 128 --batch 4 [--wide]
    python docs/step_pytorch.py PROGRAM --memory [...]  # each network alone, and the most memory of its process

PyTorch's bf16 is torch.autocast("cpu", torch.bfloat16) with images and weights in channels-last order. --wide doubles all
widths of the default predictor. All networks are written in their plainest form with PyTorch's own operators: docs/method.md, "Point predictor" and
docs/method.md, "Gaussian regressor". The loss is the mean square of the output. Forward and backward, the fastest of all
repetitions; programs take turns.
"""

import argparse
import os
import resource
import subprocess
import sys
import time

import torch
from torch import nn
from torch.nn import functional

PATCH, CHANNELS = 16, 3
# Width, heads, blocks of the encoder and of each decoder, the four layers that the heads read; the heads' widths.
# The default's attention is that of its coarsest level: 6 blocks for the photographs, 4 for the sides.
NETWORKS = {
    "default": (128, 4, 6, 4, (), (32, 64, 96, 128), 0, 32),
    "small": (192, 3, 6, 4, (0, 2, 3, 4), (32, 64, 96, 128), 64, 32),
}
WIDTH, HEADS, ENCODER, DECODER, HOOKS, BRANCHES, FEATURES, LAST = NETWORKS["small"]


def tables(rows, columns, channels):
    """Cosines and sines of rotary positions: half of a head's channels turn with the row, half with the column."""
    quarter = channels // 4
    omega = 100.0 ** (-torch.arange(quarter, dtype=torch.float64) / quarter)
    angles = []
    for row in range(rows):
        for column in range(columns):
            parts = [torch.cat([place * omega] * 2) for place in (row, column)]
            angles.append(torch.cat(parts))
    angles = torch.stack(angles).float()
    return angles.cos(), angles.sin()


def rotate(x, cos, sin):
    """Turns members k and k + 1/4 of each half against each other."""
    b, h, n, d = x.shape
    halves = x.view(b, h, n, 2, 2, d // 4)
    swapped = torch.stack([-halves[..., 1, :], halves[..., 0, :]], -2).reshape(x.shape)
    return x * cos + swapped * sin


class Attention(nn.Module):
    def __init__(self, crossed):
        super().__init__()
        self.heads = HEADS
        widths = (WIDTH,) * 3 if crossed else (3 * WIDTH,)
        self.inputs = nn.ModuleList(nn.Linear(WIDTH, width) for width in widths)
        self.output = nn.Linear(WIDTH, WIDTH)

    def forward(self, x, y, table):
        if len(self.inputs) == 1:
            q, k, v = self.inputs[0](x).chunk(3, -1)
        else:
            q, k, v = (layer(t) for layer, t in zip(self.inputs, (x, y, y)))
        b, n, _ = x.shape
        q, k, v = (t.view(b, n, self.heads, -1).transpose(1, 2) for t in (q, k, v))
        out = functional.scaled_dot_product_attention(rotate(q, *table), rotate(k, *table), v)
        return self.output(out.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self, crossed):
        super().__init__()
        norm = lambda: nn.LayerNorm(WIDTH, eps=1e-6)
        self.norm1, self.own = norm(), Attention(False)
        if crossed:
            self.norm2, self.norm_y, self.other = norm(), norm(), Attention(True)
        self.norm3 = norm()
        self.mlp = nn.Sequential(nn.Linear(WIDTH, 4 * WIDTH), nn.GELU(), nn.Linear(4 * WIDTH, WIDTH))

    def forward(self, x, y, table):
        x = x + self.own(self.norm1(x), None, table)
        if y is not None:
            x = x + self.other(self.norm2(x), self.norm_y(y), table)
        return x + self.mlp(self.norm3(x))


def conv(inputs, outputs, side=3, stride=1, bias=True):
    return nn.Conv2d(inputs, outputs, side, stride, side // 2, bias=bias)


def double(x, align=True):
    return functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=align)


class Unit(nn.Module):
    def __init__(self, width):
        super().__init__()
        self.conv1, self.conv2 = conv(width, width), conv(width, width)

    def forward(self, x):
        return x + self.conv2(functional.relu(self.conv1(functional.relu(x))))


class Head(nn.Module):
    def __init__(self):
        super().__init__()
        self.narrow = nn.ModuleList(conv(WIDTH, width, 1) for width in BRANCHES)
        sizes = [
            nn.ConvTranspose2d(BRANCHES[0], BRANCHES[0], 4, 4),
            nn.ConvTranspose2d(BRANCHES[1], BRANCHES[1], 2, 2),
            nn.Identity(),
            conv(BRANCHES[3], BRANCHES[3], 3, 2),
        ]
        self.sizes = nn.ModuleList(sizes)
        self.common = nn.ModuleList(conv(width, FEATURES, bias=False) for width in BRANCHES)
        self.fine = nn.ModuleList(Unit(FEATURES) for _ in range(3))
        self.joined = nn.ModuleList(Unit(FEATURES) for _ in range(4))
        self.out = nn.ModuleList(conv(FEATURES, FEATURES, 1) for _ in range(4))
        self.head0, self.head2 = conv(FEATURES, FEATURES // 2), conv(FEATURES // 2, LAST)
        self.head4 = conv(LAST, 4, 1)

    def forward(self, maps, grid):
        maps = [m.transpose(1, 2).reshape(m.shape[0], WIDTH, *grid) for m in maps]
        layers = [c(s(n(m))) for c, s, n, m in zip(self.common, self.sizes, self.narrow, maps)]
        path = double(self.out[3](self.joined[3](layers[3])))
        for i in (2, 1, 0):
            path = double(self.out[i](self.joined[i](path + self.fine[i](layers[i]))))
        return self.head4(functional.relu(self.head2(double(self.head0(path)))))


class Predictor(nn.Module):
    def __init__(self, side):
        super().__init__()
        self.grid = (side // PATCH, side // PATCH)
        self.table = tables(*self.grid, WIDTH // HEADS)
        self.patches = nn.Conv2d(3, WIDTH, PATCH, PATCH)
        self.encoder = nn.ModuleList(Block(False) for _ in range(ENCODER))
        self.norm, self.embed = nn.LayerNorm(WIDTH, eps=1e-6), nn.Linear(WIDTH, WIDTH)
        self.decoders = nn.ModuleList(nn.ModuleList(Block(True) for _ in range(DECODER)) for _ in range(2))
        self.last = nn.LayerNorm(WIDTH, eps=1e-6)
        self.heads = nn.ModuleList(Head() for _ in range(4))

    def forward(self, images):
        x = self.patches(images).flatten(2).transpose(1, 2)
        for block in self.encoder:
            x = block(x, None, self.table)
        sides = [[part] for part in self.norm(x).chunk(2)]
        x, y = (self.embed(side[0]) for side in sides)
        for first, second in zip(*self.decoders):
            x, y = first(x, y, self.table), second(y, x, self.table)
            sides[0].append(x)
            sides[1].append(y)
        for side in sides:
            side[-1] = self.last(side[-1])
        fused = [(a + b) * 0.5 for a, b in zip(*sides)]
        return [
            head([maps[i] for i in HOOKS], self.grid)
            for head, maps in zip(self.heads, (*sides, fused, fused))
        ]


class Tokens(nn.Module):
    """Attention at the coarsest level of the convolutional body."""

    def __init__(self, inputs, depth):
        super().__init__()
        self.embed = nn.Linear(inputs, WIDTH)
        self.blocks = nn.ModuleList(Block(False) for _ in range(depth))
        self.norm, self.proj = nn.LayerNorm(WIDTH, eps=1e-6), nn.Linear(WIDTH, BRANCHES[3])

    def forward(self, tokens, table):
        tokens = self.embed(tokens)
        for block in self.blocks:
            tokens = block(tokens, None, table)
        return self.norm(tokens)

    def image(self, tokens, grid):
        return self.proj(tokens).transpose(1, 2).reshape(-1, BRANCHES[3], *grid)


class Decoder(nn.Module):
    def __init__(self):
        super().__init__()
        self.units = nn.ModuleList(Unit(width) for width in BRANCHES)
        self.up = nn.ModuleList(conv(b, a, 1) for a, b in zip(BRANCHES, BRANCHES[1:]))
        self.middle, self.out = conv(BRANCHES[0], LAST), conv(LAST, 8, 1)

    def forward(self, coarsest, images):
        x = self.units[3](coarsest + images[3])
        for level in (2, 1, 0):
            x = double(self.up[level](x), False) + images[level]
            x = self.units[level](x)
        return self.out(functional.relu(self.middle(functional.relu(x))))


class Convolutions(nn.Module):
    """The convolutional body, which reads both photographs together."""

    def __init__(self, side):
        super().__init__()
        self.grid = (side // PATCH, side // PATCH)
        self.table = tables(*self.grid, WIDTH // HEADS)
        self.first = conv(2 * CHANNELS, BRANCHES[0])
        self.units = nn.ModuleList(Unit(width) for width in BRANCHES)
        self.down = nn.ModuleList(conv(a, b, 3, 2) for a, b in zip(BRANCHES, BRANCHES[1:]))
        self.tokens, self.side_tokens = Tokens(BRANCHES[3], ENCODER), Tokens(WIDTH, DECODER)
        self.decoder, self.side_decoder = Decoder(), Decoder()

    def forward(self, images):
        x = self.first(torch.cat(images.chunk(2), 1))
        levels = []
        for level, unit in enumerate(self.units):
            if level > 0:
                x = self.down[level - 1](functional.relu(x))
            x = unit(x)
            levels.append(x)
        tokens = self.tokens(x.flatten(2).transpose(1, 2), self.table)
        rows = [level.mean(3, keepdim=True) for level in levels]
        front = self.decoder(self.tokens.image(tokens, self.grid), levels)
        side = self.side_tokens.image(self.side_tokens(tokens, self.table), self.grid)
        return [*front.chunk(2, 1), *self.side_decoder(side, rows).chunk(2, 1)]


class Residual(nn.Module):
    def __init__(self, inputs):
        super().__init__()
        self.norm1, self.conv1 = nn.GroupNorm(16, inputs), conv(inputs, 16)
        self.norm2, self.conv2 = nn.GroupNorm(16, 16), conv(16, 16)
        self.shortcut = conv(inputs, 16, 1) if inputs != 16 else nn.Identity()

    def forward(self, x):
        h = self.conv1(functional.silu(self.norm1(x)))
        h = self.conv2(functional.silu(self.norm2(h)))
        return (h + self.shortcut(x)) * 0.5**0.5


class Regressor(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv_in = conv(6, 16)
        self.down = nn.ModuleList(nn.ModuleList(Residual(16) for _ in range(2)) for _ in range(3))
        self.smaller = nn.ModuleList(conv(16, 16, 3, 2) for _ in range(2))
        self.middle = nn.ModuleList(Residual(16) for _ in range(2))
        self.up = nn.ModuleList(nn.ModuleList(Residual(32) for _ in range(3)) for _ in range(3))
        self.larger = nn.ModuleList(conv(16, 16) for _ in range(2))
        self.norm, self.conv_out, self.last = nn.GroupNorm(16, 16), conv(16, 14), conv(14, 14, 1)

    def forward(self, x):
        x = self.conv_in(x)
        kept = [x]
        for level, blocks in enumerate(self.down):
            for block in blocks:
                x = block(x)
                kept.append(x)
            if level < 2:
                x = self.smaller[level](x)
                kept.append(x)
        for block in self.middle:
            x = block(x)
        for level, blocks in enumerate(self.up):
            for block in blocks:
                x = block(torch.cat([x, kept.pop()], 1))
            if level < 2:
                x = self.larger[level](functional.interpolate(x, scale_factor=2, mode="nearest"))
        return [self.last(self.conv_out(functional.silu(self.norm(x))))]


def measure(network, images, seconds, half):
    """Fastest forward and backward in milliseconds, and how many there were."""
    best, count, end = (float("inf"), 0.0), 0, None
    while end is None or time.perf_counter() < end or count < 3:
        network.zero_grad()
        start = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            out = network(images)
        middle = time.perf_counter()
        sum(o.float().square().mean() for o in out).backward()
        times = (middle - start, time.perf_counter() - middle)
        if end is None:
            end = time.perf_counter() + seconds
            continue
        count += 1
        best = min(best, times, key=sum)
    return [1e3 * t for t in best], count


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("program")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=20)
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--network", choices=NETWORKS, default="small")
    parser.add_argument("--wide", action="store_true", help="twice the widths; the default predictor alone")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--only", choices=("predictor", "regressor"), help=argparse.SUPPRESS)
    a = parser.parse_args()
    global WIDTH, HEADS, ENCODER, DECODER, HOOKS, BRANCHES, FEATURES, LAST, PATCH, CHANNELS
    WIDTH, HEADS, ENCODER, DECODER, HOOKS, BRANCHES, FEATURES, LAST = NETWORKS[a.network]
    if a.wide:
        WIDTH, BRANCHES, LAST = 2 * WIDTH, tuple(2 * width for width in BRANCHES), 2 * LAST
    if a.network == "default":
        PATCH, CHANNELS = 8, 6
    torch.set_num_threads(a.threads)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: a.threads])
    body = Convolutions if a.network == "default" else Predictor
    predictor, images = body(a.side), torch.rand(2 * a.batch, CHANNELS, a.side, a.side)
    regressor, views = Regressor(), torch.rand(2, 6, a.side, a.side)
    networks = (("predictor", predictor, images), ("regressor", regressor, views))
    ours = [a.program, str(a.seconds), str(a.side), str(a.batch), a.network]
    ours += ["wide"] if a.wide else []
    if a.only:
        [(network, x)] = [(network, x) for name, network, x in networks if name == a.only]
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        measure(network, x, a.seconds, False)
        after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(f"{a.only}, PyTorch: {after} MB at most, {before} MB of it before the first step")
        return
    if a.memory:
        for name in ("predictor", "regressor"):
            subprocess.run([*ours, name], check=True)
            subprocess.run([sys.executable, *sys.argv, "--only", name], check=True)
        return
    print(f"PyTorch {torch.__version__}, {a.threads} threads")
    print(f"predictor: {sum(p.numel() for p in predictor.parameters()):,} parameters")
    for turn in range(2):
        for words in ((), ("bf16",)):
            print(subprocess.run([*ours, *words], capture_output=True, text=True, check=True).stdout.rstrip())
        for name, network, x in networks:
            for half in (False, True):
                order = torch.channels_last if half else torch.contiguous_format
                network, x = network.to(memory_format=order), x.contiguous(memory_format=order)
                (forward, backward), count = measure(network, x, a.seconds, half)
                print(
                    f"{name}, PyTorch, {'bf16' if half else 'f32'}: forward {forward:.0f} + backward {backward:.0f} = "
                    f"{forward + backward:.0f} ms, {count} runs",
                    flush=True,
                )


if __name__ == "__main__":
    main()
