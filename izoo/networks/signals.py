"""Fixed-time signal plans by exhaustive search over HCM delay (spec 4)."""

from __future__ import annotations

from izoo.contexts.spec import IntersectionSpec, SignalPlan


def search_plan(spec: IntersectionSpec) -> SignalPlan:
    raise NotImplementedError
