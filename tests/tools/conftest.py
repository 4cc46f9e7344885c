"""The tools find their own modules beside them, as when Python runs them as scripts."""

import sys
from pathlib import Path

TOOLS = Path(__file__).parents[2] / "tools"
HERE = Path(__file__).parent
sys.path.extend(map(str, (TOOLS, TOOLS / "free_meshes", HERE / "free_meshes")))
