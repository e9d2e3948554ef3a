"""The graph policy compiled for one step: what the torch modules of :mod:`izoo.algos.gcrl` compute, with less overhead.

Only agents are computed, and each attends to its neighbours alone; empty slots and distant pairs cost nothing.
"""

from __future__ import annotations

import math

import numpy as np

from izoo.algos.acting import activate, linear, sample
from izoo.compiling import compiled


@compiled(error_model="numpy")
def neighbours_of(position, frame, most, count, range_m):  # type: ignore[no-untyped-def]
    """Return ``(first [n + 1], who)``: agent ``i`` attends to ``who[first[i]:first[i + 1]]``, itself among them.

    Args:
        position: ``[n]`` along the road, m.
        frame: ``[n]`` which frame an agent belongs to; those of one stand together.
        most: the most agents that a frame can hold.
        count: the nearest so many are neighbours, and whoever is as near as the last of them.
        range_m: neighbours are at most so far away, m.
    """
    n = position.shape[0]
    first, who = np.zeros(n + 1, np.int64), np.empty(n * most, np.int64)
    distance = np.empty(most, np.float32)
    begin = end = held = 0
    for i in range(n):
        if i == end:
            begin = i
            while end < n and frame[end] == frame[i]:
                end += 1
        others = 0
        for j in range(begin, end):
            apart = abs(position[i] - position[j])
            if j != i and apart <= range_m:
                distance[others] = apart
                others += 1
        limit = range_m
        if count < others:
            limit = np.sort(distance[:others])[count - 1] if count > 0 else np.float32(-1.0)
        for j in range(begin, end):
            if j == i or abs(position[i] - position[j]) <= limit:
                who[held] = j
                held += 1
        first[i + 1] = held
    return first, who


@compiled(error_model="numpy", fastmath={"reassoc", "contract"})
def attend(parts, first, who, heads):  # type: ignore[no-untyped-def]
    """Return ``[n, width]``: multi-head attention over the neighbours.

    Args:
        parts: ``[n, 3 * width]`` queries, keys and values, each divided among the heads.
        first, who: from :func:`neighbours_of`.
        heads: how many.
    """
    n, width = parts.shape[0], parts.shape[1] // 3
    size = width // heads
    scale = np.float32(1.0 / math.sqrt(size))
    mixed = np.zeros((n, width), np.float32)
    longest = 0
    for i in range(n):
        longest = max(longest, first[i + 1] - first[i])
    weight = np.empty(longest, np.float32)
    for i in range(n):
        members = who[first[i] : first[i + 1]]
        for head in range(heads):
            query = parts[i, head * size : (head + 1) * size]
            largest = np.float32(-np.inf)
            for m in range(members.shape[0]):
                key = parts[members[m], width + head * size : width + (head + 1) * size]
                score = np.float32(0.0)
                for k in range(size):
                    score += query[k] * key[k]
                weight[m] = score * scale
                largest = max(largest, weight[m])
            total = np.float32(0.0)
            for m in range(members.shape[0]):
                weight[m] = np.exp(weight[m] - largest)
                total += weight[m]
            line = mixed[i, head * size : (head + 1) * size]
            for m in range(members.shape[0]):
                share = weight[m] / total
                value = parts[members[m], 2 * width + head * size : 2 * width + (head + 1) * size]
                for k in range(size):
                    line[k] += share * value[k]
    return mixed


@compiled(error_model="numpy")
def act(  # type: ignore[no-untyped-def]
    observation, mask, weights, biases, network, activation, graph, spread, bounds, noise, out
):
    """Act for every agent of every frame; what empty slots hold does not matter.

    Args:
        observation: ``[M * A, F]``.
        mask: ``[M, A]`` uint8: the slot holds an agent.
        weights, biases: tuples of the linear layers' ``[O, I]`` and ``[O]``: the encoder's, then each convolution's
            two, then the head, which has two outputs.
        network: ``(layers of the encoder, convolutions, heads)``.
        activation: place in :data:`izoo.algos.base.ACTIVATIONS`.
        graph: ``(column of the observation that holds the position, its scale in m, neighbours, range in m)``.
        spread, bounds, noise, out: see :func:`izoo.algos.acting.sample`, with ``n = M * A``.
    """
    encoder, convolutions, heads = network
    column, scale_m, count, range_m = graph
    rows = np.flatnonzero(mask)
    x = observation[rows]
    most = mask.shape[1]
    position = x[:, column] * np.float32(scale_m)
    first, who = neighbours_of(position, rows // most, most, count, np.float32(range_m))
    for layer in range(encoder):
        x = linear(x, weights[layer], biases[layer])
        activate(x.reshape(-1), activation)
    width = x.shape[1]
    encodings = np.empty((rows.shape[0], (convolutions + 1) * width), np.float32)
    encodings[:, :width] = x
    for c in range(convolutions):
        layer = encoder + 2 * c
        mixed = attend(linear(x, weights[layer], biases[layer]), first, who, heads)
        x = linear(mixed, weights[layer + 1], biases[layer + 1])
        activate(x.reshape(-1), activation)
        encodings[:, (c + 1) * width : (c + 2) * width] = x
    sample(linear(encodings, weights[-1], biases[-1]), rows, spread, bounds, noise, out)
