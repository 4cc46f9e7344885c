"""The command `learn3d train`, from a source folder."""

import os
import sys

from learn3d.commands import main
from learn3d.tasks import process_environment

if __name__ == "__main__":
    environment = process_environment()
    if environment != dict(os.environ):  # the allocator reads it when the process starts
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)
    sys.exit(main("train"))
