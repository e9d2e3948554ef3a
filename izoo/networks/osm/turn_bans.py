"""Which movements turn restrictions forbid: every movement is followed through the junction, way by way."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from izoo.contexts.movements import STRAIGHT_WITHIN_DEG
from izoo.networks.osm.junctions import Core, StreetGraph
from izoo.networks.osm.legs import BEARING_AT_M, Street, Stub
from izoo.networks.osm.streets import Restriction

_WORDS = {"left_turn": -1, "straight_on": 0, "right_turn": 1}
_BANS = ("no_entry", "no_exit", *(f"no_{word}" for word in _WORDS))
_ORDERS = tuple(f"only_{word}" for word in _WORDS)
NO_TURN_ON_RED = "no_right_turn_on_red"


@dataclass(frozen=True)
class _Crossing:
    """From one way into the next at ``node``; ``before`` and ``after`` are the nodes next to it."""

    from_way: int
    to_way: int
    node: int
    before: int
    after: int


@dataclass(frozen=True)
class _Chain:
    """A way through the core between two of its nodes: the nodes that it passes, and the way to each of them."""

    nodes: tuple[int, ...]
    ways: tuple[int, ...]


class TurnBans:
    """The turn restrictions of one intersection.

    Args:
        graph: the streets.
        core: the intersection.
    """

    def __init__(self, graph: StreetGraph, core: Core) -> None:
        self.graph = graph
        self.rules = [rule for rule in graph.streets.restrictions if rule.kind in (*_BANS, *_ORDERS)]
        self.chains = {node: list(_chains(graph, core, node)) for node in core.nodes}

    def forbids(self, start: Street, end: Street) -> bool:
        """Whether a street can be reached from another, and not without breaking a restriction."""
        paths = [
            path
            for arriving in start.arriving
            for leaving in end.leaving
            for path in self._paths(arriving, leaving, (arriving.nodes[0],))
        ]
        return bool(paths) and not any(self._allowed(path) for path in paths)

    def _paths(self, arriving: Stub, leaving: Stub, passed: tuple[int, ...]) -> Iterator[list[_Crossing]]:
        """Ways from a stub to another, as the changes from way to way, without passing a node of the core twice."""
        yield from self._onward(arriving, leaving, [(arriving.pieces[0].way.id, arriving.nodes[1])], passed)

    def _onward(
        self, arriving: Stub, leaving: Stub, walked: list[tuple[int, int]], passed: tuple[int, ...]
    ) -> Iterator[list[_Crossing]]:
        """Continue a walk, ``[(way, node it came from)]``, from the last node of ``passed``."""
        here = passed[-1]
        if here == leaving.nodes[0]:
            steps = [*walked, (leaving.pieces[0].way.id, here)]
            nodes = [node for _, node in steps[1:]] + [leaving.nodes[1]]
            yield [
                _Crossing(one, two, nodes[k], steps[k][1], nodes[k + 1])
                for k, ((one, _), (two, _)) in enumerate(itertools.pairwise(steps))
            ]
        for chain in self.chains[here]:
            if chain.nodes[-1] not in passed:
                steps = [(way, node) for way, node in zip(chain.ways, (here, *chain.nodes[:-1]), strict=True)]
                yield from self._onward(arriving, leaving, [*walked, *steps], (*passed, chain.nodes[-1]))

    def _allowed(self, path: Sequence[_Crossing]) -> bool:
        for first, last in itertools.combinations_with_replacement(range(len(path)), 2):
            here = [rule for rule in self.rules if self._applies(rule, path[first : last + 1])]
            if any(rule.kind in _BANS and self._meant(rule, path, first, last) for rule in here):
                return False
            # Without a place between, an order is about the street that a movement ends on.
            placed = [rule for rule in here if rule.via_nodes or rule.via_ways or last == len(path) - 1]
            orders = [rule for rule in placed if rule.kind in _ORDERS]
            if orders and not any(self._meant(rule, path, first, last) for rule in orders):
                return False
        return True

    def _applies(self, rule: Restriction, part: Sequence[_Crossing]) -> bool:
        """Whether a movement comes from where a rule begins, and passes what it names in between."""
        if part[0].from_way != rule.from_way:
            return False
        between = [crossing.to_way for crossing in part[:-1]]
        if rule.via_ways:
            return _merged(between) == list(rule.via_ways)
        if rule.via_nodes:
            return part[-1].node in rule.via_nodes and all(way == rule.from_way for way in between)
        return True

    def _meant(self, rule: Restriction, path: Sequence[_Crossing], first: int, last: int) -> bool:
        """Whether the last change of way is the one that a rule names.

        A way that goes on behind the node lies on both of its sides; which one is meant, the rule's word tells.
        """
        crossing = path[last]
        if crossing.to_way != rule.to_way:
            return False
        word = rule.kind.partition("_")[2]
        through = any(crossing.node in self.graph.streets.ways[way].nodes[1:-1] for way in (rule.from_way, rule.to_way))
        return not through or word not in _WORDS or self._turn(path[first], crossing) == _WORDS[word]

    def _turn(self, one: _Crossing, two: _Crossing) -> int:
        """-1 for left, 0 for straight on, 1 for right."""
        place = self.graph.streets.position_m
        (x0, y0), (x1, y1), (x2, y2), (x3, y3) = (place[node] for node in (one.before, one.node, two.node, two.after))
        bend = math.degrees(math.atan2(x3 - x2, y3 - y2) - math.atan2(x1 - x0, y1 - y0))
        bend = (bend + 180.0) % 360.0 - 180.0
        return 0 if abs(bend) < STRAIGHT_WITHIN_DEG else 1 if bend > 0.0 else -1


def bans_turns_on_red(graph: StreetGraph, streets: Sequence[Street]) -> bool:
    """Whether some approach may not turn right on red."""
    ways = {stub.pieces[0].way.id for street in streets for stub in street.arriving}
    return any(rule.kind == NO_TURN_ON_RED and rule.from_way in ways for rule in graph.streets.restrictions)


def _chains(graph: StreetGraph, core: Core, start: int) -> Iterator[_Chain]:
    """The streets that lead from a node of the core to another one, open in that direction."""
    for first, way, direction in graph.links[start]:
        nodes, ways, length = [first], [way.id], graph.distance(start, first)
        is_open = way.oneway in (0, direction)
        before = start
        while is_open and nodes[-1] not in graph.junctions and nodes[-1] not in core.nodes:
            onward = [step for step in graph.links[nodes[-1]] if step[0] != before]
            if not onward or length > 2.0 * BEARING_AT_M:
                break
            before = nodes[-1]
            node, way, direction = onward[0]
            is_open = way.oneway in (0, direction)
            length += graph.distance(before, node)
            nodes.append(node)
            ways.append(way.id)
        if is_open and nodes[-1] in core.nodes:
            yield _Chain(tuple(nodes), tuple(ways))


def _merged(ways: Sequence[int]) -> list[int]:
    return [way for way, _ in itertools.groupby(ways)]
