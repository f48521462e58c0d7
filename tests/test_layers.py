# SPDX-License-Identifier: Apache-2.0
"""The floors of the house: a room imports only from itself and from rooms below it."""

import ast
import sys
from pathlib import Path

import lerobot_pf2mp
import lerobot_pf2mp.dataset_tools

# From the top floor down; rooms on one line do not import each other either.
FLOORS = (
    ("commands",),
    ("figures",),
    ("benchmark", "fit_field", "serving", "unguarding"),
    ("loading", "field_report"),
    ("policies",),
    ("dataset_tools", "hub"),
    ("envs", "results", "guidance"),
    ("potential_field", "obstacle_field", "training"),
    ("flow_matching", "density", "process", "errors"),
    ("_autodiscover",),
)
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
PACKAGE = Path(lerobot_pf2mp.__file__).parent
TOOLS = Path(lerobot_pf2mp.dataset_tools.__file__).parent
TORCH_ALONE = ("potential_field", "obstacle_field", "flow_matching", "guidance", "density")
# The registration imports what registers, when LeRobot is imported; `lerobot_pf2mp/__init__.py` what it exports.
ABOVE_ALL = (PACKAGE / "__init__.py", PACKAGE / "_autodiscover/registration.py")


def files_of_rooms() -> list[tuple[str, Path]]:
    """Every source file with the room it lies in; pf2mp-info runs without the package and is no room."""
    files = [
        (path.relative_to(PACKAGE).parts[0].removesuffix(".py"), path)
        for path in PACKAGE.rglob("*.py")
        if path not in ABOVE_ALL and path.relative_to(PACKAGE).parts[0] not in ("_info", "dataset_tools")
    ]
    return files + [("dataset_tools", path) for path in TOOLS.rglob("*.py")]


def imports_of(path: Path) -> list[str]:
    """The modules that a file imports anywhere, also inside functions and for annotations."""
    modules = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.module and not node.level, f"{path} must import by full names"
            modules += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        elif isinstance(node, ast.Import):
            modules += [alias.name for alias in node.names]
    return modules


def test_every_file_lies_in_a_room() -> None:
    rooms = {room for room, _ in files_of_rooms()}
    assert rooms == set(FLOOR_OF)


def test_no_import_runs_back_up() -> None:
    upwards = []
    for room, path in files_of_rooms():
        for module in imports_of(path):
            parts = module.split(".")
            if (
                module.removeprefix("lerobot_pf2mp.") in lerobot_pf2mp._MODULES
            ):  # a name that the package exports
                parts = ["lerobot_pf2mp", *lerobot_pf2mp._MODULES[parts[1]].split(".")]
            other = parts[1] if parts[0] == "lerobot_pf2mp" and len(parts) > 1 else room
            if other in FLOOR_OF and other != room and FLOOR_OF[other] <= FLOOR_OF[room]:
                upwards.append(f"{path}: {module}")
    assert upwards == []


def test_the_maths_imports_torch_alone() -> None:
    allowed = {"torch", "lerobot_pf2mp", "numpy"}  # numpy only to hand tensors to the C extension
    foreign = [
        f"{path}: {module}"
        for room, path in files_of_rooms()
        if room in TORCH_ALONE
        for module in imports_of(path)
        if module.partition(".")[0] not in allowed | set(sys.stdlib_module_names)
    ]
    assert foreign == []


def test_no_class_has_more_than_three_bases() -> None:
    for _, path in files_of_rooms():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                assert len(node.bases) <= 3, f"{path}: {node.name}"
