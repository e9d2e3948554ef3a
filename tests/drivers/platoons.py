"""Drivers who follow leaders by a plain IDM, written apart from the product's, as tables."""

import numpy as np
import pandas as pd

MEDIANS = {"v0": 14.0, "s0": 2.0, "T": 1.1, "alpha": 1.2, "beta": 1.6}
SPREAD = 0.15
STEP_S = 0.5


def idm_step(v: float, gap: float, leader: float, driver: np.ndarray, step_s: float = STEP_S) -> float:
    """Speed after a step that is taken in parts of a quarter of a second; the gap does not open meanwhile."""
    v0, s0, headway, alpha, beta = driver
    parts = max(1, int(step_s / 0.25 + 0.5))
    for _ in range(parts):
        wanted = s0 + max(0.0, v * headway + v * (v - leader) / (2 * np.sqrt(alpha * beta)))
        v = max(0.0, v + step_s / parts * alpha * (1 - (v / v0) ** 4 - (wanted / gap) ** 2))
        gap -= max(0.0, (v - leader) * step_s / parts)
    return v


def platoon_table(
    drivers: int, steps: int, seed: int = 0, noise_mps2: float = 0.1, length_m: float = 5.0
) -> pd.DataFrame:
    """Leader-follower pairs of drawn drivers behind leaders whose speed wanders and who stop now and then."""
    generator = np.random.default_rng(seed)
    rows = []
    for number in range(drivers):
        driver = np.exp(np.log(list(MEDIANS.values())) + SPREAD * generator.standard_normal(5))
        target = np.repeat(generator.uniform(0.0, 15.0, steps // 20 + 2), 20)
        leader, v, gap = 8.0, 8.0, 15.0
        for k in range(steps):
            rows.append((f"car{number}", length_m, STEP_S * k, gap, v, leader))
            after = idm_step(v, gap, leader, driver) + noise_mps2 * STEP_S * generator.standard_normal()
            v = max(0.0, after)
            leader += float(np.clip(target[k] - leader, -1.0, 0.6))
            gap = max(gap + STEP_S * (leader - v), 0.5)
    names = ["driver", "length_m", "time_s", "gap_m", "speed_mps", "leader_speed_mps"]
    return pd.DataFrame(rows, columns=names)
