"""Times of gsplat on the scenes of `cargo bench --workspace --bench splat`, to compare on the same NVIDIA card.

The scene: N Gaussians on an ellipsoid with a person's height, one camera of the training orbit, a standard deviation of `sigma`
pixels. Its random numbers are PyTorch's. gsplat also counts tiles that only the box around a splat touches, so that it has more
intersections. Each figure is the median of at least three runs after one warm-up, with the card synchronised before and after. The
backward pass is that of a weighted sum of the picture.

    python docs/splat_gsplat.py [--n 400000] [--size 1024] [--views 1] [--sigma 1.0]
"""

import argparse
import math
import statistics
import time

import gsplat
import torch

SECONDS_PER_FIGURE = 1.5


def human(n, size, sigma, device):
    def uniform(columns, low, high):
        return torch.rand(n, columns, device=device) * (high - low) + low

    y, angle = uniform(1, -1.0, 1.0), uniform(1, 0.0, math.tau)
    across = (1.0 - y.square()).sqrt()
    means = torch.cat([across * angle.cos() * 0.64, y * 0.9 + 0.85, across * angle.sin() * 0.3], 1)
    scale = uniform(1, 0.8, 1.25) * (sigma * 2.0 / (0.8 * size))
    scales = torch.cat([scale, scale, scale * 0.5], 1)
    return [means, uniform(4, -1.0, 1.0), scales, uniform(1, 0.3, 1.0)[:, 0], uniform(3, 0.0, 1.0)]


def cameras(count, size, device):
    """World-to-camera matrices and intrinsics: 2 m from (0, 0.85, 0), 8 degrees of downward pitch."""
    matrices = []
    pitch = math.radians(8.0)
    for i in range(count):
        yaw = math.tau * i / count
        back = torch.tensor([math.sin(yaw) * math.cos(pitch), math.sin(pitch), math.cos(yaw) * math.cos(pitch)])
        right = torch.tensor([math.cos(yaw), 0.0, -math.sin(yaw)])
        down = torch.linalg.cross(-back, right)
        rotation = torch.stack([right, down, -back])
        centre = torch.tensor([0.0, 0.85, 0.0]) + 2.0 * back
        matrix = torch.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ centre
        matrices.append(matrix)
    middle = size / 2
    intrinsics = torch.tensor([[0.8 * size, 0, middle], [0, 0.8 * size, middle + 25 / 1024 * size], [0, 0, 1]])
    return torch.stack(matrices).to(device), intrinsics.expand(count, 3, 3).contiguous().to(device)


def measure(prepare, part):
    times, begin = [], time.perf_counter()
    while len(times) < 4 or (time.perf_counter() - begin < SECONDS_PER_FIGURE and len(times) < 50):
        given = prepare()
        torch.cuda.synchronize()
        start = time.perf_counter()
        part(given)
        torch.cuda.synchronize()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times[1:])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--n", type=int, default=400_000)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--sigma", type=float, default=1.0)
    arguments = parser.parse_args()
    torch.manual_seed(7)
    inputs = human(arguments.n, arguments.size, arguments.sigma, "cuda")
    views, intrinsics = cameras(arguments.views, arguments.size, "cuda")

    def render():
        return gsplat.rasterization(*inputs, views, intrinsics, arguments.size, arguments.size, packed=False)

    def loss():
        return (render()[0] * 0.5).sum()

    with torch.no_grad():
        count = render()[2]["flatten_ids"].numel()
        forward = measure(lambda: None, lambda _: render())
    print(f"{torch.cuda.get_device_name()}, gsplat {gsplat.__version__}, {count / 1e6:.2f} M intersections")
    print(f"nothing tracked: forward {forward:.2f} ms")
    for name, tracked in (("colours", inputs[4:]), ("everything", inputs)):
        for tensor in inputs:
            tensor.requires_grad_(any(tensor is t for t in tracked))
        forward = measure(lambda: None, lambda _: render())
        backward = measure(loss, lambda value: value.backward())
        print(f"{name} tracked: forward {forward:.2f}, backward {backward:.2f} ms")


if __name__ == "__main__":
    main()
