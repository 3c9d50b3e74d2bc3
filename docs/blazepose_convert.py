"""Converts BlazePose (full), the network that finds a person's joints and pixels, from TensorFlow Lite to
assets/weights/blazepose.safetensors, and writes the output that the tests compare with.

    pip install numpy pillow tflite ai-edge-litert
    pip download --no-deps mediapipe==0.10.14 && unzip -j mediapipe-*.whl mediapipe/modules/pose_landmark/pose_landmark_full.tflite
    python docs/blazepose_convert.py pose_landmark_full.tflite

The convolutions keep their order and their f16 weights: `convolutions.0` to `convolutions.93`. The heat maps and the joints in metres are
left out.
"""

import pathlib, sys
import numpy as np
import tflite
from ai_edge_litert.interpreter import Interpreter
from network_files import ROOT, photograph, save

LICENSE = "Apache-2.0, BlazePose (Bazarevsky et al. 2020, https://github.com/google-ai-edge/mediapipe), from mediapipe 0.10.14"
SIDE, LEFT_OUT = 256, ([39, 1, 1, 48], [117, 2, 2, 288])


def weights(path):
    """Kernels [outputs, inputs of a group, rows, columns] and biases, in the order of the graph."""
    model = tflite.Model.GetRootAs(path.read_bytes(), 0)
    graph, halves, tensors = model.Subgraphs(0), {}, {}
    for node in (graph.Operators(i) for i in range(graph.OperatorsLength())):
        code = model.OperatorCodes(node.OpcodeIndex())
        kind = max(code.BuiltinCode(), code.DeprecatedBuiltinCode())
        if kind == tflite.BuiltinOperator.DEQUANTIZE:
            halves[node.Outputs(0)] = graph.Tensors(node.Inputs(0))
        elif kind in (tflite.BuiltinOperator.CONV_2D, tflite.BuiltinOperator.DEPTHWISE_CONV_2D):
            kernel, bias = (halves[node.Inputs(i)] for i in (1, 2))
            if kernel.ShapeAsNumpy().tolist() in LEFT_OUT:
                continue
            axes = (0, 3, 1, 2) if kind == tflite.BuiltinOperator.CONV_2D else (3, 0, 1, 2)
            values = [np.frombuffer(model.Buffers(t.Buffer()).DataAsNumpy(), "<f2").reshape(t.ShapeAsNumpy()) for t in (kernel, bias)]
            name = f"convolutions.{len(tensors) // 2}"
            tensors[f"{name}.weight"], tensors[f"{name}.bias"] = np.ascontiguousarray(values[0].transpose(axes)), values[1]
    return tensors


def main():
    path = pathlib.Path(sys.argv[1])
    tensors = weights(path)
    assert len(tensors) == 2 * 94, len(tensors)
    save("blazepose", tensors, LICENSE)
    model = Interpreter(str(path), num_threads=1)
    model.allocate_tensors()
    model.set_tensor(model.get_input_details()[0]["index"], photograph(SIDE)[None].astype(np.float32))
    model.invoke()
    outputs = {tuple(d["shape"].tolist()): model.get_tensor(d["index"]) for d in model.get_output_details()}
    # Every eighth pixel of the mask is enough to see an error of any layer.
    mask = outputs[(1, SIDE, SIDE, 1)][0, 4::8, 4::8, 0]
    parts = [outputs[(1, 195)], outputs[(1, 1)], mask]
    (ROOT / "tests/data/blazepose.f32").write_bytes(b"".join(part.astype("<f4").tobytes() for part in parts))


main()
