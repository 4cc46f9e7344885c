"""The command `learn3d convert-dataset`, from a source folder."""

import sys

from learn3d.commands import main

if __name__ == "__main__":
    sys.exit(main("convert-dataset"))
