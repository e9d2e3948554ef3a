"""What the ghosts of an intersection show, second by second."""

import dataclasses

import pytest

from izoo.contexts.procedural import procedural_intersection
from izoo.contexts.spec import IntersectionSpec, SignalPhase, SignalPlan
from izoo.errors import IzooError
from izoo.networks.net.build import build_net
from izoo.networks.net.programs import ghost_program
from tests.networks.worlds import saved_states


def seconds(spec: IntersectionSpec, leg: str) -> list[str]:
    """Colours of the straight and the turning source of a leg over one cycle, from the moment the plan begins."""
    program = ghost_program(spec, spec.signal_plan, leg)
    shown = [one + two for duration_s, one, two in program.phases for _ in range(int(duration_s))]
    return [shown[int(time_s - program.offset_s) % len(shown)] for time_s in range(len(shown))]


def run_lengths(shown: list[str]) -> list[tuple[str, int]]:
    runs: list[tuple[str, int]] = []
    for state in shown:
        runs = [*runs[:-1], (state, runs[-1][1] + 1)] if runs and runs[-1][0] == state else [*runs, (state, 1)]
    return runs


def test_ghosts_repeat_the_signal_of_their_own_leg():
    spec = procedural_intersection(1, 2, green_s=20.0, red_s=30.0)
    assert run_lengths(seconds(spec, "A")) == [("Gr", 20), ("yr", 3), ("rG", 48), ("ry", 3)]
    assert run_lengths(seconds(spec, "B")) == [("rG", 29), ("ry", 3), ("Gr", 30), ("yr", 3), ("rG", 9)]
    assert seconds(spec, "C") == seconds(spec, "A")
    assert seconds(spec, "D") == seconds(spec, "B")


@pytest.mark.parametrize("phase_count", [1, 2])
def test_a_built_net_shows_the_main_signal_at_its_ghosts(phase_count, tmp_path):
    spec = procedural_intersection(1, phase_count, green_s=20.0, red_s=30.0, offset_s=2.0)
    shown = saved_states(build_net(spec, tmp_path), tmp_path, ("TL", "A", "B"), 200)
    per_leg = len(shown["TL"][0.0]) // 4
    for time_s in range(2, 198):
        for number, leg in enumerate("AB"):
            main = shown["TL"][time_s - 2.0][number * per_leg : (number + 1) * per_leg]
            # The straight link is the first of a leg that may not turn right.
            assert shown[leg][float(time_s)][0] == main[0].replace("g", "G"), (leg, time_s)


@pytest.mark.parametrize(
    ("phases", "message"),
    [
        ((SignalPhase(30.0, (("A", "C", "G"),)),), "always green"),
        ((SignalPhase(30.0, (("B", "D", "G"),)),), "never green"),
        ((SignalPhase(30.0, (("A", "C", "G"),)), SignalPhase(2.0, ())), "red for 2 s"),
    ],
)
def test_a_main_signal_that_cannot_be_repeated_is_refused(phases, message):
    spec = procedural_intersection(1, 1)
    with pytest.raises(IzooError, match=message):
        ghost_program(spec, SignalPlan(phases), "A")


def test_a_ghost_needs_a_yellow():
    spec = procedural_intersection(1, 1)
    spec = dataclasses.replace(spec, ghosts=dataclasses.replace(spec.ghosts, yellow_s=0.0))
    with pytest.raises(IzooError, match="must exceed 0 s"):
        ghost_program(spec, spec.signal_plan, "A")
