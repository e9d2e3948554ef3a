"""The speed benchmarks: what cannot be measured is refused, Ctrl-C ends them with its own code, rows fit together."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from izoo import console
from izoo.benchmarks import emissions, scaling, throughput
from izoo.benchmarks.timing import twin_parts
from izoo.benchmarks.timing.twin_parts import PARTS
from izoo.envs import EcoDrivingEnv


@pytest.mark.parametrize(
    ("main", "words", "message"),
    [
        (throughput.main, ["workers=0"], "workers is 0"),
        (throughput.main, ["twin_threads=[0]"], "twin_threads is 0"),
        (throughput.main, ["steps=199"], "steps is 199; it must be a multiple of 200"),
        (throughput.main, ["scenarios=[lihgt]"], "Did you mean 'light'"),
        (scaling.main, ["steps=0"], "steps is 0"),
        (scaling.main, ["simulator=twin", "counts=[0]"], "num_envs and counts is 0"),
        (scaling.main, ["simulator=twni"], "Did you mean 'twin'"),
        (emissions.main, ["batch=0"], "batch is 0"),
    ],
)
def test_what_cannot_be_measured_is_refused(main, words, message, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words) == 2
    said = capsys.readouterr()
    assert message in said.err and "Loading" not in said.out


def test_a_world_has_traffic_until_all_steps_are_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits for a reset within them."""
    resets, whole = [], EcoDrivingEnv._reset

    def counted(env: EcoDrivingEnv, *args: Any, **options: Any) -> Any:
        resets.append(len(resets))
        return whole(env, *args, **options)

    monkeypatch.setattr(EcoDrivingEnv, "_reset", counted)
    monkeypatch.setattr(scaling, "SETTLE_STEPS", 1900)  # as many as an episode of the paper has, nearly
    row = scaling.measure(scaling.worlds()[0], 200)
    assert len(resets) == scaling.RESETS + 2 and row["vehicles"] > 0.0 and row["bare_us"] > 0.0


def test_an_interrupt_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> int:
        raise KeyboardInterrupt

    assert console.exit_code("benchmarks.scaling", interrupted) == 130
    assert capsys.readouterr().err == "izoo benchmarks.scaling: stopped.\n"
    assert console.exit_code("benchmarks.scaling", lambda: 7) == 7


@pytest.mark.slow
def test_throughput_compares_like_with_like(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(throughput, "ROUNDS", 1)
    found = throughput.run(throughput.ThroughputConfig(("light",), workers=1, steps=200, twin_envs=(1, 4)))
    assert "bare libsumo" in capsys.readouterr().out
    rows = {row.variant: dataclasses.asdict(row) for row in found}
    bare = rows["bare libsumo"]
    assert len(rows) == 16 and bare["ratio_to_bare"] == 1.0
    assert all(row["env_steps_per_s"] > 0.0 and row["ratio_to_bare"] > 0.0 for row in rows.values())
    # The same episode everywhere: what nobody commands looks the same in any process, what is commanded alike, too.
    one, stepped = rows["one environment"], rows["one environment, step()"]
    for counted in ("agents", "vehicles"):
        assert bare[counted] == rows["1 worker, bare libsumo"][counted]
        assert one[counted] == rows["1 worker, parallel"][counted] == rows["1 worker, multisync"][counted]
        assert stepped[counted] == rows["one, all groups, step()"][counted] == pytest.approx(one[counted], rel=0.05)
    assert one["vehicles"] == pytest.approx(bare["vehicles"], rel=0.3)
    for label in ("twin, 1 environment", "twin, 4 environments", "twin, 4 environments, 2 threads"):
        assert rows[label]["vehicles"] == pytest.approx(one["vehicles"], rel=0.3)
    assert rows["twin, 4 environments, PPO"]["env_steps_per_s"] > 0.0
    # The same policy meets the same traffic, wherever it runs.
    parallel, multisync = rows["1 worker, parallel, PPO"], rows["1 worker, multisync, PPO"]
    assert parallel["agents"] == pytest.approx(multisync["agents"], rel=0.2)


@pytest.mark.slow
def test_scaling_of_the_twin(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    few = scaling.worlds()[2:4]
    monkeypatch.setattr(scaling, "worlds", lambda: few)
    for name, value in (("MIDDLE", 0), ("SETTLE_STEPS", 20), ("MANY_STEPS", 5)):
        monkeypatch.setattr(scaling, name, value)
    assert scaling.main(["simulator=twin", "steps=20", "num_envs=2", "counts=[1,4]"]) == 0
    shown = capsys.readouterr().out
    assert "driving" in shown and "least squares" in shown
    row = twin_parts.measure(few[0], 2, 20, 20)
    assert row["environments"] == 2.0 and row["vehicles"] > 1.0 and 50.0 < row["kilobytes"] < 1000.0
    assert 0.0 < sum(row.get(f"{name}_us", 0.0) for name in PARTS) < row["whole_us"]
