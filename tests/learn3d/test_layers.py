"""Where everything in learn3d lives: what may import what, drawn from the sources."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import learn3d

SOURCES = Path(learn3d.__file__).parent

#: Rooms and single modules, the highest floor first. A module imports its own room and lower floors.
FLOORS = (
    {"__main__"},
    {"commands"},
    {"pages", "demo"},
    {"experiments"},
    {"training", "reconstruction"},
    {"validation"},
    {"figures"},
    {"evaluation"},
    {"make_data", "runs"},
    {"config"},
    {"presets"},
    {"methods"},
    {"networks", "losses"},
    {"distributed", "pictures"},
    {"data"},
    {"device", "settings", "terminal"},
    {"files"},
)
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}


def modules() -> dict[str, Path]:
    """All modules by their name below learn3d: "training", "methods.vpl", "methods" for a room's __init__."""
    found = {}
    for path in SOURCES.rglob("*.py"):
        name = ".".join(path.relative_to(SOURCES).with_suffix("").parts).removesuffix(".__init__")
        if name != "__init__":
            found[name] = path
    return found


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """The modules of learn3d that a file imports anywhere, for type hints and inside of functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "learn3d":
            package = node.module.removeprefix("learn3d").lstrip(".")
            for alias in node.names:
                name = f"{package}.{alias.name}".lstrip(".")
                found.add(name if name in known else package)
        elif isinstance(node, ast.Import):
            found |= {a.name.removeprefix("learn3d.") for a in node.names if a.name.startswith("learn3d.")}
    return found


def test_every_import_points_down():
    known = modules()
    assert {name.split(".")[0] for name in known} <= FLOOR.keys(), "a new room: say on which floor it stands"
    upward = []
    for name, path in known.items():
        room = name.split(".")[0]
        for other in imports(path, known):
            target = other.split(".")[0]
            if target != room and not FLOOR[room] < FLOOR[target]:
                upward.append(f"{name} -> {other}")
    assert sorted(upward) == []


def test_no_module_imports_itself_over_others():
    known = modules()
    graph = {}
    for name, path in known.items():
        found = imports(path, known)
        # An __init__ hands on what its room's files define; importing a sibling by name does not depend on it.
        graph[name] = {other for other in found if other in known and other != name}
    TopologicalSorter(graph).prepare()  # raises CycleError with the circle


def test_only_commands_are_imported_by_a_name_made_at_run_time():
    known = modules()
    assert known.pop("commands")
    for name, path in known.items():
        words = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        words |= {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
        assert not words & {"import_module", "__import__"}, name


def test_the_root_holds_ten_modules_at_most():
    assert len([path for path in SOURCES.glob("*.py") if not path.stem.startswith("__")]) <= 10
