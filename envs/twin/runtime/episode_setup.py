"""One environment's episode on the twin: the driving and the MDP's tables, side by side."""

from __future__ import annotations

import logging
import zlib
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from izoo.emissions.kernel import KernelWeights
from izoo.envs.backend import Play, entry_edges, episode_traffic
from izoo.envs.config import EnvConfig
from izoo.envs.mdp.episode import DemandAtHorizon, Episode, Reading
from izoo.envs.mdp.frame import frame_fields
from izoo.envs.twin.net.reader import TwinWorld, read_twin_world, twin_traffic
from izoo.envs.twin.runtime.batch_step import warm_up_all
from izoo.envs.twin.runtime.layout import ARRIVED, DRIVING, DROPPED, MAX_TAIL_LANES, WAITING, WORKING
from izoo.envs.twin.runtime.prefetch import ADDRESSES, NET_AT, STATE_AT, no_ranges
from izoo.envs.twin.runtime.scratch import Desk
from izoo.envs.twin.runtime.simulation import TwinEpisode
from izoo.errors import IzooError
from izoo.networks.clock import to_ms
from izoo.networks.net.build import build_net
from izoo.networks.road import RoadNet, read_road
from izoo.traffic.sampling import Traffic

_log = logging.getLogger("izoo")


class Prepared(NamedTuple):
    """An episode at the end of its warm-up; nothing of it is bound to an environment yet."""

    play: Play
    road: RoadNet
    traffic: Traffic
    names: TwinWorld
    driving: TwinEpisode


def prepare(config: EnvConfig, play: Play, desk: Desk) -> Prepared:
    """Read the net, draw the traffic, and drive up to the beginning of control.

    Args:
        config: the environment's settings.
        play: what is played.
        desk: working memory of this thread.

    Raises:
        IzooError: the context cannot be simulated.
    """
    context = play.context
    path = build_net(context.intersection)
    road = read_road(path)
    try:
        names = read_twin_world(road, path)
    except IzooError as error:
        raise IzooError(f"context {context.name}: {error}") from error
    traffic = episode_traffic(config, context, road, play.seed)
    driving = TwinEpisode(names.net, twin_traffic(traffic, road, names.net), to_ms(config.step_s), desk)
    addresses = np.zeros((1, ADDRESSES), np.int64)
    addresses[0, NET_AT : STATE_AT + 1] = driving.addresses
    warm_up_all(addresses, config.warmup_steps, driving.step_ms, no_ranges())
    return Prepared(play, road, traffic, names, driving)


