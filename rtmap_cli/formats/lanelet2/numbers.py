"""Ids for what had none in Lanelet2: the same element gets the same ids in every export."""

from __future__ import annotations

import hashlib

FIRST, COUNT = 2**40, 2**52
"""Above what editors count up to, below 2⁵³: every reader of JSON and XML takes them."""


class Numbers:
    """Hands out ids of one kind that are not taken."""

    def __init__(self, taken: set[int]) -> None:
        self.taken = set(taken)

    def of(self, name: str) -> int:
        """The id of a name: from its SHA-256, or the next free one behind it."""
        digest = hashlib.sha256(name.encode()).digest()
        number = FIRST + int.from_bytes(digest[:8], "big") % COUNT
        while number in self.taken:
            number += 1
        self.taken.add(number)
        return number
