"""Draws the features of a whole city: published marginals, joined by a Gaussian copula.

Normals give each feature's *ranks*; the values come from the published distribution at evenly spaced, jittered
quantiles. So the marginals of a built city match the published ones up to one quantile step whatever the sample, and a
last-digit difference between platforms in the normals cannot move a value.
"""

from __future__ import annotations

import functools
import importlib.resources
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

FEATURES = (
    *("lane_count", "grade", "lane_length_m", "speed_limit_mps"),
    *("inflow_peak_vph", "signal_time_ratio", "phase_count"),
)
"""Order of the features in the joint structure; ``inflow_peak_vph`` is per main lane."""
RATIO, PHASES = FEATURES.index("signal_time_ratio"), FEATURES.index("phase_count")
MAX_LENGTH_M = 700.0
MPH = 0.44704
SIGNAL_OPPOSITE = {RATIO: 0.995, PHASES: 0.95}
SIGNAL_ADJACENT = {RATIO: -0.985, PHASES: 0.30}
"""Latent correlations of the signal features between approaches. They replace the published joint figures (0.47 and
-0.58 for the green share), which mix in T-junctions: in measured four-leg plans nine of ten opposite approaches have
the same green, and adjacent ones share out the cycle; weaker values would ask for plans that cannot exist."""


@dataclass(frozen=True)
class Marginal:
    """One published distribution: ``edges`` of bins (length one more than ``prob``), or separate ``values``."""

    prob: np.ndarray
    edges: np.ndarray | None = None
    values: np.ndarray | None = None

    def at(self, quantile: np.ndarray) -> np.ndarray:
        """Return the values at ``quantile`` in [0, 1): linear within a bin."""
        cumulative = np.concatenate([[0.0], np.cumsum(self.prob)])
        cumulative /= cumulative[-1]
        index = np.clip(np.searchsorted(cumulative, quantile, side="right") - 1, 0, len(self.prob) - 1)
        if self.edges is None:
            assert self.values is not None
            return self.values[index]
        part = (quantile - cumulative[index]) / (cumulative[index + 1] - cumulative[index])
        return self.edges[index] + part * (self.edges[index + 1] - self.edges[index])

    def histogram(self, sample: np.ndarray) -> np.ndarray:
        """Return the share of ``sample`` in each bin or value; what lies outside counts in the nearest bin."""
        if self.edges is None:
            assert self.values is not None
            index = np.abs(sample[:, None] - self.values[None, :]).argmin(axis=1)
        else:
            slack = 1e-9 + 1e-4 * (self.edges[1] - self.edges[0])
            index = np.searchsorted(self.edges, sample + slack, side="right") - 1
        return np.bincount(np.clip(index, 0, len(self.prob) - 1), minlength=len(self.prob)) / len(sample)


@functools.cache
def _package_json(name: str) -> dict[str, Any]:
    return json.loads(importlib.resources.files("izoo.contexts.cities").joinpath(name).read_text("utf-8"))


@functools.cache
def marginal(city: str, feature: str) -> Marginal:
    """Return a published distribution, as published."""
    data = _package_json("city_marginals.json")["cities"][city][feature]
    prob = np.asarray(data["prob"])
    if "values" in data:
        return Marginal(prob, values=np.asarray(data["values"], dtype=float))
    return Marginal(prob, edges=np.asarray(data["edges"]))


@functools.cache
def source_marginal(city: str, feature: str) -> Marginal:
    """Return the distribution that values are drawn from: as published, with what its notes say about single bins.

    Speed limits are multiples of 5 mph: a bin stands for the one that it holds (for the next one where it holds none).
    Lengths end at 700 m.
    """
    published = marginal(city, feature)
    if published.edges is None:
        return published
    if feature == "speed_limit_mps":
        first = np.ceil((published.edges[:-1] - 1e-3) / (5.0 * MPH))
        return Marginal(published.prob, values=np.round(5.0 * MPH * first, 4))
    if feature == "lane_length_m":
        return Marginal(published.prob, edges=np.minimum(published.edges, MAX_LENGTH_M))
    return published


def _latent(spearman: Sequence[float] | np.ndarray) -> np.ndarray:
    """Pearson correlation of the normals that gives a rank correlation."""
    return 2.0 * np.sin(np.pi / 6.0 * np.asarray(spearman))


@functools.cache
def latent_root(relations: tuple[tuple[str, ...], ...]) -> np.ndarray:
    """Return the symmetric square root of the latent correlation of the approaches of one kind of intersection.

    Args:
        relations: ``[n][n]`` of ``same``, ``opposite`` or ``adjacent``, for the incoming approaches.

    Between approaches, a feature has its published correlation with itself, and with the others the product of that
    and theirs (geometric means of the two features' signs and sizes); the nearest valid correlation matrix is used.
    """
    joint = _package_json("slc_joint.json")
    within = _latent(joint["spearman_within_approach"])
    between = {}
    for relation, signal in (("opposite", SIGNAL_OPPOSITE), ("adjacent", SIGNAL_ADJACENT)):
        own = _latent(list(joint[f"spearman_{relation}_approach"].values()))
        for index, value in signal.items():
            own[index] = value
        alike = np.sign(own)[:, None] == np.sign(own)[None, :]
        block = np.where(alike, within * np.sqrt(np.abs(own[:, None] * own[None, :])) * np.sign(own)[:, None], 0.0)
        np.fill_diagonal(block, own)
        between[relation] = block
    full = np.block([[within if relation == "same" else between[relation] for relation in row] for row in relations])
    eigenvalues, vectors = np.linalg.eigh((full + full.T) / 2.0)
    clipped = (vectors * np.maximum(eigenvalues, 1e-9)) @ vectors.T
    scale = np.sqrt(np.diag(clipped))
    eigenvalues, vectors = np.linalg.eigh(clipped / np.outer(scale, scale))
    return (vectors * np.sqrt(np.maximum(eigenvalues, 0.0))) @ vectors.T


def quantiles(latent: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Return one quantile in (0, 1) per entry of ``latent`` [N]: its rank, jittered within one step."""
    ranks = np.empty(len(latent))
    ranks[np.argsort(latent, kind="stable")] = np.arange(len(latent))
    return (ranks + generator.random(len(latent))) / len(latent)
