"""The ids ``izoo/EcoDriving-v0`` and ``izoo/EcoDrivingEgo-v0``; Gymnasium calls :func:`register_all` when it is imported.

The package's entry point in the group ``gymnasium.envs`` names it, and gives the ids their namespace ``izoo``.
"""

from __future__ import annotations

VIEWS = {"EcoDriving-v0": "Joint", "EcoDrivingEgo-v0": "Ego"}


def register_all() -> None:
    """Register both views; neither is imported before it is made."""
    from gymnasium.envs.registration import register

    for name, view in VIEWS.items():
        register(
            id=name,
            entry_point=f"izoo.envs.views.gymnasium:EcoDriving{view}",
            vector_entry_point=f"izoo.envs.views.gymnasium:{view.lower()}_vector",
        )
