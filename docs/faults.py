"""Commands against six faults of their surroundings: python docs/faults.py target/release/snapsnap [COMMAND …] > docs/faults.md

Needs root on Linux, since it mounts small and read-only file systems. Each cell is a run in a fresh folder. It names the exit code (or the
signal) and is wrong, in capitals, if an input changed, an earlier output was lost, or something half-written was left.
"""

import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROGRAM = str(Path(sys.argv[1]).resolve())
ROOT = Path(__file__).resolve().parent.parent
SAMPLE = [str(ROOT / f"assets/sample/{side}.png") for side in ("front", "back")]
SMALL = ["--set", "views.count=4", "--set", "views.resolution=256", "--set", "views.samples_per_axis=1"]
TRAIN = str(ROOT / "configs/tiny/stage1.toml")

work = Path(tempfile.mkdtemp())
os.chdir(work)
quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def prepared(name, *arguments):
    subprocess.run([PROGRAM, *arguments], check=True, **quiet)
    return str(work / name)


HUMAN = prepared("h.ply", "reconstruct", *SAMPLE, "--device", "cpu", "--set", "network.resolution=256", "-o", "h.ply")
PEOPLE = prepared("people", "prepare", "synth", "--subjects", "2", "-o", "people", *SMALL)
prepared("people", "prepare", "synth", "--subjects", "1", "--split", "test", "-o", "people", *SMALL)
WEIGHTS = prepared("w.safetensors", "init-weights", "--config", str(ROOT / "configs/tiny.toml"), "-o", "w.safetensors")

# Name: arguments before the output, the output's name, and its input that the output may replace, if it is one file.
COMMANDS = {
    "reconstruct": (["reconstruct", *SAMPLE, "--device", "cpu", "-o"], "out.ply", SAMPLE[0]),
    "reconstruct --turntable": (["reconstruct", *SAMPLE, "--device", "cpu", "-o", str(work / "t.ply"), "--turntable"], "out.gif", SAMPLE[0]),
    "render": (["render", HUMAN, "--orbit", "12", "--device", "cpu", "-o"], "views", None),
    "render --raw": (["render", HUMAN, "--orbit", "2", "--device", "cpu", "-o", str(work / "v"), "--raw"], "raw.safetensors", HUMAN),
    "mesh": (["mesh", HUMAN, "--device", "cpu", "-o"], "out.glb", HUMAN),
    "convert": (["convert", HUMAN], "out.spz", HUMAN),
    "prepare synth": (["prepare", "synth", "--subjects", "3", *SMALL, "-o"], "set", None),
    "train-stage1": (["train-stage1", "--config", TRAIN, "--data", PEOPLE, "--device", "cpu", "--minutes", "0.15", "-o"], "run", None),
    "evaluate": (["evaluate", "--config", str(ROOT / "configs/eval.toml"), "--data", PEOPLE, "--device", "cpu", "-o"], "report", None),
    "init-weights": (["init-weights", "--config", str(ROOT / "configs/tiny.toml"), "-o"], "out.safetensors", str(ROOT / "configs/tiny.toml")),
    "import-weights": (["import-weights", WEIGHTS, "-o"], "out.safetensors", WEIGHTS),
    "export-weights": (["export-weights", WEIGHTS, "-o"], "out.safetensors", WEIGHTS),
    "man": (["man", "-o"], "man", None),
    "demo": (["demo", "--device", "cpu", "-o"], "demo", None),
}


def files(folder):
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file() and not path.is_symlink():
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def inputs():
    return {**files(ROOT / "assets"), **files(PEOPLE), **{p: files(Path(p).parent)[p] for p in (HUMAN, WEIGHTS)}}


def start(arguments):
    return subprocess.Popen([PROGRAM, "--quiet", *arguments], **quiet)


def code(process, limit=300):
    try:
        value = process.wait(limit)
    except subprocess.TimeoutExpired:
        process.kill()
        return "HANGS"
    return f"signal {-value}" if value < 0 else str(value)


def unfinished(folder):
    return [p for p in files(folder) if ".snapsnap-" in p or ".unfinished" in p or p.endswith(".part")]


