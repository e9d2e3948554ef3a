"""The house: every room has a floor and imports only what lies below it.

Imports inside functions count as well. Parts of names that are written as text, as commands name what they run, do not.
"""

import ast
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {"izoo": ROOT / "izoo", "izoo.envs": ROOT / "envs", "izoo.algos": ROOT / "algos"}
FOLDERS["izoo.benchmarks"] = ROOT / "benchmarks"
SIMULATOR = {"libsumo", "traci"}

FLOORS = (
    {"errors", "cores"},
    {"options"},
    {"files", "console", "gpu", "imports", "processes"},
    {"compiling", "user_key"},
    {"metrics", "emissions"},
    {"contexts"},
    {"networks"},
    {"traffic"},
    {"drivers", "envs"},
    {"algos"},
    {"conf"},
    {"tasks", "zoo"},
    {"results"},
    {"training"},
    {"report"},
    {"cli"},
    {"benchmarks", "train", "evaluate", "collect", "leaderboard"},
    {"docs"},
)
"""Rooms from the ground up; rooms that share a floor do not know each other."""
ENV_FLOORS = (
    {"config", "tables", "mdp", "model_version"},
    {"backend", "simulation"},
    {"sumo", "twin"},
    {"specs", "frame_io", "frame_copies", "render", "env", "side_by_side", "twin_env"},
    {"views"},
)
"""The same inside ``envs``; modules that share a floor are one room: the MDP, or the face that TorchRL sees."""


def modules() -> list[tuple[str, Path]]:
    """Every module of the project with its dotted name."""
    found = []
    for package, folder in FOLDERS.items():
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            found.append((".".join([package, *(part for part in parts if part != "__init__")]), path))
    return found


def imports(name: str, path: Path, source: str | None = None) -> set[str]:
    """Dotted names that a module imports anywhere, relative ones resolved, type-checking ones included."""
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    found: set[str] = set()
    for node in ast.walk(ast.parse(source if source is not None else path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            start = ".".join([*base, *([node.module] if node.module else [])])
            found |= {start, *(f"{start}.{alias.name}" for alias in node.names)}
    return found


def room(name: str) -> str | None:
    """The room of a dotted name of the project: ``izoo.contexts.spec`` is in ``contexts``."""
    parts = name.split(".")
    return parts[1] if parts[0] == "izoo" and len(parts) > 1 else None


def rooms() -> set[str]:
    """Every room that there is: folders and files of the package, and what is installed inside it."""
    inside = {entry.stem for entry in (ROOT / "izoo").iterdir() if entry.suffix == ".py" or entry.is_dir()}
    return {*inside, "envs", "algos", "benchmarks"} - {"__init__", "__main__", "__pycache__"}


def floor(place: str | None, floors: tuple[set[str], ...] = FLOORS) -> int | None:
    """The floor of a room, or ``None`` where it has none."""
    return next((number for number, names in enumerate(floors) if place in names), None)


def violations(name: str, path: Path, source: str | None = None) -> list[str]:
    """Imports of a module that point upwards, or sideways into another room."""
    # What ``python -m`` runs is an entry, whichever room it is named after.
    here, level = room(name), len(FLOORS) if name.endswith(".__main__") else floor(room(name))
    found = []
    for target in sorted(imports(name, path, source)):
        there = room(target)
        if there in (here, None) or there not in rooms():
            continue
        other = floor(there)
        if level is None or other is None or other >= level:
            found.append(f"{name} imports {target}")
    return found


def env_violations(name: str, path: Path, source: str | None = None) -> list[str]:
    """The same inside ``envs``, whose table of contents may name everything."""
    parts = name.split(".")
    if parts[:2] != ["izoo", "envs"] or len(parts) == 2:
        return []
    level, found = floor(parts[2], ENV_FLOORS), []
    if level is None:
        return [f"{name} has no floor"]
    for target in sorted(imports(name, path, source)):
        there = target.split(".")
        if there[:2] != ["izoo", "envs"] or len(there) == 2 or there[2] == parts[2]:
            continue
        other = floor(there[2], ENV_FLOORS)
        if other is not None and (other > level or (other == level and {"sumo", "twin"} == {parts[2], there[2]})):
            found.append(f"{name} imports {target}")
    return found


@pytest.mark.parametrize(("name", "path"), modules(), ids=lambda value: value if isinstance(value, str) else "")
def test_arrows_point_down(name: str, path: Path) -> None:
    assert violations(name, path) + env_violations(name, path) == []


def test_every_room_has_a_floor() -> None:
    assert {place for place in rooms() if floor(place) is None} == set()
    named = Counter(name for names in FLOORS for name in names)
    assert set(named.values()) == {1}


@pytest.mark.parametrize(
    ("check", "name", "source"),
    [
        (violations, "izoo.metrics.figures", "from izoo.contexts.context import Context"),
        (violations, "izoo.envs.env", "def late():\n    from izoo.algos.learners.ppo import PPO"),
        (violations, "izoo.algos.learners.ppo", "from ...conf import mapping"),
        (violations, "izoo.cli.option_command", "import izoo.benchmarks.campaign.jobs"),
        (violations, "izoo.new_room.thing", "from izoo import errors"),
        (env_violations, "izoo.envs.mdp.reward", "from izoo.envs.sumo.session import Session"),
        (env_violations, "izoo.envs.backend", "from izoo.envs.twin import state"),
        (env_violations, "izoo.envs.twin.runtime.layout", "from izoo.envs.sumo import session"),
        (env_violations, "izoo.envs.nowhere", "import math"),
    ],
)
def test_the_checks_can_fail(check: Callable[[str, Path, str], list[str]], name: str, source: str) -> None:
    assert check(name, Path("module.py"), source)


@pytest.mark.parametrize(
    ("program", "absent"),
    [
        ("import izoo.emissions.kernel, izoo.contexts.catalogue as c; c.get(5).content_hash", ("torch", "pandas")),
        ("import izoo.envs.sumo.simulator, izoo.envs.sumo.worker, izoo.envs.twin.runtime.preparers", ("torch",)),
        (
            "import gymnasium as g; g.make('izoo.envs:izoo/EcoDriving-v0'); g.spec('izoo/EcoDrivingEgo-v0')",
            ("torch", *SIMULATOR),
        ),
        ("from izoo.algos.learners import registry; registry.choices()", ("torch",)),
        ("import izoo.algos.losses", ("izoo.envs", "izoo.conf", *SIMULATOR)),
    ],
)
def test_what_is_used_without_the_rest_does_not_import_it(program: str, absent: tuple[str, ...]) -> None:
    code = f"{program}; import sys; print([name for name in sys.modules if name.startswith({absent})])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=100)
    assert done.stdout == "[]\n"


def test_one_module_imports_the_simulator() -> None:
    users = [name for name, path in modules() if {target.split(".")[0] for target in imports(name, path)} & SIMULATOR]
    assert len(users) == 1, f"modules that import the simulator: {users}"
    assert users[0].startswith("izoo.envs.sumo.")


def test_the_top_level_is_what_was_agreed() -> None:
    """User-visible folders and files; dot files, build products and local runs aside."""
    products = {"build", "dist", "runs", "multirun", "outputs", "wandb", "__pycache__"}
    seen = {entry.name for entry in ROOT.iterdir() if not entry.name.startswith(".")} - products
    seen = {name for name in seen if not name.endswith(".egg-info")}
    assert seen == {
        *("pyproject.toml", "izoo", "envs", "algos", "benchmarks", "tests", "results", "README.md"),
        *("Makefile", "constraints.txt", "LICENSE", "Dockerfile", "mkdocs.yml"),
        *("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"),
    }
