"""Parsing and printing rows of numbers at memory speed."""

from __future__ import annotations

import numpy as np
from numba import njit

_NEWLINE, _RETURN, _MINUS, _PLUS, _DOT, _ZERO, _NINE = 10, 13, 45, 43, 46, 48, 57
_COMMA, _SEMICOLON, _SPACE, _TAB = 44, 59, 32, 9
FAULTS, FIRST_FAULT, SCALED = range(3)  # slots of the state


@njit(cache=True)
def parse_rows(data, columns, seconds_column, values, starts, state):
    """Parse whole lines of `columns` numbers each; return rows and bytes used.

    Numbers are whole, except in `seconds_column` (-1: none), where decimals are seconds and become
    microseconds, rounded. A line that is no such row is counted, the first one's place is kept, and it is left
    out. `starts` receives the place of each row.
    """
    rows, used, at, size = 0, 0, 0, len(data)
    while at < size:
        end = at
        while end < size and data[end] != _NEWLINE:
            end += 1
        if end == size:
            break
        field, place, good = 0, at, True
        while good:
            while place < end and (data[place] == _SPACE or data[place] == _TAB or data[place] == _RETURN):
                place += 1
            if place == end:
                break
            if field == columns:
                good = False
                break
            negative = data[place] == _MINUS
            if negative or data[place] == _PLUS:
                place += 1
            value, digits = np.int64(0), 0
            while place < end and _ZERO <= data[place] <= _NINE:
                value = value * 10 + (data[place] - _ZERO)
                digits += 1
                place += 1
            if digits == 0 or digits > 18:
                good = False
                break
            if field == seconds_column:
                if digits > 12:
                    good = False
                    break
                value *= 1_000_000
                if place < end and data[place] == _DOT:
                    place += 1
                    unit, up = np.int64(100_000), False
                    first = True
                    while place < end and _ZERO <= data[place] <= _NINE:
                        digit = np.int64(data[place] - _ZERO)
                        if unit > 0:
                            value += digit * unit
                        elif first:
                            up = digit >= 5
                            first = False
                        unit //= 10
                        place += 1
                    if up:
                        value += 1
            values[rows, field] = -value if negative else value
            field += 1
            while place < end and (data[place] == _SPACE or data[place] == _TAB or data[place] == _RETURN):
                place += 1
            if place < end and (data[place] == _COMMA or data[place] == _SEMICOLON):
                place += 1
            elif place < end and place > at and not (data[place - 1] == _SPACE or data[place - 1] == _TAB):
                good = False
        if good and field == columns:
            starts[rows] = at
            rows += 1
        elif not (good and field == 0):  # an empty line is no row and no fault
            if state[FAULTS] == 0:
                state[FIRST_FAULT] = at
            state[FAULTS] += 1
        at = end + 1
        used = at
    return rows, used


@njit(cache=True)
def print_rows(values, data):
    """Print rows of whole numbers with commas; return the bytes written. 21 bytes a number suffice."""
    at = 0
    digits = np.empty(20, np.uint8)
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            value = values[row, column]
            if value < 0:
                data[at] = _MINUS
                at += 1
            count = 0
            while True:
                # The remainder is taken before the sign: -value overflows for the smallest number.
                quotient = (
                    value // 10 if value >= 0 else -((-(value + 1)) // 10) - (((-(value + 1)) % 10 + 1) // 10)
                )
                digit = value - quotient * 10
                digits[count] = _ZERO + (digit if digit >= 0 else -digit)
                count += 1
                value = quotient
                if value == 0:
                    break
            for index in range(count):
                data[at] = digits[count - 1 - index]
                at += 1
            data[at] = _COMMA if column + 1 < values.shape[1] else _NEWLINE
            at += 1
    return at
