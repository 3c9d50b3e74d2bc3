"""Distances of the `lpips` package between pictures that follow from a formula: with weights that do too, the numbers of the tests in
crates/eval/src/lpips.rs; with torchvision's AlexNet (a .pth or .safetensors file of its `features`), the value that published weights
are known by. Needs torch, torchvision and lpips from PyPI; nothing is downloaded.

    python docs/lpips_reference.py [ALEXNET]
"""

import sys

import lpips
import numpy as np
import torch


def numbers(stream, count):
    """Numbers in [0, 1) that any language makes alike."""
    mask = np.uint64(0xFFFFFFFF)
    mixed = np.arange(count, dtype=np.uint64) * np.uint64(2654435761) + np.uint64(stream * 40503121 % 2**32)
    mixed &= mask
    mixed = ((mixed ^ (mixed >> np.uint64(15))) * np.uint64(2246822519)) & mask
    return (mixed ^ (mixed >> np.uint64(13))).astype(np.float64) / 2**32


def tensor(values, shape):
    return torch.tensor(values.astype(np.float32)).reshape(shape)


def convolutions(metric):
    return [m for m in metric.net.modules() if isinstance(m, torch.nn.Conv2d)]


def formula():
    """The metric with weights that follow from a formula."""
    metric = lpips.LPIPS(net="alex", version="0.1", pretrained=False, pnet_rand=True, eval_mode=True, verbose=False)
    with torch.no_grad():
        for i, (convolution, linear) in enumerate(zip(convolutions(metric), metric.lins)):
            shape = convolution.weight.shape
            fan_in = shape[1] * shape[2] * shape[3]
            bound = np.sqrt(6.0 / fan_in)
            convolution.weight.copy_(tensor((2 * numbers(3 * i, shape[0] * fan_in) - 1) * bound, shape))
            convolution.bias.copy_(tensor(0.1 * (numbers(3 * i + 1, shape[0]) - 0.5), [shape[0]]))
            linear.model[1].weight.copy_(tensor(numbers(3 * i + 2, shape[0]), [1, shape[0], 1, 1]))
    return metric


def published(path):
    """The metric with published weights: the package's learned layers, and AlexNet's from a file."""
    if path.endswith(".safetensors"):
        from safetensors.torch import load_file

        weights = load_file(path)
    else:
        weights = torch.load(path, map_location="cpu")
    metric = lpips.LPIPS(net="alex", version="0.1", pretrained=True, pnet_rand=True, eval_mode=True, verbose=False)
    with torch.no_grad():
        for place, convolution in zip([0, 3, 6, 8, 10], convolutions(metric)):
            convolution.weight.copy_(weights[f"features.{place}.weight"])
            convolution.bias.copy_(weights[f"features.{place}.bias"])
    return metric


if __name__ == "__main__":
    metric = published(sys.argv[1]) if len(sys.argv) > 1 else formula()
    for h, w in [(64, 64), (31, 97), (256, 160)]:
        a, b = (tensor(numbers(stream, 3 * h * w), [1, 3, h, w]) for stream in (100, 101))
        # Half noise, half the same: not all pictures are as far apart as noise.
        b = 0.5 * a + 0.5 * b
        print(h, w, repr(metric(a, b, normalize=True).item()))
