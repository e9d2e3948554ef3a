"""The collect command end to end at toy size, on real SUMO."""

import errno
import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import MemoryMappedTensor, TensorDict
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement, SliceSampler

from izoo import collect
from izoo.conf.train_options import CollectConfig
from izoo.errors import IzooError
from izoo.training import offline, stored_steps
from izoo.training.stored_steps import MANIFEST, StepsWriter, StoredSteps, open_steps, pack
from tests.conftest import Refused

TOY = ["contexts=pcg_easy", "contexts.inflow_vph_per_lane=600", "env.horizon_s=75", "env.emit=[context]"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("data") / "new" / "folder"
    assert collect.main([*TOY, "policy=random", "frames=300", f"out={out}"]) == 0
    return out


def test_the_data_load_back_memory_mapped(data: Path) -> None:
    steps = collect.load(data)
    assert steps.shape == (300,)
    rows = open_steps(data).rows
    assert isinstance(rows["agents", "observation"], MemoryMappedTensor)
    assert len(rows) < 2 * int(steps["agents", "mask"].sum()), "empty slots are not stored"
    mask = steps["agents", "mask"]
    assert bool(mask.any())
    action = steps["agents", "action"][mask]
    assert float(action.min()) < -3.0 and float(action.max()) > 1.5, "the random driver uses the whole range"
    assert bool(steps["next", "agents", "reward"].any()) and bool(steps["next", "done"].any())
    manifest = json.loads((data / MANIFEST).read_text())
    assert manifest["frames"] == 300
    assert len(manifest["observation_names"]) == steps["agents", "observation"].shape[-1]
    assert {path.suffix for path in data.iterdir() if path.name != MANIFEST} == {".bin"}


def test_steps_are_read_as_they_were_written() -> None:
    generator = torch.Generator().manual_seed(0)
    held = torch.rand(2, 20, 6, generator=generator) < 0.3
    held[:, 7] = False

    def agents(mask: torch.Tensor) -> TensorDict:
        number = torch.where(mask, torch.randint(0, 9, mask.shape, generator=generator), -1)
        values = torch.where(mask[..., None], torch.rand(*mask.shape, 3, generator=generator), 0.0)
        return TensorDict({"mask": mask, "number": number, "observation": values}, mask.shape)

    following = TensorDict({"agents": agents(held[1]), "done": torch.zeros(20, 1, dtype=torch.bool)}, [20])
    steps = TensorDict({"agents": agents(held[0]), "time": torch.arange(20), "next": following}, [20])
    stored = StoredSteps(pack(steps), 6)
    for index in (slice(None), torch.tensor([7]), torch.tensor([19, 0, 7, 3, 19])):
        assert bool((stored.get(index) == steps[index]).all())
    with pytest.raises(ValueError, match="rows of agents"):
        StoredSteps(pack(steps).set(("steps", "count"), torch.ones(20, dtype=torch.int64)), 6)


def test_the_size_is_said_before_anything_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert collect.main([*TOY, "policy=glide", "frames=100", f"out={tmp_path / 'out'}"]) == 0
    said = r"100 steps of some [\d.]+ kB: [\d.e-]+ GB in .* \([\d.e+]+ GB are free\)"
    assert re.search(said, capsys.readouterr().out)


def test_an_occupied_folder_is_refused(data: Path, refused: Refused) -> None:
    refused(collect.main, [*TOY, "frames=10", f"out={data}"], "not empty")
    assert collect.load(data).shape == (300,)


def test_batches_are_one_storage_that_reads_what_is_drawn(data: Path, tmp_path: Path) -> None:
    writer, steps = StepsWriter(CollectConfig(frames=300), tmp_path), collect.load(data)
    for begin in (0, 128, 256):
        writer.write(steps[begin : begin + 128])
    assert bool((collect.load(tmp_path) == steps).all())
    buffer = collect.replay_buffer(tmp_path, batch_size=64)
    whole, storage = torch.cat([collect.load(data)[worker::2] for worker in range(2)]), buffer.storage
    assert len(storage) == 300
    key = ("agents", "observation")
    for index in (torch.tensor([299, 0, 127, 128, 5, 299]), slice(120, 260), slice(None), [3, -1], torch.arange(0)):
        assert torch.equal(storage.get(index)[key], whole[key][index])
    assert torch.equal(storage[-300][key], whole[key][0]) and storage[7].shape == ()
    assert torch.equal(storage[torch.tensor([[1, 200], [2, 130]])][key], whole[key][torch.tensor([[1, 200], [2, 130]])])
    with pytest.raises(IndexError, match="out of bounds"):
        storage.get(300)
    with pytest.raises(IzooError, match="read only"):
        storage[0] = whole[0]
    sample = buffer.sample()
    assert sample.shape == (64,) and len(buffer) == 300
    assert torch.equal(sample[key], whole[key][sample["index"].view(-1)])
    assert set(sample["index"].view(-1).tolist()) - set(range(128))
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        buffer.extend(whole)
    ordered = collect.replay_buffer(tmp_path, sampler=SamplerWithoutReplacement(shuffle=False), batch_size=100)
    assert torch.equal(torch.cat([batch[key] for batch in ordered]), whole[key])


def test_slices_are_of_one_episode_of_one_environment(tmp_path: Path) -> None:
    words = [*TOY, "simulator=twin", "num_envs=3", "policy=tests.results.odd_policies:gentle", f"out={tmp_path / 'd'}"]
    assert collect.main([*words, "frames=500", "env.emit=[context,signal]"]) == 0
    sampler = SliceSampler(slice_len=10, trajectories=collect.trajectories(tmp_path / "d"), cache_values=True)
    buffer = collect.replay_buffer(tmp_path / "d", batch_size=400, sampler=sampler)
    slices = buffer.sample().reshape(-1, 10)
    assert (slices["agents", "action"][slices["agents", "mask"]] == 0.5).all(), "one's own policy was asked"
    for one in slices:
        assert one["context", "seed"].unique().numel() == 1
        assert torch.equal(one["agents", "observation"][1:], one["next", "agents", "observation"][:-1])
    assert slices["context", "seed"].unique().numel() > 3
    whole = collect.load(tmp_path / "d")
    order = torch.cat([torch.arange(environment, 500, 3) for environment in range(3)])
    assert torch.equal(buffer.storage[:]["agents", "observation"], whole["agents", "observation"][order])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "out=DIR"),
        (["out=o", "policy=tests.results.odd_policies:nobody"], "odd_policies has no nobody"),
        (["out=o", "policy=rnadom"], "Did you mean 'random'?"),
        (["out=o", "frames=0"], "frames is 0"),
        (["out=o", "contexts=dataset", "contexts.path=missing"], "missing"),
        (["out=o", "policy=."], "holds no checkpoint"),
        (["out=o", "contexts=pcg_easy", "simulator=twin", "twin.surrogate=cuda"], "choose twin.surrogate=torch"),
        (["out=o", "contexts=pcg", "env.num_approaches=2"], "num_approaches"),
    ],
)
def test_bad_input_leaves_nothing_behind(
    words: list[str], message: str, here: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    refused(collect.main, words, message)
    assert list(here.iterdir()) == []


def _manifest(**entries: Any) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        path = folder / MANIFEST
        path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))

    return change


