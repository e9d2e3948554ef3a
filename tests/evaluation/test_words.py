"""The sentence that ends a training run says what the table says, and no more."""

from __future__ import annotations

from typing import Any

from izoo.evaluation.words import in_words


def estimate(value: float | None, low: float | None = None, high: float | None = None) -> dict[str, Any]:
    return {"value": value, "low": low, "high": high}


def summary(human: Any, uncommanded: Any, throughput: float = 0.01, count: int = 16) -> dict[str, Any]:
    def compared(saving: Any) -> dict[str, Any]:
        return {"all": {"ungated": {"mean": saving}, "throughput": {"mean": estimate(throughput)}}}

    against = {"human": compared(human), "uncommanded": compared(uncommanded)}
    return {"policies": {"policy": {"intersections": count, "against": against}, "uncommanded": {}}}


def test_savings_with_their_intervals() -> None:
    found = in_words(summary(estimate(0.0834, 0.062, 0.104), estimate(0.014, 0.007, 0.022)), unseen=True)
    assert found == (
        "On 16 unseen intersections vehicles emit 8.3 % [6.2, 10.4] less CO2 than human driving and 1.4 % [0.7, 2.2] "
        "less CO2 than the same vehicles uncommanded. So the policy is better than human driving and than the same "
        "vehicles uncommanded; that is not chance (95 %)."
    )


def test_losses_are_called_more_and_their_intervals_are_turned_round() -> None:
    found = in_words(summary(estimate(0.05, 0.01, 0.09), estimate(-0.02, -0.03, -0.01)))
    assert "5.0 % [1.0, 9.0] less CO2 than human driving and 2.0 % [1.0, 3.0] more CO2 than the same" in found
    assert found.endswith(
        "So the policy is better than human driving, and worse than the same vehicles uncommanded; that is not chance "
        "(95 %)."
    )


def test_what_may_be_chance_is_no_difference() -> None:
    found = in_words(summary(estimate(0.05, 0.01, 0.09), estimate(0.01, -0.01, 0.03)))
    assert found.endswith(
        "So the policy is better than human driving; that is not chance (95 %). Compared with the same vehicles "
        "uncommanded no difference is shown."
    )


def test_a_saving_bought_with_throughput_is_named() -> None:
    found = in_words(summary(estimate(0.05, 0.01, 0.09), estimate(0.01, -0.01, 0.03), throughput=-0.024))
    assert "But fewer of them cross: 2.4 % fewer than under human driving and 2.4 % fewer than" in found


def test_few_intersections_say_nothing_about_others() -> None:
    found = in_words(summary(estimate(0.05), estimate(0.01), count=1))
    assert found.startswith("On 1 intersection vehicles emit 5.0 % less CO2 than human driving")
    assert found.endswith("So few intersections say nothing about others.")


def test_a_difference_that_no_intersection_changes_is_none_that_is_shown() -> None:
    found = in_words(summary(estimate(0.05, 0.01, 0.09), estimate(0.0)))
    assert found.endswith("(95 %). Compared with the same vehicles uncommanded no difference is shown.")


def test_nothing_crossed() -> None:
    assert "no vehicle crossed" in in_words(summary(estimate(None), estimate(None)))
