"""Whole sets of training options that go together, by name: ``recipe=NAME``.

Other words on the command line change them. A word that chooses another algorithm, action mode, set of contexts or
reward takes the place of all that the recipe says about it, since the options of one choice mean nothing to another.
"""

from __future__ import annotations

from collections.abc import Sequence

from izoo.errors import unknown_choice

RECIPE = "recipe="
BUSY_LANE = (
    "contexts=pcg",
    "contexts.lane_count=1",
    "contexts.phase_count=1",
    "contexts.inflow_vph_per_lane=400..600",
    "contexts.green_s=20..26",
    "contexts.red_s=24..32",
    "contexts.lane_length_m=250..500",
    "simulator=twin",
    "twin.surrogate=compiled",
    "env.num_agents=32",
    "env.num_vehicles=128",
    "evaluation.contexts=16",
    "evaluation.seeds=1",
)
"""One-lane approaches near capacity, where smooth driving helps most, and the simulator that suits them."""
ADVISED = (*BUSY_LANE, "action=advise", "env.hold_s=2")
"""The same, advised every 2 s."""
ONCE = (
    "action=speed",
    "action.initial=0.75",
    "env.action=speed",
    "env.action_parts=[speed_before]",
    "env.decide=vehicle",
    "env.reward=fuel",
)
"""A CV chooses a desired speed for its way to the stop line when it enters."""
GLIDE_SEARCH = (
    "contexts.adoption=[0.1,0.3333333333333333,1.0]",
    "simulator=twin",
    "twin.surrogate=compiled",
    "twin.compare_every=0",
    "twin.stagger=false",
    "action=direct",
    "env.hold_s=2",
    "env.num_agents=64",
    "env.num_vehicles=192",
    "env.reward=fuel_team",
    "env.reward.delay=-0.2",
    "env.horizon_s=600",
    "env.neighbours=[leader,follower]",
    "env.observed=[adoption,green_s,red_s,lane_count,lane_length_m,speed_limit_mps]",
    "num_envs=512",
    "algo=glide_search",
    "total_frames=3072000",
    "validation.every_batches=5",
    "validation.contexts=48",
    "validation.simulator=twin",
    "evaluation.contexts=16",
)
"""The settings of glide, searched by what whole teams are paid: 20 generations of 32 contexts for each of 16 rules."""
RECIPES: dict[str, tuple[str, tuple[str, ...]]] = {
    "busy_lane": (
        "one-lane approaches near capacity, on the twin; every CV chooses its speed once: what make train trains",
        (
            *BUSY_LANE,
            *ONCE,
            "num_envs=64",
            "algo=ppo",
            "algo.control_variate=vehicle",
            "algo.frames_per_batch=1536",
            "algo.epochs=6",
            "algo.lr=5e-3",
            "algo.activation=relu",
            "algo.separate_clips=true",
            "algo.max_grad_norm=1",
            "total_frames=92160",
            "validation.every_batches=20",
            "validation.contexts=32",
            "validation.seeds=1",
            "validation.simulator=twin",
        ),
    ),
    "busy_lane_imitation": (
        "the same approaches; the policy imitates glide, every 2 s",
        (
            *ADVISED,
            "num_envs=32",
            "algo=ppo",
            "algo.warm_start=glide",
            "algo.warm_start_frames=96000",
            "algo.frames_per_batch=9600",
            "algo.minibatch_rows=512",
            "algo.lr=2e-3",
            "algo.separate_clips=true",
            "algo.max_grad_norm=2",
            "algo.activation=relu",
            "total_frames=96000",
            "validation.every_batches=2",
            "validation.contexts=6",
        ),
    ),
    "city": (
        "all roads of Salt Lake City, on the twin; the settings of glide are searched by what whole teams are paid",
        (
            "contexts=city",
            "contexts.city=salt_lake_city",
            "contexts.split=train",
            "contexts.weather=published",
            *GLIDE_SEARCH,
        ),
    ),
    "measured": (
        "the same on measured intersections, at several shares of CVs: needs contexts.path=DATASET",
        (
            "contexts=dataset",
            "contexts.split=train",
            *GLIDE_SEARCH,
        ),
    ),
    "busy_lane_search": (
        "the same approaches; linear policies are searched by what whole teams are paid",
        (
            *ADVISED,
            "num_envs=256",
            "env.reward=fuel_team",
            "env.neighbours=[leader]",
            "env.observed=[green_s,red_s,speed_limit_mps]",
            "algo=cmaes",
            "total_frames=1990000",
            "validation.every_batches=4",
            "validation.contexts=16",
            "validation.simulator=twin",
        ),
    ),
}
"""What each recipe is for, and its words."""
_CHOICES = ("algo", "action", "contexts", "env.reward")
"""Options that another choice takes the place of, with all that stand below them."""
_DECISIONS = ("env.action", "env.action_parts", "env.decide")
"""What goes with another action, unless that chooses speeds, too."""


def recipe_words(name: str) -> tuple[str, ...]:
    """Return the words of a recipe.

    Raises:
        IzooError: there is no such recipe.
    """
    if name not in RECIPES:
        raise unknown_choice(RECIPE[:-1], name, RECIPES)
    return RECIPES[name][1]


def with_recipe(words: Sequence[str]) -> list[str]:
    """Return ``words`` with those of the recipe that they name before them, but for what they say themselves.

    Raises:
        IzooError: there is no such recipe.
    """
    named = [word for word in words if word.startswith(RECIPE)]
    others = [word for word in words if word not in named]
    if not named:
        return others
    words = recipe_words(named[-1].removeprefix(RECIPE).strip("'\""))
    said = {word.partition("=")[0] for word in others}
    replaced = [group for group in _CHOICES if group in said]
    if "action" in said and not {"action=speed", "action=arrive"} & set(others):
        replaced += _DECISIONS
    kept = [
        word
        for word in words
        if (name := word.partition("=")[0]) not in said and not any(f"{name}.".startswith(f"{g}.") for g in replaced)
    ]
    return [*kept, *others]
