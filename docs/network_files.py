"""What both converters of the networks that look at photographs share: u2netp_convert.py and blazepose_convert.py."""

import json, pathlib, struct
import numpy as np
from PIL import Image

ROOT = pathlib.Path(__file__).parent.parent


def save(name, tensors, license):
    """Writes f16 tensors as assets/weights/NAME.safetensors."""
    header, start = {"__metadata__": {"license": license}}, 0
    for key, tensor in tensors.items():
        header[key] = {"dtype": "F16", "shape": list(tensor.shape), "data_offsets": [start, start + tensor.nbytes]}
        start += tensor.nbytes
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    content = b"".join(tensor.tobytes() for tensor in tensors.values())
    (ROOT / f"assets/weights/{name}.safetensors").write_bytes(struct.pack("<Q", len(text)) + text + content)


def photograph(side):
    """Evenly spaced pixels of the sample's front over a coloured ramp, from 0 to 1 [side, side, 3]: no resizing to disagree about."""
    rgba = np.asarray(Image.open(ROOT / "assets/sample/front.png").convert("RGBA"), np.float64) / 255
    at = (np.arange(side) * rgba.shape[0]) // side
    rgba, line = rgba[at][:, at], np.arange(side) / side
    ramp = np.stack([np.broadcast_to(line, (side, side)), np.broadcast_to(line[:, None], (side, side)), np.full((side, side), 0.4)], -1)
    return rgba[..., 3:] * rgba[..., :3] + (1 - rgba[..., 3:]) * ramp
