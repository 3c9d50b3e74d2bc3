"""What `reconstruct` says of photographs of made people (docs/notes/photographs.md, "Joints").

    python docs/joints_study.py path/to/snapsnap people/held/synth people/held/makehuman people/held/avatars

The folders are the held-out people of docs/weights.md: twelve views around each person, the first one from the front. Each person is
reconstructed from front and back, from both exchanged, and from both sides. The counts are of pairs.
"""

import collections, json, pathlib, subprocess, sys, tempfile

PAIRS = {"front and back": (0, 6), "exchanged": (6, 0), "both sides": (3, 9)}


def main():
    program, folders = sys.argv[1], [pathlib.Path(folder) for folder in sys.argv[2:]]
    people = sorted(person for folder in folders for person in (folder / "test/img").iterdir())
    found = {kind: collections.Counter() for kind in PAIRS}
    with tempfile.TemporaryDirectory() as temporary:
        for person in people:
            for kind, views in PAIRS.items():
                pictures = [person / f"{view}.png" for view in views]
                command = [program, "reconstruct", *pictures, "-o", f"{temporary}/human.ply", "--set", "network.resolution=256", "--json"]
                report = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
                found[kind].update({doubt["sign"] for doubt in report["doubts"]} or {"no doubt"})
    print(f"{len(people)} people")
    for kind, signs in found.items():
        print(f"{kind}:", ", ".join(f"{sign} {count}" for sign, count in signs.most_common()))


main()