class TwinRun:
    """An episode that is being played in one environment.

    Args:
        config: the environment's settings.
        frame: the arrays of its frame (:func:`izoo.envs.mdp.frame.map_frames`, one row).
        weights: the emission surrogates.
        prepared: what is played.
        desk: working memory of the thread that will step it.

    Attributes:
        episode: the MDP's side.
        driving: the twin's side.
        addresses: ``[4]`` what :mod:`izoo.envs.twin.runtime.batch_step` reaches both by.
    """

    def __init__(
        self, config: EnvConfig, frame: dict[str, np.ndarray], weights: KernelWeights, prepared: Prepared, desk: Desk
    ) -> None:
        play, road, traffic, names, driving = prepared
        driving.move_to(desk)
        self.config, self.play, self.driving = config, play, driving
        edges = entry_edges(road, play.context.demand_approaches, config.step_s)
        self.episode = Episode(config, frame, weights, *play, road, traffic, _lanes_of(edges, names))
        self.addresses = (self.episode.world_at, *driving.addresses)
        self._enter_all(names, road)

    def _enter_all(self, names: TwinWorld, road: RoadNet) -> None:
        """Enter every vehicle that is in the region when the warm-up ends, and write the first frame."""
        state = self.driving.state
        for lane in _lanes_of(dict.fromkeys(name.rsplit("_", 1)[0] for name in road.lane_ids), names).tolist():
            v = int(state.lanes["back"][lane])
            while v >= 0:
                self.episode.admit(v, float(state.vehicles["accel"][v]), counted=False)
                v = int(state.vehicles["ahead"][v])
        early = (self.episode.tables.demand["row"] >= 0) | (state.vehicles["status"] == ARRIVED)
        self.episode.begin(self._reading(), float(state.clock["now_ms"]) / 1000.0, np.flatnonzero(early).tolist())

    def _reading(self) -> Reading:
        """Return where the members are."""
        vehicles = self.driving.state.vehicles[self.episode.tables.vehicles["vehicle_number"][self.episode.members]]
        region = self.driving.net.lanes["region"][vehicles["lane"]].astype(np.int64)
        return region, vehicles["position"].copy(), vehicles["speed"].copy(), vehicles["signals"].astype(np.int64)

    def end_step(self) -> None:
        """Complete the sums at the horizon and at the end; say so where vehicles were not driven as in SUMO."""
        self.episode.end_step(self._ending, self._everybody_left)
        state = self.driving.state
        if self.episode.over and state.clock["lost_tails"]:
            _log.warning(
                "context %s: the rear of a vehicle lay on more than %d lanes, or with more than as many others on one, "
                "%d times; there the twin forgot it. Use simulator=sumo.",
                self.play.context.name,
                MAX_TAIL_LANES,
                state.clock["lost_tails"],
            )

    def _everybody_left(self) -> bool:
        """Whether no vehicle is on the road, waits to enter it, or is yet to depart."""
        state = self.driving.state
        status = state.vehicles["status"]
        departed = state.clock["next_departure"] == len(status)
        return bool(departed and not (state.clock["on_road"] or (status == WAITING).any()))

    def _ending(self) -> DemandAtHorizon:
        """Say what became of the demand that did not reach the region."""
        state = self.driving.state
        status = state.vehicles["status"]
        demand = self.episode.tables.demand
        outside = (status == DRIVING) & (demand["row"] < 0)
        masks = (status == DROPPED, status == WAITING, outside, demand["early"])
        gone = (np.flatnonzero(mask).tolist() for mask in masks)
        return DemandAtHorizon(range(int(state.clock["next_departure"])), *gone)

    def _changing(self) -> list[np.ndarray]:
        """Return every array that changes in the course of the episode."""
        return [
            *(array for name, array in self.driving.state._asdict().items() if name not in WORKING),
            *self.episode.tables,
            *(self.episode.frame[field.name] for field in frame_fields(self.config)),
        ]

    def pack(self) -> np.ndarray:
        """Return the state of the episode as compressed bytes, uint8."""
        whole = b"".join(array.tobytes() for array in self._changing())
        return np.frombuffer(zlib.compress(whole, 1), np.uint8)

    def unzip(self, packed: np.ndarray) -> bytes:
        """Return the bytes of a state that :meth:`pack` returned.

        Raises:
            IzooError: they are not as many as this episode has.
        """
        size = sum(array.nbytes for array in self._changing())
        try:
            whole = zlib.decompressobj().decompress(packed.tobytes(), size + 1)
        except zlib.error:
            whole = b""
        if len(whole) != size:
            raise IzooError(
                f"the saved state does not fit episode {self.play.number} of the schedule: another version of izoo "
                "saved it, or it is damaged. Begin anew with reset()."
            )
        return whole

    def unpack(self, packed: np.ndarray) -> None:
        """Go on from a state of the same episode."""
        whole, at = self.unzip(packed), 0
        for array in self._changing():
            array[...] = np.frombuffer(whole, array.dtype, array.size, at).reshape(array.shape)
            at += array.nbytes
        self.episode.resume()


def _lanes_of(edges: Iterable[str], names: TwinWorld) -> np.ndarray:
    """Return the rows of the lanes of edges, int32: edge after edge, rightmost lane first."""
    table = names.net.edges
    lanes = dict(
        zip(names.edge_ids, zip(table["first_lane"].tolist(), table["lanes"].tolist(), strict=True), strict=True)
    )
    found = (lanes[edge] for edge in edges)
    return np.array([lane for first, count in found for lane in range(first, first + count)], np.int32)
