"""The command `learn3d demo`, from a source folder."""

import sys

from learn3d.commands import main

if __name__ == "__main__":
    sys.exit(main("demo"))
