"""Reference pages agree with the code: TensorDict layout, options, commands, examples, navigation."""

import ast
import dataclasses
import functools
import re
from typing import Any

import pytest
import yaml

from izoo.conf.choices import groups
from izoo.docs import pages
from izoo.envs import EcoDrivingEnv, EnvConfig
from izoo.envs.config import EMIT_GROUPS
from izoo.envs.mdp.reward import REWARD_VECTOR
from tests.docs import blocks
from tests.docs.blocks import DOCS, ROOT

ROW = re.compile(r"^\| `(\([^`]+\)|\w+)` \| `\[([^`]*)\]` \| (\w+) \|", re.MULTILINE)
READ_IF_THERE = {("agents", "defer")}


def test_layout() -> None:
    """Of environments that emit and read everything, with decisions in every step and once per vehicle."""
    documented: dict[tuple[str, ...], tuple[str, str]] = {}
    for row, shape, kind in ROW.findall((DOCS / "layout.md").read_text()):
        key = ast.literal_eval(row) if row.startswith("(") else (row,)
        assert key not in documented, f"{key} stands there twice"
        documented[key] = (shape, kind)
    emitted = {}
    for options in ({"lane_change": True}, {"decide": "vehicle", "action": "speed"}):
        env = EcoDrivingEnv(config=EnvConfig(emit=EMIT_GROUPS, **options))  # type: ignore[arg-type]
        config = env.config
        letters = {config.num_agents: "A", config.num_vehicles: "V", config.num_approaches: "P"}
        letters |= {len(env.observation_names): "F", len(REWARD_VECTOR): "R"}
        for spec in (env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec):
            for key in spec.keys(True, True):
                shape = ", ".join(letters.get(size, str(size)) for size in spec[key].shape)
                kind = str(spec[key].dtype).removeprefix("torch.")
                emitted[key if isinstance(key, tuple) else (key,)] = (shape, kind)
    assert {key: value for key, value in documented.items() if key not in READ_IF_THERE} == emitted
    assert documented.keys() >= READ_IF_THERE


@functools.cache
def options_page() -> str:
    return pages.options_page()


def leaves(config: Any, prefix: str = "") -> set[str]:
    """Every option of a dataclass and of those inside it."""
    found = set()
    for field in dataclasses.fields(config):
        value, path = getattr(config, field.name), f"{prefix}{field.name}"
        if dataclasses.is_dataclass(value):
            found |= leaves(value, f"{path}.")
        elif field.name != "name":
            found.add(path)
    return found


@pytest.mark.slow
def test_options() -> None:
    """Every option of every command in every choice is on the page, with a default and a meaning."""
    page = options_page()
    rows = dict(re.findall(r"^\| `([\w.]+)` \|(.*)\|$", page, re.MULTILINE))
    expected = leaves(EnvConfig(), "env.")
    for command in pages.hydra_commands():
        expected |= leaves(command.config_class()())
    for group, choices in groups().items():
        for choice, make in choices.items():
            expected |= leaves(make(), f"{group}.")
            assert f"`{group}={choice}`" in page
    assert expected <= rows.keys()
    empty = [name for name, cells in rows.items() if not cells.rpartition("|")[2].strip()]
    assert not empty, f"options without a meaning in their dataclass's docstring: {empty}"


def test_presets_stand_side_by_side() -> None:
    (row,) = re.findall(r"^\| `algo.epochs` \| (.*) \| passes over", options_page(), re.MULTILINE)[-1:]
    assert row == "`4` | `4` | `30` | `6`", "of PPO and its presets imitation, paper and vehicle"


def test_every_command_has_its_help() -> None:
    page = pages.commands_page()
    for name in pages.argparse_commands():
        assert f"## python -m {name}\n" in page
    assert "### contexts build" in page and "an extract, .osm or .osm.pbf" in page
    assert pages.modules().keys() >= {"izoo.train", "izoo.evaluate", "izoo.collect", "izoo.report", "izoo.contexts"}
    for command in pages.hydra_commands():
        assert f"## python -m izoo.{command.name}\n" in options_page()


def test_markers() -> None:
    filled = pages.on_page_markdown("Text\n<!-- source: examples/own_city.py -->\nmore")
    assert "\n    def main(\n        extract: Path | None = None," in filled
    assert filled.startswith("Text\n??? example") and filled.endswith("more")
    assert pages.on_page_markdown("<!-- run: a=1 -->") == "<!-- run: a=1 -->"


def test_every_example_and_page_can_be_found() -> None:
    examples = (DOCS / "examples.md").read_text()
    for path in (DOCS / "examples").glob("[a-z]*.py"):
        assert f"(examples/{path.name})" in examples and f"<!-- source: examples/{path.name} -->" in examples
    # Material's own tags are of no interest here.
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    listed = re.findall(r"[\w/]+\.md", str(site["nav"]))
    assert sorted(listed) == sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


def test_links_lead_to_files() -> None:
    for page in [*blocks.pages(), ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)", page.read_text()):
            if "://" not in target and not target.startswith("mailto:"):
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_site_asks_for_nothing_from_the_network() -> None:
    text = (ROOT / "mkdocs.yml").read_text()
    assert "://" not in text and "font: false" in text
