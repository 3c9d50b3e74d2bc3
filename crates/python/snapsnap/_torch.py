"""The rasteriser as a function of PyTorch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from . import _rasterize


class Rasterize(torch.autograd.Function):
    """`snapsnap.rasterize` of tensors: they are copied to the CPU and back."""

    @staticmethod
    def forward(ctx: Any, options: dict[str, Any], *inputs: Any) -> tuple[Any, Any, Any]:
        tensors = [value for value in inputs if isinstance(value, torch.Tensor)]
        ctx.device = tensors[0].device
        ctx.inputs = [(value.shape, value.dtype, value.device) if isinstance(value, torch.Tensor) else None for value in inputs]
        arrays = [value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value for value in inputs]
        outputs, ctx.tape = _rasterize.forward(arrays, options, gradients=any(ctx.needs_input_grad))
        color, alpha, depth = (None if value is None else torch.from_numpy(value).to(ctx.device) for value in outputs)
        return color, alpha, depth

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> tuple[Any, ...]:
        buffers = [None if value is None else value.detach().cpu().numpy().astype(np.float32).tobytes() for value in gradients]
        made = ctx.tape.backward(*buffers)
        result: list[Any] = [None]
        for known, wanted, buffer in zip(ctx.inputs, ctx.needs_input_grad[1:], made):
            if known is None or not wanted or buffer is None:
                result.append(None)
                continue
            shape, dtype, device = known
            result.append(torch.frombuffer(buffer, dtype=torch.float32).reshape(shape).to(device, dtype))
        return tuple(result)
