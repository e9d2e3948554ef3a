"""A run folder that was damaged: every file, in every way, is refused in one sentence or does no harm."""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from izoo import train
from izoo.errors import IzooError
from izoo.training import checkpoint, run_folder
from tests.training.test_resume import flat

TOY = [
    *("contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "env.horizon_s=75", "algo.hidden=[8]"),
    *("algo.frames_per_batch=50", "algo.minibatch_rows=64", "evaluation.contexts=0", "validation.every_batches=0"),
    *("checkpoint.every_batches=1", "collector=single", "total_frames=100"),
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two batches with a checkpoint each."""
    run_dir = tmp_path_factory.mktemp("damage") / "run"
    assert train.main([*TOY, f"run_dir={run_dir}"]) == 0
    return run_dir


@pytest.fixture
def run_dir(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "run"))


def cut(share: float) -> Callable[[bytes], bytes]:
    return lambda data: data[: int(share * len(data))]


BINARY = bytes(range(256)) * 4
ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 12)
)
DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut in half": cut(0.5),
    "cut near the end": lambda data: data[:-3],
    "binary": lambda data: BINARY,
    "nested aliases": lambda data: ALIASES.encode(),
    "nested lists": lambda data: b"[" * 100_000,
    "interpolations": lambda data: data.replace(b"seed: 0", b"seed: ${total_frames}"),
    "another seed": lambda data: data.replace(b"\nseed: 0", b"\nseed: 1"),
    "a text for a number": lambda data: data.replace(b"\nseed: 0", b"\nseed: soon"),
    "a list": lambda data: b"- 1\n- 2\n",
    "a number": lambda data: b"7\n",
    "a date that is none": lambda data: data + b"when: 2001-99-99\n",
    "another option": lambda data: data + b"colour: blue\n",
    "an option twice": lambda data: data + b"seed: 3\n",
    "too large": lambda data: data + b"#" * 2_000_000,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_options_are_refused(run_dir: Path, damage: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = run_dir / run_folder.CONFIG_FILE
    changed = DAMAGES[damage](path.read_bytes())
    assert changed != path.read_bytes()
    path.write_bytes(changed)
    before = contents(run_dir)
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 2
    assert is_one_sentence(capsys.readouterr().err, run_folder.CONFIG_FILE)
    assert contents(run_dir) == before, "what could not be read was changed"
    with pytest.raises(IzooError):
        run_folder.load_policy(run_dir)


def contents(run_dir: Path) -> dict[str, bytes]:
    """What lies in a run folder."""
    return {str(path): path.read_bytes() for path in run_dir.rglob("*") if path.is_file()}


def is_one_sentence(error: str, named: str) -> bool:
    """Whether an error is one line of izoo that names the file, and no traceback."""
    lines = error.strip().splitlines()
    return len(lines) == 1 and lines[0].startswith("izoo train: ") and named in lines[0]


def test_a_pipe_for_options_is_refused(run_dir: Path) -> None:
    (run_dir / run_folder.CONFIG_FILE).unlink()
    os.mkfifo(run_dir / run_folder.CONFIG_FILE)
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 2


def test_options_that_may_change_and_the_place_of_a_run_do_not_matter(run_dir: Path, tmp_path: Path) -> None:
    moved = run_dir.rename(tmp_path / "elsewhere")
    assert train.main([f"resume={moved}", "total_frames=150"]) == 0
    assert checkpoint.load(checkpoint.find(moved))["frames"] == 150
    with pytest.raises(IzooError, match=r"is one checkpoint, so checkpoint=best chooses nothing"):
        checkpoint.find(checkpoint.find(moved), "best")


TABLES: dict[str, tuple[Callable[[bytes], bytes], int]] = {
    "empty": (lambda data: b"", 0),
    "header alone": (lambda data: data.splitlines(keepends=True)[0], 0),
    "cut in half": (cut(0.5), 0),
    "cut near the end": (lambda data: data[:-3], 0),
    "binary": (lambda data: BINARY, 2),
    "zeros": (lambda data: bytes(len(data)), 2),
    "text in a cell": (lambda data: data.replace(b"50,", b"fifty,", 1), 2),
    "another header": (lambda data: b"a,b\n" + data.split(b"\n", 1)[1], 2),
}


@pytest.mark.parametrize("damage", TABLES)
def test_a_damaged_table_is_refused_or_said_to_be_short(
    run_dir: Path, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    change, code = TABLES[damage]
    path = run_dir / run_folder.METRICS_FILE
    path.write_bytes(change(path.read_bytes()))
    damaged = path.read_bytes()
    assert train.main([f"resume={run_dir}"]) == code  # nothing is left to train
    error = capsys.readouterr().err
    if code:
        assert is_one_sentence(error, run_folder.METRICS_FILE) and path.read_bytes() == damaged
    else:
        assert "rows for 2 batches" in error


def same(one: Any, other: Any) -> bool:
    first, second = flat(one), flat(other)
    return first.keys() == second.keys() and all(
        torch.equal(leaf, second[path]) if isinstance(leaf, torch.Tensor) else leaf == second[path]  # type: ignore[arg-type]
        for path, leaf in first.items()
    )


def test_no_flipped_byte_passes(run_dir: Path) -> None:
    """At places all over the file: it is refused, and the one before is named, or nothing that is read has changed."""
    first, path = checkpoint.listed(run_dir)
    data, state = path.read_bytes(), checkpoint.load(path)
    refused = 0
    places = range(7, len(data), max(len(data) // 400, 1))
    for place in places:
        path.write_bytes(data[:place] + bytes([data[place] ^ 0x80]) + data[place + 1 :])
        try:
            assert same(checkpoint.load(path), state), f"byte {place} of {len(data)}"
        except IzooError as error:
            refused += 1
            assert str(first) in str(error)
    assert refused > 0.5 * len(places)


def test_a_damaged_part_is_named(run_dir: Path) -> None:
    path = checkpoint.find(run_dir)
    data = bytearray(path.read_bytes())
    optimiser = checkpoint.load(path)["algorithm"]["optimiser"]["state"][0]["exp_avg"].numpy().tobytes()
    place = data.index(optimiser[:64])
    data[place + 3] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(IzooError, match=r"step-000000000100\.pt is damaged: its part .*/data/\d+ is not what"):
        checkpoint.load(path)


def walk(state: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Checkpoints of which one entry is missing or is of another type, wherever it stands in the first two levels."""
    wrong: tuple[Any, ...] = (None, "text", -1.5, [1], {"a": 1}, torch.zeros(3))
    made: dict[str, dict[str, Any]] = {}
    for name in state:
        if name == "format":
            continue
        made[f"no {name}"] = {key: value for key, value in state.items() if key != name}
        for value in wrong:
            if type(value) is not type(state[name]):
                made[f"{name} is {type(value).__name__}"] = {**state, name: value}
    algorithm = state["algorithm"]
    for name in algorithm:
        less = {key: value for key, value in algorithm.items() if key != name}
        made[f"no algorithm.{name}"] = {**state, "algorithm": less}
        for value in wrong:
            if type(value) is not type(algorithm[name]):
                made[f"algorithm.{name} is {type(value).__name__}"] = {**state, "algorithm": {**algorithm, name: value}}
    made["histories hold a text"] = {**state, "histories": ["text"]}
    made["histories lack their commands"] = {**state, "histories": [{"episode": 0}]}
    made["random state is short"] = {**state, "torch_rng": torch.zeros(3, dtype=torch.uint8)}
    return made


@pytest.mark.slow
def test_missing_and_mistyped_entries_are_refused(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = checkpoint.find(run_dir)
    passed = []
    for name, state in walk(checkpoint.load(path)).items():
        torch.save(state, path)
        if train.main([f"resume={run_dir}"]) != 2 or not is_one_sentence(capsys.readouterr().err, path.name):
            passed.append(name)
    assert passed == []


@pytest.mark.parametrize("part", ["policy", "critic", "optimiser"])
def test_other_widths_are_refused(run_dir: Path, part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    assert train.main([*TOY, "algo.hidden=[4]", f"run_dir={other}"]) == 0
    path = checkpoint.find(run_dir)
    state = checkpoint.load(path)
    state["algorithm"][part] = checkpoint.load(checkpoint.find(other))["algorithm"][part]
    torch.save(state, path)
    capsys.readouterr()
    assert train.main([f"resume={run_dir}", "total_frames=150"]) == 2
    assert is_one_sentence(capsys.readouterr().err, "does not fit the options")


@pytest.mark.slow
def test_states_of_the_twin_that_others_saved_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Whatever they hold: compiled code would take them unchecked. The run itself goes on."""
    run_dir, words = tmp_path / "run", [word for word in TOY if not word.startswith("collector")]
    assert train.main([*words, "simulator=twin", "num_envs=2", "twin.threads=1", f"run_dir={run_dir}"]) == 0
    state = checkpoint.load(checkpoint.find(run_dir))
    for seed in range(6):
        packed = state["environments"]["packed"]
        whole = np.frombuffer(bytearray(zlib.decompress(packed[0].numpy().tobytes())), np.uint8)
        chosen = np.random.default_rng(seed).random(len(whole)) < 0.05
        whole[chosen] = np.random.default_rng(seed).integers(0, 256, chosen.sum())
        packed[0] = torch.frombuffer(bytearray(zlib.compress(whole.tobytes())), dtype=torch.uint8)
        torch.save(state, checkpoint.find(run_dir))
        capsys.readouterr()
        assert train.main([f"resume={run_dir}", f"total_frames={200 + 100 * seed}"]) == 0
        assert "saved the episodes in progress, left out here" in capsys.readouterr().out
        state = checkpoint.load(checkpoint.find(run_dir))
        assert state["frames"] == 200 + 100 * seed
    assert train.main([f"resume={run_dir}", "total_frames=800"]) == 0
    assert "left out" not in capsys.readouterr().out
