"""The wall: what learns never imports the studio."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import learn3d

SOURCES = Path(learn3d.__file__).parent


def modules() -> dict[str, Path]:
    """All modules by their name: "learn3d.training", "learn3d.methods" for a room's __init__."""
    names = {}
    for path in SOURCES.rglob("*.py"):
        parts = ("learn3d", *path.relative_to(SOURCES).with_suffix("").parts)
        names[".".join(parts).removesuffix(".__init__")] = path
    return names


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """The modules of learn3d that a file imports anywhere, for type hints and inside of functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found & known.keys()


def test_the_core_never_imports_the_studio():
    known = modules()
    core = {name: path for name, path in known.items() if not name.startswith("learn3d.studio")}
    assert len(core) < len(known)
    found = {
        name: [other for other in imports(path, known) if ".studio" in other]
        for name, path in core.items()
    }
    assert {name: others for name, others in found.items() if others} == {}


def test_no_module_imports_itself_over_others():
    known = modules()
    rooms = {name for name, path in known.items() if path.stem == "__init__"}
    graph = {name: imports(path, known) - {name} - rooms for name, path in known.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError with the circle
