"""Whether there is a GPU to compute on."""

from __future__ import annotations

import torch

from izoo.errors import IzooError


def check_gpu(option: str, otherwise: str) -> None:
    """Raise :class:`IzooError` where PyTorch finds no GPU.

    Args:
        option: the option whose value is ``cuda``.
        otherwise: what it may be without a GPU.
    """
    if not torch.cuda.is_available():
        raise IzooError(
            f"{option}=cuda, but PyTorch finds no GPU here (torch.cuda.is_available() is False); install a build of "
            f"PyTorch with CUDA and the GPU's driver, or choose {option}={otherwise}."
        )
