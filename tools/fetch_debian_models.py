"""The command `learn3d fetch-debian-models`, from a source folder."""

import sys

from learn3d.commands import main

if __name__ == "__main__":
    sys.exit(main("fetch-debian-models"))
