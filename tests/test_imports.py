"""Who may import whom: read from the sources, so that no import has to happen."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "sb3_dtfm"

# Room: its files, and the parts of the package that it may import.
ROOMS = {
    "networks": ("sb3_dtfm/networks", {"networks"}),
    "windows": ("sb3_dtfm/windows.py", set()),
    "arguments": ("sb3_dtfm/arguments.py", set()),
    "actions": ("sb3_dtfm/actions.py", set()),
    "files": ("sb3_dtfm/files", {"files"}),
    "heads": ("sb3_dtfm/heads", {"heads", "networks", "arguments"}),
    "envs": ("envs", {"envs"}),
    "data": ("sb3_dtfm/data", {"actions", "arguments", "data", "envs", "files", "windows"}),
    "recording": ("sb3_dtfm/recording", {"recording", "actions", "algorithms", "envs", "data", "files"}),
    "policies": ("sb3_dtfm/policies", {"networks", "heads", "windows", "actions", "arguments", "policies"}),
    "callbacks": ("sb3_dtfm/callbacks.py", {"data"}),
    "optimization": ("sb3_dtfm/optimization.py", set()),
    "distributed": ("sb3_dtfm/distributed.py", {"windows"}),
    "algorithms": (
        "sb3_dtfm/algorithms",
        {
            "algorithms",
            "policies",
            "heads",
            "data",
            "envs",
            "windows",
            "actions",
            "arguments",
            "callbacks",
            "optimization",
            "distributed",
            "files",
        },
    ),
    "zoo": ("sb3_dtfm/zoo", {"", "algorithms", "arguments", "policies", "callbacks", "envs", "distributed", "files", "zoo"}),
    "benchmark": ("sb3_dtfm/benchmark", {"", "algorithms", "data", "envs", "zoo", "benchmark", "files"}),
    "cli": ("sb3_dtfm/cli", {"", "actions", "algorithms", "data", "envs", "recording", "zoo", "benchmark", "files", "cli"}),
}


def files(room: str) -> list[Path]:
    path = ROOT / ROOMS[room][0]
    found = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    assert found
    return found


def imported_modules(path: Path) -> list[str]:
    """Full names of all modules that a file imports, wherever in the file."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            package_only = node.module == PACKAGE
            rooms = {name for name in ROOMS if name != ""}
            modules += [
                f"{PACKAGE}.{alias.name}" if package_only and alias.name in rooms else str(node.module)
                for alias in node.names
            ]
    return modules


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_the_rooms_below_it(room):
    for path in files(room):
        own = {module for module in imported_modules(path) if module.split(".")[0] == PACKAGE}
        rooms = {module.split(".")[1] if "." in module else "" for module in own}
        assert rooms <= ROOMS[room][1], f"{path.relative_to(ROOT)} imports {sorted(own)}"


def test_rooms_form_no_circle():
    """A room comes after all rooms that it may import, so that some order has them all."""
    below = {room: allowed - {room, ""} for room, (_, allowed) in ROOMS.items()}
    below["zoo"] |= {"algorithms"}  # what "" is: the package's own names
    ordered: set[str] = set()
    while free := {room for room in below if room not in ordered and below[room] <= ordered}:
        ordered |= free
    assert ordered == set(ROOMS), f"a circle among {sorted(set(ROOMS) - ordered)}"


def test_networks_need_torch_and_numpy_alone():
    standard = {"collections", "contextlib", "dataclasses", "math", "typing", "__future__", "abc", "functools"}
    for path in files("networks"):
        roots = {module.split(".")[0] for module in imported_modules(path)}
        assert roots <= standard | {"torch", "numpy", PACKAGE}, path


def test_every_module_belongs_to_a_room():
    known = {path for room in ROOMS for path in files(room)} | {
        ROOT / "sb3_dtfm" / name for name in ("__init__.py", "__main__.py")
    }
    assert set((ROOT / "sb3_dtfm").rglob("*.py")) <= known
