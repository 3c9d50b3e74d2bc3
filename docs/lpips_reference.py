"""Distances of the `lpips` package between pictures and with weights that follow from a formula: the numbers of the test in
crates/eval/src/lpips.rs. Needs torch, torchvision and lpips from PyPI; nothing is downloaded."""

import lpips
import numpy as np
import torch


def numbers(stream, count):
    mask = np.uint64(0xFFFFFFFF)
    mixed = np.arange(count, dtype=np.uint64) * np.uint64(2654435761) + np.uint64(stream * 40503121 % 2**32)
    mixed &= mask
    mixed = ((mixed ^ (mixed >> np.uint64(15))) * np.uint64(2246822519)) & mask
    return (mixed ^ (mixed >> np.uint64(13))).astype(np.float64) / 2**32


def tensor(values, shape):
    return torch.tensor(values.astype(np.float32)).reshape(shape)


metric = lpips.LPIPS(net="alex", version="0.1", pretrained=False, pnet_rand=True, eval_mode=True, verbose=False)
convolutions = [m for m in metric.net.modules() if isinstance(m, torch.nn.Conv2d)]
with torch.no_grad():
    for i, (convolution, linear) in enumerate(zip(convolutions, metric.lins)):
        shape = convolution.weight.shape
        fan_in = shape[1] * shape[2] * shape[3]
        bound = np.sqrt(6.0 / fan_in)
        convolution.weight.copy_(tensor((2 * numbers(3 * i, shape[0] * fan_in) - 1) * bound, shape))
        convolution.bias.copy_(tensor(0.1 * (numbers(3 * i + 1, shape[0]) - 0.5), [shape[0]]))
        linear.model[1].weight.copy_(tensor(numbers(3 * i + 2, shape[0]), [1, shape[0], 1, 1]))

for h, w in [(64, 64), (31, 97), (256, 160)]:
    a, b = (tensor(numbers(stream, 3 * h * w), [1, 3, h, w]) for stream in (100, 101))
    # Half noise, half the same: not all pictures are as far apart as noise.
    b = 0.5 * a + 0.5 * b
    a.requires_grad_(True)
    distance = metric(a, b, normalize=True)
    distance.sum().backward()
    print(h, w, repr(distance.item()), repr(a.grad.double().norm().item()), repr(a.grad.double().sum().item()))