def judged(result, folder, before, kept=None):
    """The result, with what is wrong."""
    if inputs() != before:
        result += ", AN INPUT CHANGED"
    if unfinished(folder):
        result += ", LEFT UNFINISHED"
    now = files(folder)
    if kept and any(now.get(path) != content for path, content in kept.items()):
        result += ", AN OUTPUT WAS LOST"
    return result


def mounted(folder, options):
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)


def read_only(begin, name, _given, folder, before):
    mounted(folder, "size=1m")
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
    result = judged(code(start([*begin, str(folder / name)])), folder, before)
    subprocess.run(["umount", str(folder)], check=True)
    return result if result.startswith("2") else result + ", NOT REFUSED"


def full(begin, name, _given, folder, before):
    mounted(folder, "size=16k")
    result = judged(code(start([*begin, str(folder / name)])), folder, before)
    if Path(folder / name).is_file():
        result += ", HALF A FILE" if not result.startswith("0") else ", fits"
    subprocess.run(["umount", "-l", str(folder)], check=True)
    return result


def link(begin, name, _given, folder, before):
    target = folder / "elsewhere"
    target.write_text("precious")
    (folder / name).symlink_to(target)
    result = code(start([*begin, str(folder / name)]))
    result += ", through the link" if target.read_bytes() != b"precious" else ", target kept"
    return judged(result, folder, before)


def is_input(begin, name, given, folder, before):
    if given is None:
        return "is a folder"
    if begin[0] == "convert":
        given = str(Path(given))
    result = judged(code(start([*begin, given])), folder, before)
    return result if result.startswith("2") else result + ", NOT REFUSED"


def interrupted(begin, name, _given, folder, before):
    whole = time.monotonic()
    code(start([*begin, str(folder / name)]))
    whole = time.monotonic() - whole
    kept = {} if begin[0] in ("prepare", "train-stage1") else None
    results = []
    for share in (0.2, 0.5, 0.8):
        for sent in (signal.SIGINT, signal.SIGKILL):
            place = folder / f"{share}{sent}"
            place.mkdir()
            process = start([*begin, str(place / name)])
            time.sleep(share * whole)
            process.send_signal(sent)
            ended = code(process)
            left = judged("", place, before, kept) if sent == signal.SIGINT else ""
            # What a kill left must not stop the next run.
            again = [*begin, str(place / name), *(["--resume"] if begin[0].startswith("train") else [])]
            after = code(start(again))
            results.append(f"{ended}{left}" + ("" if after == "0" else f", THEN {after}"))
    return " / ".join(dict.fromkeys(results))


def twice(begin, name, _given, folder, before):
    both = [start([*begin, str(folder / name)]) for _ in range(2)]
    return judged(" and ".join(code(process) for process in both), folder, before)


FAULTS = {
    "read-only folder": read_only,
    "full disk": full,
    "output is a link": link,
    "output is the input": is_input,
    "interrupted (three SIGINT, three SIGKILL)": interrupted,
    "twice at once": twice,
}

commit = subprocess.run(["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
print("# Commands and the faults of their surroundings\n")
print(f"`python docs/faults.py target/release/snapsnap`, commit {commit}.\n")
print("Cells contain exit codes: 0 done, 1 failed, 2 refused. After a SIGKILL the same command ran again, and had to end with 0. A wrong")
print("cell would be in capitals: an input or an earlier output changed, something half-written left, a command that hangs.\n")
print("| command | " + " | ".join(FAULTS) + " |")
print("|---|" + "---|" * len(FAULTS))
wrong = 0
for command, (begin, name, given) in COMMANDS.items():
    if sys.argv[2:] and command not in sys.argv[2:]:
        continue
    cells = []
    for fault in FAULTS.values():
        folder = Path(tempfile.mkdtemp(dir=work))
        cell = fault(begin, name, given, folder, inputs())
        wrong += any(word.isupper() and len(word) > 1 for word in cell.replace(",", " ").split())
        cells.append(cell)
        shutil.rmtree(folder, ignore_errors=True)
    print(f"| `{command}` | " + " | ".join(cells) + " |", flush=True)
print(f"\n{wrong} wrong cells.")
shutil.rmtree(work, ignore_errors=True)
