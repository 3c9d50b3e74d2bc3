"""How the error of a photograph's depth falls with training, with network size and with what the network is shown
(docs/notes/people.md): one network in PyTorch, on a GPU or a CPU.

    python docs/scaling_pytorch.py people/makers --inputs photographs --width 4 --minutes 5 --device cuda

The folder holds `prepare`'s data sets synth, makehuman and avatars (configs/studies/makers.sh makes them). A sample is a pair of photographs,
front and back, at 128². The network predicts each pixel's depth, measured from the upright plane through the body's axis. It receives both
outlines, the pixel's place, which of the two photographs it is, and:

outline      nothing else
photographs  both photographs, each with a random exposure of 0.7 stops
head         the same; it also predicts the normals, as a second output with a loss of its own
clay         white clay under one lamp that never changes, in place of the photographs
normals      the true normals of its own photograph

Learning rates are constant and fall to 1 % within the last fifth of the time. Errors are those of averaged weights.
"""

import argparse, concurrent.futures, multiprocessing, pathlib, time
import torch
import torch.nn.functional as F
from colors_pytorch import Net, load

PLANES = {"outline": 0, "photographs": 6, "head": 6, "clay": 2, "normals": 3}
UNIT = 20  # The network's unit is 5 cm.


def inputs(kind, data, rows, gains):
    """(B,C,H,W) of the photographs `rows`; the other photograph of the pair is mirrored, so that limbs stand at the same place."""
    color, mask, _, normals = data
    other = rows ^ 1
    size = mask.shape[-1]
    line = torch.linspace(-1, 1, size, device=mask.device)
    front = (1 - 2.0 * (rows % 2))[:, None, None].expand(-1, size, size)
    planes = [mask[rows].float(), mask[other].flip(-1).float(), front, line.expand(len(rows), size, size), line[:, None].expand(len(rows), size, size)]
    light = F.normalize(torch.tensor([0.5, -0.6, -0.6], device=mask.device), dim=0)
    clay = lambda at: torch.einsum("bihw,i->bhw", normals[at].float(), light)[:, None].clamp_min(0)
    more = {
        "outline": lambda: [],
        "photographs": lambda: [color[rows].float() * gains[0], color[other].flip(-1).float() * gains[1]],
        "clay": lambda: [clay(rows), clay(other).flip(-1)],
        "normals": lambda: [normals[rows].float()],
    }["photographs" if kind == "head" else kind]()
    return torch.cat([torch.stack(planes, 1), *more], 1)


def mirrored(x, which):
    """Mirrors the samples `which` of inputs or targets (B,...,H,W)."""
    return torch.where(which.view(-1, *[1] * (x.ndim - 1)), x.flip(-1), x)


def error(model, kind, data, precision):
    """Mean error of the depth over all photographs, mm."""
    _, mask, depth, _ = data
    total = 0.0
    gains = [torch.ones(1, 1, 1, 1, device=mask.device)] * 2
    with torch.no_grad():
        for rows in torch.arange(len(mask), device=mask.device).split(64):
            with precision():
                out = model(inputs(kind, data, rows, gains).contiguous(memory_format=torch.channels_last))[:, 0].float()
            off = (out / UNIT - depth[rows].float()).abs() * mask[rows]
            total += (off.sum((1, 2)) / mask[rows].sum((1, 2))).sum().item()
    return 1000 * total / len(mask)


