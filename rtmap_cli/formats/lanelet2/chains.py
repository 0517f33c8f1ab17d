"""Ways joined end to end, so that they can be taken apart again."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Chain:
    """Ways in a row: (id, number of nodes, whether it runs backwards) each; all nodes, the joints
    once."""

    ways: tuple[tuple[int, int, bool], ...]
    nodes: tuple[int, ...]

    @classmethod
    def of(cls, way: int, nodes: tuple[int, ...]) -> Chain:
        """A way alone."""
        return cls(((way, len(nodes), False),), nodes)

    @property
    def first(self) -> int:
        """The least id: that of the element."""
        return min(k for k, _, _ in self.ways)

    def backwards(self) -> Chain:
        """The same chain from its other end."""
        return Chain(tuple((k, n, not r) for k, n, r in self.ways[::-1]), self.nodes[::-1])

    def then(self, other: Chain) -> Chain:
        """This chain and the one that begins where it ends."""
        return Chain(self.ways + other.ways, self.nodes + other.nodes[1:])

    def as_json(self) -> str:
        """For an attribute; ``apart`` takes it."""
        return json.dumps([[k, n, r] for k, n, r in self.ways])


def apart(ways: Sequence[Sequence[int]], nodes: Sequence[int]) -> list[tuple[int, list[int], bool]]:
    """Id and nodes of each way in the order of the chain, and whether it runs backwards in it;
    ValueError where ``ways`` and ``nodes`` do not belong together."""
    out: list[tuple[int, list[int], bool]] = []
    start = 0
    for number, count, backwards in ways:
        part = list(nodes[start : start + count])
        if len(part) != count or count < 2:
            raise ValueError(f"way {number} has {count} nodes, {len(part)} are there")
        out.append((int(number), part, bool(backwards)))
        start += count - 1
    if start != len(nodes) - 1:
        raise ValueError(f"{len(nodes)} nodes for ways of {start + 1}")
    return out


def joined(chains: Sequence[Chain], kinds: Mapping[int, Hashable]) -> list[Chain]:
    """Chains of one kind joined where exactly two ends share a node; ways without a kind stay.

    A chain runs as its way of the least id does. The result does not depend on the order.
    """
    ends: dict[tuple[Hashable, int], list[int]] = defaultdict(list)
    by_way = {c.first: c for c in chains}
    for k, kind in sorted(kinds.items()):
        for node in {by_way[k].nodes[0], by_way[k].nodes[-1]}:
            ends[kind, node].append(k)
    used: set[int] = set()
    out = []
    for k in sorted(by_way):
        if k in used:
            continue
        chain = by_way[k]
        used.add(k)
        if k in kinds:
            for _ in range(2):
                chain = _extended(chain, by_way, kinds[k], ends, used).backwards()
        out.append(chain)
    return out


def _extended(
    chain: Chain,
    by_way: Mapping[int, Chain],
    kind: Hashable,
    ends: Mapping[tuple[Hashable, int], list[int]],
    used: set[int],
) -> Chain:
    """The chain with all that follows its last node."""
    while True:
        here = ends[kind, chain.nodes[-1]]
        following = [k for k in here if k not in used]
        if len(here) != 2 or len(following) != 1 or chain.nodes[0] == chain.nodes[-1]:
            return chain
        step = by_way[following[0]]
        used.add(following[0])
        chain = chain.then(step if step.nodes[0] == chain.nodes[-1] else step.backwards())
