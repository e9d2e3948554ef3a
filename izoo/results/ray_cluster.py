"""Ray clusters: how training and evaluation reach them."""

from __future__ import annotations

import logging
import os
import socket
import sys
import warnings
from typing import Any

from izoo.errors import IzooError

WORKER_RESOURCES = {"num_cpus": 1, "num_gpus": 0}
"""What a simulating process asks of the cluster: one core."""
CONNECT_S = 10.0


def collecting() -> dict[str, Any]:
    """Return what a process that collects batches for a learner asks of the cluster, on a core.

    It hands tensors over as they lie in memory: pickled, a batch would be copied four times more. What it hands over
    must not be written to; a ``RayCollector`` with ``sync=True`` stacks it, which copies it.
    """
    tensors = {"env_vars": {"RAY_ENABLE_ZERO_COPY_TORCH_TENSORS": "1"}}
    return {**WORKER_RESOURCES, "runtime_env": tensors}


def connect() -> Any:
    """Return the module ``ray``, connected: to the cluster that ``RAY_ADDRESS`` names, or else to one on this machine.

    Every machine of a cluster needs the same izoo, and the data that contexts are read from under the same path.

    Raises:
        IzooError: Ray is not installed, or the cluster cannot be reached.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if "RAY_ADDRESS" not in os.environ and "ray" not in sys.modules:  # which reads it when it is imported
        os.environ.setdefault("RAY_AUTH_MODE", "token")  # Ray listens on all interfaces, and runs what it is sent
    try:
        import ray
    except ImportError as error:
        raise IzooError("Ray is not installed: pip install 'izoo[ray]'.") from error
    warnings.filterwarnings("ignore", "The given NumPy array is not writable", UserWarning)  # see collecting()
    if not ray.is_initialized():
        _check_address(os.environ.get("RAY_ADDRESS", ""))
        try:
            ray.init(log_to_driver=False, logging_level=logging.WARNING, include_dashboard=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            address = os.environ.get("RAY_ADDRESS", "this machine")
            raise IzooError(f"no Ray cluster at {address}: {str(error).splitlines()[0]}") from error
    return ray


def _check_address(address: str) -> None:
    """Refuse ``host:port`` where nobody listens; Ray itself would try for minutes."""
    host, colon, port = address.rpartition(":")
    if not colon or not port.isdigit() or "/" in host:
        return
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except OSError as error:
        raise IzooError(f"no Ray cluster at {address} (RAY_ADDRESS): {error.strerror or error}.") from error
