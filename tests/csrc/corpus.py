"""The corpus of the fuzz target: corpus.hex has an input per line, libFuzzer wants a file for each.

python tests/csrc/corpus.py unpack FOLDER      writes the corpus into a folder
python tests/csrc/corpus.py pack FOLDER        adds the folder's files to the corpus
"""

import sys
from pathlib import Path

CORPUS = Path(__file__).with_name("corpus.hex")

command, folder = sys.argv[1], Path(sys.argv[2])
lines = CORPUS.read_text().split()
if command == "unpack":
    folder.mkdir(parents=True, exist_ok=True)
    for number, line in enumerate(lines):
        (folder / f"{number}").write_bytes(bytes.fromhex(line))
else:
    found = {*lines, *(path.read_bytes().hex() for path in folder.iterdir())}
    CORPUS.write_text(
        "".join(f"{line}\n" for line in sorted(found, key=lambda line: (len(line), line)))
    )