def study(kind, options, train, held_out):
    torch.manual_seed(0)
    device = options.device
    precision = lambda: torch.autocast(device, torch.bfloat16)
    net = Net(5 + PLANES[kind], [options.width * w for w in (8, 16, 32, 64, 96)], 4 if kind == "head" else 1)
    net = net.to(device, memory_format=torch.channels_last)
    average = torch.optim.swa_utils.AveragedModel(net, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.998))
    optimizer = torch.optim.AdamW(net.parameters(), lr=options.rate, weight_decay=0.02)
    size = sum(p.numel() for p in net.parameters()) / 1e6

    def report(samples, seconds):
        print(f"{kind}, {size:.2f} M parameters, {samples} samples, {seconds:.0f} s: training people "
              f"{error(average, kind, [part[:512] for part in train], precision):.2f} mm, others "
              f"{error(average, kind, held_out, precision):.2f} mm", flush=True)

    start, paused, steps, share, due = time.monotonic(), 0.0, 0, 0.0, 4096
    while share < 1:
        seconds = time.monotonic() - start - paused
        share = seconds / (60 * options.minutes)
        for group in optimizer.param_groups:
            group["lr"] = options.rate * min(1, (steps + 1) / 100) * min(1, 0.01 + (1 - share) * 5)
        rows = torch.randint(len(train[1]), (options.batch,), device=device)
        gains = [2 ** (1.4 * torch.rand(options.batch, 1, 1, 1, device=device) - 0.7) for _ in range(2)]
        flip = torch.rand(options.batch, device=device) < 0.5
        x = mirrored(inputs(kind, train, rows, gains), flip)
        # A mirrored normal points to the other side; a pixel's place stays that of the picture.
        if kind == "normals":
            x[:, 5] = torch.where(flip[:, None, None], -x[:, 5], x[:, 5])
        x[:, 3] = torch.where(flip[:, None, None], -x[:, 3], x[:, 3])
        mask, depth = mirrored(train[1][rows], flip), mirrored(train[2][rows], flip).float()
        with precision():
            out = net(x.contiguous(memory_format=torch.channels_last)).float()
        loss = ((out[:, 0] - depth * UNIT).abs() * mask).sum() / mask.sum()
        if kind == "head":
            normals = mirrored(train[3][rows], flip).float()
            normals[:, 0] = torch.where(flip[:, None, None], -normals[:, 0], normals[:, 0])
            loss = loss + ((out[:, 1:] - normals).abs().sum(1) * mask).sum() / mask.sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        average.update_parameters(net)
        steps += 1
        if steps * options.batch >= due:
            before = time.monotonic()
            report(steps * options.batch, seconds)
            paused += time.monotonic() - before
            due *= 2
    report(steps * options.batch, seconds)


def both(folder, split, views):
    """Photographs as fronts and backs in turn, of all makers; each maker is read by a process of its own."""
    makers = [maker for maker in ("synth", "makehuman", "avatars") if (folder / maker / split).is_dir()]
    # A forked process would wait for threads of PyTorch that it does not have.
    with concurrent.futures.ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        parts = [pool.submit(load, folder, split, 128, views, (maker,)) for maker in makers]
        parts = [part.result() for part in parts]
    color, mask, relief, normals, coarse = (torch.cat([part[at] for part in parts]) for at in range(5))
    return color, mask, relief + coarse, normals


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--inputs", choices=list(PLANES), nargs="+", default=list(PLANES))
    parser.add_argument("--width", type=int, default=1, help="factor of the channels")
    parser.add_argument("--minutes", type=float, default=4, help="wall-clock time of each training")
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--kept", type=pathlib.Path, help="file that keeps the data as tensors for further runs")
    options = parser.parse_args()
    if options.kept and options.kept.exists():
        train, held_out = torch.load(options.kept)
    else:
        train, held_out = both(options.folder, "train", (0, 1, 4, 5)), both(options.folder, "val", (0, 1))
        if options.kept:
            torch.save((train, held_out), options.kept)
    train, held_out = ([part.to(options.device) for part in data] for data in (train, held_out))
    mean = lambda data: 1000 * ((data[2].float().abs() * data[1]).sum((1, 2)) / data[1].sum((1, 2))).mean().item()
    print(f"{len(train[1])} photographs to train on, {len(held_out[1])} others; the plane alone: {mean(held_out):.2f} mm", flush=True)
    for kind in options.inputs:
        study(kind, options, train, held_out)


if __name__ == "__main__":
    main()
