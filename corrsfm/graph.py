"""Which photos pairs connect, and which pairs share photos."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence

from corrsfm.errors import first_few
from corrsfm.types import Pair

__all__ = [
    "MAX_NAMED_GROUPS",
    "connected_components",
    "describe_components",
    "neighbours_together",
    "second_strongest",
]


MAX_NAMED_GROUPS = 5

_TILE = 16


def connected_components(names: Sequence[str], pairs: Iterable[Pair]) -> list[list[str]]:
    """Groups of photos connected by pairs, the largest first, each sorted; single photos included."""
    parent = {name: name for name in names}

    def root(name: str) -> str:
        while parent[name] != name:
            parent[name] = parent[parent[name]]
            name = parent[name]
        return name

    for name0, name1 in pairs:
        parent[root(name0)] = root(name1)
    groups = defaultdict(list)
    for name in sorted(names):
        groups[root(name)].append(name)
    return sorted(groups.values(), key=lambda group: (-len(group), group))


def describe_components(names: Sequence[str], pairs: Iterable[Pair]) -> str:
    """Describe the groups if the pairs do not connect all photos; empty if they do."""
    components = connected_components(names, pairs)
    if len(components) < 2:
        return ""
    sizes = first_few(str(len(group)) for group in components)
    lines = [
        f"the pairs do not connect all photos: groups of {sizes} photos, which cannot become one model;"
        " a wider --pairing, or several combined, may connect them"
    ]
    for group in components[1 : 1 + MAX_NAMED_GROUPS]:
        lines.append(f"not connected to the largest group: {first_few(group)}")
    return "\n".join(lines)


def second_strongest(strengths: Mapping[Pair, int]) -> dict[str, int]:
    """Strength of the second-strongest pair of each photo; 0 for photos of one pair."""
    own = defaultdict(list)
    for pair, strength in strengths.items():
        for name in pair:
            own[name].append(strength)
    return {name: sorted(values)[-2] if len(values) > 1 else 0 for name, values in own.items()}


def neighbours_together(pairs: Iterable[Pair]) -> list[Pair]:
    """Order pairs so that those that follow each other share photos, whatever the photos are called.

    Photos are numbered by breadth-first search, from neighbour to neighbour. The pairs are taken from the
    matrix of these numbers in tiles, which hold many pairs of few photos.
    """
    pairs = list(pairs)
    neighbours = defaultdict(list)
    for name0, name1 in pairs:
        neighbours[name0].append(name1)
        neighbours[name1].append(name0)
    number: dict[str, int] = {}
    for start in sorted(neighbours):
        waiting = deque([start] if start not in number else [])
        number.setdefault(start, len(number))
        while waiting:
            for name in sorted(neighbours[waiting.popleft()]):
                if name not in number:
                    number[name] = len(number)
                    waiting.append(name)

    def place(pair: Pair) -> tuple[int, ...]:
        low, high = sorted((number[pair[0]], number[pair[1]]))
        return low // _TILE, high // _TILE, low, high

    return sorted(pairs, key=place)
