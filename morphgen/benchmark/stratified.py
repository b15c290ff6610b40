"""Stratified draws: each part is used once before one is used twice."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Mapping
from typing import TypeAlias

from morphgen.benchmark.hold_out_pool import Draft

STRATA = ("arm", "ee", "body", "base")
"""Kinds of parts whose use is balanced, the most important first. Segments are repeated at will."""

Key: TypeAlias = tuple[int, ...]
Item: TypeAlias = tuple[str, object]


class Balance:
    """How often the parts and categories of the robots chosen so far occur."""

    def __init__(self) -> None:
        self._counts: Counter[Item] = Counter()

    def _items(self, draft: Draft) -> list[list[Item]]:
        """Return what is balanced, the most important first; each is an alternative in a group."""
        groups: list[list[Item]] = [[("category", draft.category)]]
        return groups + [
            [(kind, part) for part in draft.parts_by_kind.get(kind, ())] for kind in STRATA
        ]

    def key(self, draft: Draft) -> Key:
        """Return how often the items of a robot occur already; the smallest is the best robot."""
        return tuple(
            max((self._counts[item] for item in group), default=0) for group in self._items(draft)
        )

    def add(self, draft: Draft) -> None:
        """Count a chosen robot."""
        self._counts.update(item for group in self._items(draft) for item in group)


class TestBalance(Balance):
    """Balance the rules, then the parts that they hold for, then all parts."""

    def _items(self, draft: Draft) -> list[list[Item]]:
        rules: list[Item] = [("rule", number) for number in draft.rules]
        held: list[Item] = [("held out", part) for part in draft.matching]
        return [rules, held, *super()._items(draft)]


class TrainBalance(Balance):
    """Balance the parts; of equally good robots, prefer one with parts that test robots need."""

    def __init__(self, needed: frozenset[str]) -> None:
        super().__init__()
        self._needed = set(needed)

    def key(self, draft: Draft) -> Key:
        """Return the key of the balance, then how many needed parts the robot has, negated."""
        return (*super().key(draft), -len(self._needed & draft.parts))

    def add(self, draft: Draft) -> None:
        """Count a chosen robot; its parts are needed no more."""
        super().add(draft)
        self._needed -= draft.parts


def stratified(drafts: Mapping[int, Draft], n: int, balance: Balance) -> list[int]:
    """Return the numbers of up to n drafts, each the best one after those before it."""
    # Keys never become better while robots are chosen, so only the first of the heap is updated.
    heap = [(balance.key(draft), draft.order, number) for number, draft in drafts.items()]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap and len(chosen) < n:
        key, order, number = heapq.heappop(heap)
        current = balance.key(drafts[number])
        if current > key:
            heapq.heappush(heap, (current, order, number))
            continue
        chosen.append(number)
        balance.add(drafts[number])
    return chosen
