"""The corpus of the fuzz target (fuzz.cpp): corpus.hex, an input per line. libFuzzer wants a file for each.

python tests/csrc/corpus.py unpack FOLDER      writes the corpus into a folder
python tests/csrc/corpus.py pack FOLDER        adds the folder's files, and the seeds of this script, to the corpus
python tests/csrc/corpus.py list FOLDER        prints the folder's files, an input per line
"""

import hashlib
import random
import sys
from pathlib import Path

CORPUS = Path(__file__).with_name("corpus.hex")

FLOAT, DOUBLE = 1, 0
PACKED, PER_IMAGE, ANTI_ALIASED, FILL_BACK, VALUES_PER_IMAGE, PERSPECTIVE, DISTORTED = (1 << n for n in range(7))
SPECIAL = range(232, 247)
SECOND_RUN = (7, 8, 12)  # seeds: also on two threads, also the first image alone, also packed
SIDES = [*range(6), 224, 227, 232, 241]  # 1 to 6; 15, 18, 23, 14 pixels
BATCHES = [1, 1, 1, 1, 2, 2, 3, 9]  # of decode()

# corners as bytes (see coordinate() of fuzz.cpp): x, y = (byte - 116) / 64, z = (byte - 32) / 16
TETRAHEDRON = (
    [(70, 70, 64), (160, 75, 80), (110, 165, 72), (116, 116, 48)],
    [(0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)],
)
SQUARE = ([(84, 84, 64), (148, 84, 64), (148, 148, 80), (84, 148, 80)], [(0, 1, 2), (0, 2, 3)])
TWICE = ([(60, 60, 64), (170, 60, 64), (116, 170, 64)], [(0, 1, 2), (0, 2, 1), (0, 1, 2)])
COLLINEAR = ([(60, 60, 64), (116, 116, 64), (172, 172, 64)], [(0, 1, 2), (2, 1, 0), (0, 0, 1)])
SLIVER = ([(60, 80, 64), (170, 100, 64), (171, 100, 64)], [(0, 1, 2), (2, 1, 0)])
BEHIND = ([(60, 60, 20), (170, 60, 64), (116, 170, 10)], [(0, 1, 2), (2, 1, 0)])
BORDER = ([(52, 52, 64), (180, 52, 64), (51, 181, 64), (0, 231, 64)], [(0, 1, 2), (1, 3, 2)])
LAYERS = (
    [(50, 50, 48), (180, 50, 48), (116, 180, 112), (50, 180, 64), (180, 180, 64), (116, 50, 64)],
    [(0, 1, 2), (3, 5, 4)],
)
NOTHING = ([], [])
MESHES = [TETRAHEDRON, SQUARE, TWICE, COLLINEAR, SLIVER, BEHIND, BORDER, LAYERS, NOTHING]


def encode(rng, number, flags, meshes, size, *, foreign=False, planes=0, spoil=False, hostile=False) -> bytes:
    """The bytes that decode() of fuzz.cpp turns into these meshes; unless packed, all have the first one's sizes."""
    batch, packed = len(meshes), bool(flags & PACKED)
    more = (7 if foreign else 0) + 8 * BATCHES.index(batch) if batch else 255
    also = rng.randrange(4) + 4 * rng.randrange(8) + (224 if hostile else 0)
    seed = rng.choice((rng.randrange(256), *SECOND_RUN))
    head = [number, flags, more, also, rng.choice((0, 0, rng.randrange(4))), *size]
    head += [rng.randrange(5), planes, rng.randrange(8), seed]
    shapes = meshes if packed else [meshes[0] if meshes else NOTHING]
    head += [len(vertices) + 16 * len(faces) for vertices, faces in shapes]
    lists = meshes if packed or flags & PER_IMAGE else shapes
    indices = [v for _, faces in lists for face in faces for v in face]
    coordinates = [c for vertices, _ in meshes for corner in vertices for c in corner]
    if spoil and coordinates:
        coordinates[rng.randrange(len(coordinates))] = rng.choice(SPECIAL)
    return bytes(head + indices + coordinates) + bytes(rng.randrange(256) for _ in range(8 * spoil))


def seeds() -> list[bytes]:
    rng = random.Random(0)
    found = []
    for number in (FLOAT, DOUBLE):
        for layout in (0, PER_IMAGE, PACKED):
            for mesh in MESHES:
                count = rng.choice(BATCHES)
                batch = rng.choices(MESHES, k=count - 1) + [mesh] if layout == PACKED else [mesh] * count
                rich = ANTI_ALIASED | FILL_BACK | PERSPECTIVE | DISTORTED
                for other in (rich, VALUES_PER_IMAGE | rng.choice((0, FILL_BACK))):
                    options = {
                        "foreign": rng.random() < 0.1,
                        "planes": rng.choice((0, 0, 0, 34, 200)),
                        "spoil": rng.random() < 0.3,
                        "hostile": rng.random() < 0.1,
                    }
                    size = rng.choice(SIDES), rng.choice(SIDES)
                    found.append(encode(rng, number, layout | other, batch, size, **options))
        found.append(encode(rng, number, 0, [], (5, 3)))
        found.append(encode(rng, number, PACKED, [], (3, 5)))
        found.append(encode(rng, number, PACKED | ANTI_ALIASED, [NOTHING, NOTHING], (3, 5)))
    return found


def unpack(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for line in CORPUS.read_text().split():
        (folder / hashlib.sha1(bytes.fromhex(line)).hexdigest()).write_bytes(bytes.fromhex(line))


def pack(folder: Path) -> None:
    found = {path.read_bytes() for path in folder.glob("*")} if folder.exists() else set()
    present = CORPUS.read_text().split() if CORPUS.exists() else []
    lines = sorted({*present, *(data.hex() for data in {*found, *seeds()})}, key=lambda line: (len(line), line))
    CORPUS.write_text("".join(f"{line}\n" for line in lines))
    print(f"{len(lines)} inputs, {CORPUS.stat().st_size} bytes")


def list_files(folder: Path) -> None:
    sys.stdout.writelines(f"{path.read_bytes().hex()}\n" for path in sorted(folder.glob("*")))


if __name__ == "__main__":
    {"unpack": unpack, "pack": pack, "list": list_files}[sys.argv[1]](Path(sys.argv[2]))
