"""The page of a real, small evaluation: whole, self-contained, and honest about what it lacks."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from izoo.evaluation import evaluate_policy
from izoo.report import main
from izoo.reporting.figures import cut_height, histogram
from tests.evaluation.conftest import SHORT, contexts

__all__ = ["contexts"]


class Balance(HTMLParser):
    """Raises where tags do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag not in {"meta"}:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: object) -> None:
        """Nothing stays open."""

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_page_of_an_evaluation(contexts, tmp_path: Path) -> None:
    folder = tmp_path / "a <folder> & more"
    evaluate_policy("glide", contexts, [1, 2], SHORT, 0, folder, False, cache=tmp_path / "cache")
    assert main([str(folder)]) == 0
    text = (folder / "report.html").read_text()
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    assert "<h1>a &lt;folder&gt; &amp; more</h1>" in text
    assert not re.search(r"""(src|href)=["'](?!#)""", text)
    assert text.count("<svg") == 4
    assert text.count("glide against human") == 1
    assert "-1.85 %" in text
    first = (folder / "report.html").read_bytes()
    assert main([str(folder)]) == 0
    assert (folder / "report.html").read_bytes() == first


def test_a_folder_without_an_evaluation_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "has no evaluation.csv" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_tall_bars_are_cut_and_their_count_printed() -> None:
    assert cut_height(np.array([5, 40, 6])) == 12
    assert cut_height(np.array([5, 8, 6])) == 8
    text = histogram(np.concatenate([np.zeros(40), np.full(6, 0.2), [7.0]]), "a -> b")
    assert ">40<" in text
    assert "(n = 47)" in text
