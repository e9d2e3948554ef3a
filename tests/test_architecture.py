"""The arrows of the design: rooms import only what lies below them, and the simulator has one door."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = {"izoo": ROOT / "izoo", "izoo.envs": ROOT / "envs", "izoo.algos": ROOT / "algos"}
FOLDERS["izoo.benchmarks"] = ROOT / "benchmarks"
SIMULATOR = {"libsumo", "traci"}

BASICS = {"errors", "metrics", "emissions"}
ALLOWED = {
    "errors": set(),
    "metrics": {"errors"},
    "emissions": {"errors"},
    "contexts": BASICS,
    "networks": BASICS | {"contexts"},
    "traffic": BASICS | {"contexts"},
    "drivers": BASICS | {"contexts", "traffic"},
    "envs": BASICS | {"contexts", "networks", "traffic"},
    "algos": BASICS | {"contexts", "networks", "traffic", "envs"},
}
"""Per room the rooms it may import; rooms that are not named are commands and what commands share: they may all."""


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


def violations(name: str, path: Path, source: str | None = None) -> list[str]:
    """Imports of a module that point the wrong way."""
    here = room(name)
    # What ``python -m`` runs is a command, whichever room it is named after.
    if here not in ALLOWED or name.endswith(".__main__"):
        return []
    targets = {(room(target), target) for target in imports(name, path, source)}
    rooms = {entry.stem for entry in (ROOT / "izoo").iterdir()} | {"envs", "algos", "benchmarks"}
    return [
        f"{name} imports {target}"
        for there, target in sorted(targets, key=str)
        if there in rooms and there != here and there not in ALLOWED[here]
    ]


@pytest.mark.parametrize(("name", "path"), modules(), ids=lambda value: value if isinstance(value, str) else "")
def test_arrows_point_one_way(name: str, path: Path) -> None:
    assert violations(name, path) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("izoo.metrics.scores", "from izoo.contexts.context import Context"),
        ("izoo.contexts.context", "import izoo.networks"),
        ("izoo.networks.net.build", "from izoo.traffic import demand"),
        ("izoo.traffic.demand", "from izoo import envs"),
        ("izoo.envs.env", "def late():\n    from izoo.algos.ppo import PPO"),
        ("izoo.algos.ppo", "from izoo.training import runs"),
        ("izoo.algos.ppo", "from ..conf import options"),
    ],
)
def test_the_arrow_check_can_fail(name: str, source: str) -> None:
    assert violations(name, Path("module.py"), source)


def test_one_module_imports_the_simulator() -> None:
    users = [name for name, path in modules() if {target.split(".")[0] for target in imports(name, path)} & SIMULATOR]
    assert len(users) == 1, f"modules that import the simulator: {users}"
    assert users[0].startswith("izoo.envs.")


def test_the_top_level_is_what_was_agreed() -> None:
    """User-visible folders and files; dot files, build products and local runs aside."""
    products = {"build", "dist", "runs", "multirun", "outputs", "wandb", "__pycache__"}
    seen = {entry.name for entry in ROOT.iterdir() if not entry.name.startswith(".")} - products
    seen = {name for name in seen if not name.endswith(".egg-info")}
    assert seen == {
        *("pyproject.toml", "izoo", "envs", "algos", "benchmarks", "tests", "README.md"),
        *("Makefile", "constraints.txt", "LICENSE", "Dockerfile", "mkdocs.yml"),
        *("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md"),
    }
