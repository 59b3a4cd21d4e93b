"""Changes to the bytes of a file, by chance."""

import random
import re
from collections.abc import Callable

NUMBERS = [b"0", b"-1", b"1e308", b"1e-308", b"nan", b".inf", b"0640", b"9" * 40, b"1e999", b"-0.0", b"null"]
PIECES = [
    b"",
    b"\xef\xbb\xbf",
    b"\x00",
    b"\xff\xfe",
    b"---\n",
    b"{",
    b"[",
    b"]",
    b'"',
    b"&a [*a]",
    b"!!int x",
    b"\n",
]


def mutated(data: bytes, others: list[bytes], draw: random.Random) -> bytes:
    """Return a file with one to four changes, by chance."""
    for _ in range(draw.choice((1, 1, 2, 4))):
        data = draw.choice(_MUTATIONS)(data, others, draw)[:200_000]
    return data


def _flip(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    changed = bytearray(data or b" ")
    for _i in range(draw.choice((1, 1, 8))):
        changed[draw.randrange(len(changed))] = draw.randrange(256)
    return bytes(changed)


def _cut(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    return data[: draw.randrange(len(data) + 1)]


def _leave_out(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    start, end = sorted(draw.randrange(len(data) + 1) for _i in range(2))
    return data[:start] + data[end:]


def _repeat(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    start, end = sorted(draw.randrange(len(data) + 1) for _i in range(2))
    return data[:end] + data[start:end] * draw.choice((1, 2, 30)) + data[end:]


def _insert(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    place = draw.randrange(len(data) + 1)
    return data[:place] + draw.choice(PIECES) * draw.choice((1, 1, 1, 500)) + data[place:]


def _change_number(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    found = list(re.finditer(rb"-?\d[\d.e+-]*", data))
    if not found:
        return data
    number = draw.choice(found)
    return data[: number.start()] + draw.choice(NUMBERS) + data[number.end() :]


def _change_text(data: bytes, _: list[bytes], draw: random.Random) -> bytes:
    found = list(re.finditer(rb"[A-Za-z_]\w+", data))
    if not found:
        return data
    word, other = draw.choice(found), draw.choice(found)
    return data[: word.start()] + other[0] + data[word.end() :]


def _mix(data: bytes, others: list[bytes], draw: random.Random) -> bytes:
    other = draw.choice(others)
    return data[: draw.randrange(len(data) + 1)] + other[draw.randrange(len(other) + 1) :]


def _mix_lines(data: bytes, others: list[bytes], draw: random.Random) -> bytes:
    lines = data.split(b"\n")
    lines.insert(draw.randrange(len(lines) + 1), draw.choice(draw.choice(others).split(b"\n")))
    if draw.random() < 0.5:
        del lines[draw.randrange(len(lines))]
    return b"\n".join(lines)


_MUTATIONS: list[Callable[[bytes, list[bytes], random.Random], bytes]] = [
    _flip, _cut, _leave_out, _repeat, _insert, _change_number, _change_number, _change_text, _mix, _mix_lines,
]  # fmt: skip
