"""The floors of learn3d: modules import their own room and lower floors only."""

import ast
import re
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
    {"figures"},
    {"evaluation"},
    {"make_data"},
    {"runs"},
    {"config"},
    {"presets", "fitting", "poses"},
    {"methods"},
    {"networks", "losses"},
    {"pictures"},
    {"data"},
    {"device", "settings", "shapes"},
    {"files"},
    {"terminal"},
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
    pairs = [(name, other) for name, path in known.items() for other in imports(path, known)]
    rooms = [(pair, *(module.split(".")[0] for module in pair)) for pair in pairs]
    assert [pair for pair, room, target in rooms if target != room and not FLOOR[room] < FLOOR[target]] == []


def test_no_module_imports_itself_over_others():
    known = modules()
    graph = {name: (imports(path, known) & known.keys()) - {name} for name, path in known.items()}
    TopologicalSorter(graph).prepare()  # raises CycleError with the circle


def test_only_commands_are_imported_by_a_name_made_at_run_time():
    found = [name for name, path in modules().items() if re.search(r"\b(import_module|__import__)\b", path.read_text())]
    assert found == ["commands"]


def test_the_root_holds_ten_modules_at_most():
    assert len([path for path in SOURCES.glob("*.py") if not path.stem.startswith("__")]) <= 10
