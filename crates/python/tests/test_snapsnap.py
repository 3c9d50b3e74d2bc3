"""The Python package, against the program's own files and the reference numbers of tests/data (see its README)."""

import json
import os
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import snapsnap

ROOT = Path(__file__).parents[3]
SAMPLE = [ROOT / "assets/sample/front.png", ROOT / "assets/sample/back.png"]
FIELDS = ("means", "rotations", "scales", "opacities", "colors")


@pytest.fixture(scope="session")
def person():
    return snapsnap.reconstruct(*SAMPLE)


def numbers(path):
    """The tensors of a safetensors file, and its metadata."""
    data = path.read_bytes()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__", {})
    types = {"F32": np.float32, "F64": np.float64, "U8": np.uint8}
    tensors = {
        name: np.frombuffer(data[8 + length :][slice(*entry["data_offsets"])], types[entry["dtype"]]).reshape(entry["shape"])
        for name, entry in header.items()
    }
    return tensors, metadata


def command(*arguments, **options):
    return subprocess.run([sys.executable, "-m", "snapsnap", *map(str, arguments)], capture_output=True, text=True, **options)


def test_a_person_has_the_bytes_of_the_command(person, tmp_path):
    ran = command("reconstruct", *SAMPLE, "-o", tmp_path / "command.ply")
    assert ran.returncode == 0, ran.stderr
    person.save(tmp_path / "python.ply")
    assert (tmp_path / "python.ply").read_bytes() == (tmp_path / "command.ply").read_bytes()
    assert len(person) == len(person.means) > 100_000
    assert person.means.dtype == np.float32 and person.means.shape[1] == 3
    # The person stands on the floor and has the usual height.
    assert abs(person.means[:, 1].min()) < 1e-5 and abs(person.means[:, 1].max() - 1.72) < 1e-5
    np.testing.assert_allclose(np.linalg.norm(person.rotations, axis=1), 1.0, atol=1e-4)
    assert 0 <= person.opacities.min() and person.opacities.max() <= 1
    assert person.warnings == [] and sum(person.report["seconds"].values()) > 0
    assert person.cutouts[0].ndim == 3 and person.cutouts[0].shape[2] == 4


def test_pictures_in_memory_are_as_good_as_files(person):
    image = pytest.importorskip("PIL.Image")
    pictures = [image.open(path) for path in SAMPLE]
    arrays = [np.asarray(picture.convert("RGBA")) for picture in pictures]
    of_floats = [array[..., :3] / np.float32(255) for array in arrays]
    masks = [array[..., 3] for array in arrays]
    for made in (snapsnap.reconstruct(*pictures), snapsnap.reconstruct(*arrays), snapsnap.reconstruct(*of_floats, masks)):
        assert len(made) == len(person)
        np.testing.assert_array_equal(made.means, person.means)
        np.testing.assert_array_equal(made.colors, person.colors)


def test_files_give_back_what_was_saved(person, tmp_path):
    for kind, tolerance in (("ply", 1e-5), ("glb", 1e-5), ("spz", 5e-3)):
        person.save(tmp_path / f"human.{kind}")
        read = snapsnap.load(tmp_path / f"human.{kind}")
        np.testing.assert_allclose(read.means, person.means, atol=tolerance)
        np.testing.assert_allclose(read.scales, person.scales, rtol=0.1, atol=1e-6)
    # A SOG has another order.
    person.save(tmp_path / "human.sog")
    read = snapsnap.load(tmp_path / "human.sog")
    assert len(read) == len(person)
    np.testing.assert_allclose(np.sort(read.means, axis=0), np.sort(person.means, axis=0), atol=1e-4)


def test_renders_show_the_person(person):
    pictures = person.render(snapsnap.orbit(2, (48, 64)), background=(1, 1, 1))
    assert pictures.shape == (2, 64, 48, 3) and pictures.dtype == np.float32
    assert (pictures[:, 0, 0] == 1).all() and (pictures[:, 32, 24] < 0.99).any(axis=-1).all()


def test_a_mesh_is_closed_and_saved(person, tmp_path):
    mesh = person.mesh(faces=5000, texture=256)
    assert mesh.texture.shape == (256, 256, 3) and mesh.texcoords.shape == (len(mesh.faces), 3, 2)
    edges = np.concatenate([mesh.faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]).astype(np.int64)
    forward = np.sort(edges[:, 0] * len(mesh.positions) + edges[:, 1])
    backward = np.sort(edges[:, 1] * len(mesh.positions) + edges[:, 0])
    np.testing.assert_array_equal(forward, backward)
    mesh.save(tmp_path / "human.glb")
    assert (tmp_path / "human.glb").read_bytes()[:4] == b"glTF"
    colored = person.mesh(faces=5000, texture=0)
    assert colored.texture is None and colored.colors.shape == colored.positions.shape


