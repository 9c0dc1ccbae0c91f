"""Fixed-column numbers straight from the bytes of a file (compiled).

A number's digits are gathered as one integer and divided by a power of ten once, so every value is the double nearest
to its decimal text.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from factorgraph.types import Array, IntArray

BLANK, NUMBER, GARBAGE = 0, 1, 2
Bytes = NDArray[np.uint8]


@njit(cache=True)
def fixed(raw: Bytes, begin: int, end: int) -> tuple[float, int]:
    """The decimal number in raw[begin:end] and what was found; blanks may surround it."""
    while begin < end and raw[begin] == 32:
        begin += 1
    while end > begin and raw[end - 1] == 32:
        end -= 1
    if begin == end:
        return np.nan, BLANK
    negative = raw[begin] == 45
    if negative or raw[begin] == 43:
        begin += 1
    digits, decimals, point, count = 0, 0, False, 0
    for k in range(begin, end):
        c = int(raw[k])
        if 48 <= c <= 57 and count < 18:
            digits = 10 * digits + (c - 48)
            count += 1
            decimals += point
        elif c == 46 and not point:
            point = True
        else:
            return np.nan, GARBAGE
    if count == 0:
        return np.nan, GARBAGE
    value = digits / 10.0**decimals
    return (-value if negative else value), NUMBER


@njit(cache=True)
def columns(raw: Bytes, starts: IntArray, ends: IntArray, bounds: IntArray) -> Array:
    """Numbers (n, k) of n lines at k column ranges (k, 2); NaN where blank, infinite where unreadable."""
    out = np.full((len(starts), len(bounds)), np.nan)
    for i in range(len(starts)):
        for j in range(len(bounds)):
            begin, end = starts[i] + bounds[j, 0], min(starts[i] + bounds[j, 1], ends[i])
            if begin < end:
                value, found = fixed(raw, begin, end)
                out[i, j] = np.inf if found == GARBAGE else value
    return out


@njit(cache=True)
def observations(
    raw: Bytes, starts: IntArray, ends: IntArray, line: IntArray, n_types: int, per_line: int, margin: int
) -> tuple[Array, NDArray[np.int8], NDArray[np.int8], int]:
    """Values (n, n_types), loss-of-lock and strength digits of records that begin at lines (n,), and unreadable fields.

    Fields are F14.3, I1, I1; `per_line` of them follow `margin` columns on each line. A number cut by the end of its line
    is unreadable.
    """
    n = len(line)
    values = np.full((n, n_types), np.nan)
    lli = np.zeros((n, n_types), np.int8)
    ssi = np.zeros((n, n_types), np.int8)
    unreadable = 0
    for i in range(n):
        for j in range(n_types):
            row = line[i] + j // per_line
            begin, stop = starts[row] + margin + 16 * (j % per_line), ends[row]
            if begin >= stop:
                continue
            value, found = fixed(raw, begin, min(begin + 14, stop))
            if found == GARBAGE or (found == NUMBER and begin + 14 > stop):
                unreadable += 1
            elif found == NUMBER:
                values[i, j] = value
                if begin + 14 < stop and 48 <= raw[begin + 14] <= 57:
                    lli[i, j] = raw[begin + 14] - 48
                if begin + 15 < stop and 48 <= raw[begin + 15] <= 57:
                    ssi[i, j] = raw[begin + 15] - 48
    return values, lli, ssi, unreadable
