"""The vehicles of an episode: arrivals, routes, vehicle classes and drivers.

- :mod:`izoo.traffic.demand`: Poisson arrivals, turning shares.
- :mod:`izoo.traffic.fleet`: vehicle types, ages and fuels.
- :mod:`izoo.traffic.drivers`: the population of human drivers.
- :mod:`izoo.traffic.sampling`: :class:`Traffic`, the vehicles of one episode, and its SUMO route file.
"""

from izoo.traffic.sampling import Traffic, sample_traffic, write_routes

__all__ = ["Traffic", "sample_traffic", "write_routes"]