@pytest.mark.parametrize("scene", ["plain", "stack", "unnormalised_rotations"])
def test_pictures_and_gradients_are_the_reference_numbers(scene):
    expected, metadata = numbers(ROOT / f"tests/data/splat/{scene}.safetensors")
    cameras = json.loads((ROOT / f"tests/data/splat/{scene}.cameras.json").read_text())
    preset = {"inria": "inria", "gsplat_1_5": "gsplat"}[metadata["preset"]]
    options = {"preset": preset, "antialiased": metadata["antialiased"] == "true", "depth": True}
    inputs = [expected[name] for name in FIELDS]
    gradients = {name: 0 for name in (*FIELDS, "background")}
    from snapsnap import _rasterize

    for i, camera in enumerate(cameras):
        native = {"cameras": [camera], "device": "cpu", **options}
        outputs, tape = _rasterize.forward([*inputs, expected["background"]], native, gradients=True)
        for name, output in zip(("color", "alpha", "depth"), outputs):
            np.testing.assert_allclose(output[0], expected[f"{name}.{i}"].reshape(output[0].shape), atol=2e-4)
        upstream = [expected[f"grad_{name}.{i}"].astype(np.float32).tobytes() for name in ("color", "alpha", "depth")]
        for name, made in zip(gradients, tape.backward(*upstream)):
            gradients[name] = gradients[name] + np.frombuffer(made, np.float32)
    for name, made in gradients.items():
        wanted = expected[f"vjp.{name}"].reshape(-1)
        assert np.linalg.norm(made - wanted) <= 2e-3 * np.linalg.norm(wanted), name


def test_torch_gets_these_gradients():
    torch = pytest.importorskip("torch")
    expected, _ = numbers(ROOT / "tests/data/splat/plain.safetensors")
    cameras = json.loads((ROOT / "tests/data/splat/plain.cameras.json").read_text())
    tensors = [torch.tensor(expected[name], requires_grad=True) for name in FIELDS]
    background = torch.tensor(expected["background"], requires_grad=True)
    total = 0
    for i, camera in enumerate(cameras):
        outputs = snapsnap.rasterize(*tensors, [camera], background=background, depth=True)
        for name, output in zip(("color", "alpha", "depth"), outputs):
            total = total + (output[0] * torch.tensor(expected[f"grad_{name}.{i}"]).reshape(output[0].shape)).sum()
    total.backward()
    for name, tensor in zip((*FIELDS, "background"), (*tensors, background)):
        wanted = expected[f"vjp.{name}"].reshape(tensor.shape)
        assert np.linalg.norm(tensor.grad.numpy() - wanted) <= 2e-3 * np.linalg.norm(wanted), name


def test_cameras_of_matrices_are_the_same_cameras():
    given = snapsnap.orbit(3, 32)
    intrinsics = [[[c["fx"], 0, c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1]] for c in given]
    made = snapsnap.cameras([c["world_to_camera"] for c in given], intrinsics, 32, 32)
    assert made == given


def test_unsuitable_input_is_named(person, tmp_path):
    grey = np.full((80, 60, 3), 128, np.uint8)
    cameras = snapsnap.orbit(1, 16)
    for call, expected in [
        (lambda: snapsnap.reconstruct("missing.png", SAMPLE[1]), "missing.png"),
        (lambda: snapsnap.reconstruct(grey.astype(np.int32), SAMPLE[1]), "front: is of int32"),
        (lambda: snapsnap.reconstruct(SAMPLE[0], grey[0, 0]), "back: has the shape"),
        (lambda: snapsnap.reconstruct(grey, grey, [grey[:4], grey]), "front: the mask has the shape"),
        (lambda: snapsnap.reconstruct(*SAMPLE, [grey, grey]), "front: its mask is an array"),
        (lambda: snapsnap.reconstruct(grey, grey, cutout="none"), "front"),
        (lambda: snapsnap.reconstruct(*SAMPLE, cutout="all"), "cutout: must be auto"),
        (lambda: snapsnap.reconstruct(*SAMPLE, height=200), "height 200: must be from 0.1 to 10"),
        (lambda: snapsnap.reconstruct(*SAMPLE, device="gpu"), "gpu: no such kind of device"),
        (lambda: snapsnap.Networks(SAMPLE[0]), "front.png"),
        (lambda: person.save(tmp_path / "human.txt"), "human.txt: is neither"),
        (lambda: person.render([]), "cameras: the list is empty"),
        (lambda: person.render([{"width": 4}]), "camera 0"),
        (lambda: person.render(cameras, background=(1, 1)), "background: has the shape"),
        (lambda: person.mesh(texture=3), "texture: must be 0"),
        (lambda: snapsnap.Gaussians([[0, 0, 0]], [[1, 1]], [[1, 0, 0, 0]], [1], [[1, 1, 1]]), "scales: has the shape"),
    ]:
        with pytest.raises(snapsnap.InputError, match=expected):
            call()
    with pytest.raises(OSError, match="cannot write"):
        person.save(tmp_path / "missing" / "human.ply")
    assert not list(tmp_path.iterdir())


def test_other_threads_go_on_meanwhile():
    ticks, stop = [], threading.Event()

    def tick():
        while not stop.wait(0.005):
            ticks.append(time.monotonic())

    thread = threading.Thread(target=tick)
    thread.start()
    snapsnap.reconstruct(*SAMPLE)
    stop.set()
    thread.join()
    assert len(ticks) > 5


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_raises_at_once():
    program = f"""
import os, signal, threading, time
import snapsnap
snapsnap.Networks()
pid = os.getpid()
threading.Timer(0.15, lambda: os.kill(pid, signal.SIGINT)).start()
try:
    while True:
        snapsnap.reconstruct({str(SAMPLE[0])!r}, {str(SAMPLE[1])!r})
except KeyboardInterrupt:
    print("interrupted")
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout.strip()) == (0, "interrupted"), ran.stderr


def test_the_command_reports_as_the_program_does():
    version = command("--version")
    # The program adds its commit and date.
    assert version.stdout.startswith(f"snapsnap {snapsnap.__version__}"), version.stderr
    refused = command("reconstruct", "missing.png", SAMPLE[1])
    assert refused.returncode == 2 and "missing.png" in refused.stderr
    devices = command("doctor", "--json")
    assert devices.returncode == 0 and json.loads(devices.stdout)