def _cut_short(folder: Path) -> None:
    path = folder / "rows.agents.observation.bin"
    os.truncate(path, path.stat().st_size // 2)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda folder: (folder / MANIFEST).write_text("{"), "damaged"),
        (_manifest(format="other"), "of format 'other'"),
        (lambda folder: (folder / "steps.next.done.bin").unlink(), r"done\.bin has 0 bytes, and should have 300"),
        (_manifest(frames=10), "rows of agents"),
        (_manifest(leaves={"rows.../../secret": ["torch.float32", [1]]}), "is not a file name"),
        # Torch would extend the file with zeros, on disk.
        (_cut_short, r"observation\.bin has [\d,]+ bytes, and should have"),
    ],
)
def test_a_data_set_that_is_not_whole_is_refused(
    damage: Callable[[Path], object], message: str, data: Path, tmp_path: Path
) -> None:
    shutil.copytree(data, tmp_path / "data")
    damage(tmp_path / "data")
    with pytest.raises(IzooError, match=message):
        collect.load(tmp_path / "data")


def test_a_full_disk_is_said_and_leaves_what_was_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    out, parts = tmp_path / "data", []

    def fill(steps: TensorDict) -> TensorDict:
        parts.append(steps)
        if len(parts) > 3:  # the first says how large the data will be
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return pack(steps)

    monkeypatch.setattr(stored_steps, "pack", fill)
    monkeypatch.setattr(offline, "pack", fill)
    monkeypatch.setattr(offline, "FRAMES_PER_BATCH", 100)
    words = ["policy=random", "frames=1000", "env.num_agents=16", "env.horizon_s=60", f"out={out}"]
    refused(collect.main, words, "200 steps are complete. Make room", code=1)
    assert len(collect.load(out)) == 200


def test_what_was_cut_off_is_never_part_of_the_data(tmp_path: Path, data: Path) -> None:
    shutil.copytree(data, tmp_path / "data")
    for path in (tmp_path / "data").glob("*.bin"):
        path.write_bytes(path.read_bytes() + b"cut")
    assert bool((collect.load(tmp_path / "data") == collect.load(data)).all())
