"""The wheel holds everything and nothing else, and the constraints cover what it needs."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # type: ignore[import-not-found]  # comes with pytest there

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
SUFFIXES = (".py", ".yaml", ".json", ".csv", ".npz", ".osm", ".pt")
MAPPING = {"envs": "izoo/envs", "algos": "izoo/algos", "benchmarks": "izoo/benchmarks"}


def packages_on_disk() -> set[str]:
    """Dotted names of all folders with an ``__init__.py``, as they are installed."""
    found = set()
    for top in ("izoo", *MAPPING):
        for path in (ROOT / top).rglob("__init__.py"):
            parts = path.parent.relative_to(ROOT).parts
            found.add(".".join(parts if top == "izoo" else ("izoo", *parts)))
    return found


def test_every_package_is_listed() -> None:
    assert set(PROJECT["tool"]["setuptools"]["packages"]) == packages_on_disk()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    # Built from a copy: a build folder in the tree would carry files from earlier builds into the wheel.
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(source)], check=True, capture_output=True)
    (built,) = folder.glob("izoo-*.whl")
    return built


def test_the_wheel_holds_all_modules_and_data(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for top in ("izoo", *MAPPING):
        for path in (ROOT / top).rglob("*"):
            if path.suffix in SUFFIXES and "__pycache__" not in path.parts:
                inside = MAPPING.get(top, top)
                assert f"{inside}/{path.relative_to(ROOT / top).as_posix()}" in names
    assert "izoo/py.typed" in names
    tops = {name.split("/")[0] for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert tops == {"izoo"}, "envs, algos and benchmarks must not be top-level packages"
    assert "izoo/emissions/data/LICENSE" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_environment(wheel: Path, tmp_path: Path) -> None:
    """Installed alone beside the dependencies, from a folder that knows nothing of the source tree."""
    target, work = tmp_path / "site", tmp_path / "work"
    work.mkdir()
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(target), str(wheel)]
    subprocess.run(command, check=True, capture_output=True)
    code = (
        f"import sys; sys.path.insert(0, {str(target)!r})\n"
        "sys.meta_path[:] = [finder for finder in sys.meta_path if 'editable' not in repr(finder).lower()]\n"
        "import izoo.envs, izoo.algos, izoo.benchmarks\n"
        "from izoo import train\n"
        "assert all(module.__file__.startswith(sys.path[0]) for module in (train, izoo.envs, izoo.algos))\n"
        "sys.exit(train.main(['contexts=pcg_easy', 'total_frames=50', 'algo.frames_per_batch=50', 'env.horizon_s=60',\n"
        "                     'evaluation.contexts=0', 'num_workers=2']))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=work, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("Compiling") == 1, "two workers start, one compiles"
    (run_dir,) = (work / "runs").iterdir()
    assert (run_dir / "metrics.csv").is_file()


def test_constraints_pin_every_dependency() -> None:
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    assert all(re.fullmatch(r"[a-z0-9.-]+==[\w.]+( ; python_version (<|>=) '3\.\d+')?", line) for line in lines)
    pinned = {line.split("==")[0] for line in lines}
    groups = [PROJECT["project"]["dependencies"], *PROJECT["project"]["optional-dependencies"].values()]
    needed = {re.split(r"[<>=\[; ]", item)[0].lower() for group in groups for item in group}
    assert needed - {"izoo"} <= pinned
    assert "torch==2.13.0" in lines


def test_no_index_host_is_named() -> None:
    for name in ("pyproject.toml", "constraints.txt", "Makefile", "Dockerfile", ".ci/run"):
        text = (ROOT / name).read_text()
        assert "://" not in text and "index-url" not in text and "find-links" not in text
