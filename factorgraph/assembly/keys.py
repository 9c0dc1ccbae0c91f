"""Keys of variables: a letter, which says the kind and with it the dimension, and a number."""

from __future__ import annotations

DIMENSION = {"x": 6, "b": 6, "p": 3, "v": 3, "a": 1, "i": 1, "c": 1, "l": 3}  # of a variable, by the letter of its key
_NUMBER_BITS = 56  # as GTSAM's symbols have


def symbol(letter: str, number: int) -> int:
    """The key of variable `number` of a kind."""
    return ord(letter) << _NUMBER_BITS | number


def dimension(key: int) -> int:
    """Components of the variable of that key."""
    return DIMENSION[chr(key >> _NUMBER_BITS)]
