"""Contexts: what varies between episodes, and the sets and distributions that episodes are drawn from.

- :mod:`.spec`, :mod:`.context`: one intersection, one context (a context-MDP);
- :mod:`.source`: sets of contexts, and the order in which episodes visit them;
- :mod:`.features`: every context feature, declared once; :mod:`.distributions`: how features are drawn;
- :mod:`.procedural`: four-leg worlds from a few numbers;
- :mod:`.cities`: the ten built-in cities, their features, shapes, signal plans and weather; :mod:`.movements`: turns;
- :mod:`.catalogue`: 1,306,720 scenarios by id; :mod:`.splits`: what is held out.
"""
