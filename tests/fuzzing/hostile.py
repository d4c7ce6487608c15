"""Hostile values, and mutations of bytes and of JSON, which the generators of inputs share."""

from __future__ import annotations

import copy
import json
import re
import struct
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st


@dataclass(frozen=True)
class Raw:
    """A text in a JSON document that Python would not write."""

    text: str


LONG = "x" * 70_000
NUMBERS: list[Any] = [
    *(0, 1, -1, 2, 3, 7, 255, 256, 65_535, 1 << 31, -(1 << 31), (1 << 32) - 1, 1 << 53, 1 << 63, 1 << 64, 10**18),
    *(0.5, -0.5, 1e-320, 1e20, -1e20, 1e9, 1e308, -1e308, float("nan"), float("inf"), float("-inf")),
    *(Raw("9" * 400), Raw("-" + "9" * 400), Raw("9" * 5000), Raw("1e400"), Raw("1e-400"), Raw("0." + "1" * 5000)),
]
TEXTS = [
    *("", ".", "..", "/", "../../secret.png", "/dev/zero", "/dev/stdin", "/proc/self/mem", "pipe", "link.png", "images", "a\0b", "\0"),
    *(
        "\ud800",
        "\udcff/a",
        "a\nb\x1b[31m",
        LONG,
        "C:\\x",
        "~",
        "%00",
        "%2e%2e/secret.png",
        "data:,",
        "data:;base64,%%%",
        "file:///etc/passwd",
    ),
    *(
        "http://127.0.0.1/x",
        "NaN",
        "1e400",
        "9" * 5000,
        "true",
        "{0.__class__}",
        "$(id)",
        "ORTHOGRAPHIC",
        "OPENCV",
        "VEC3",
        "SCALAR",
        "blend",
    ),
]
DEEP = [Raw("[" * depth + "]" * depth) for depth in (20, 300, 990, 100_000)] + [
    Raw('{"a":' * depth + "1" + "}" * depth) for depth in (300, 980)
]
OTHERS: list[Any] = [
    None,
    True,
    False,
    [],
    {},
    [[]],
    [None],
    {"": {}},
    [0] * 10_000,
    [1e308] * 16,
    [[1e308] * 4] * 4,
    [1e20] * 3,
    [float("nan")] * 3,
]
hostile = st.one_of(st.sampled_from(NUMBERS), st.sampled_from(TEXTS), st.sampled_from(DEEP), st.sampled_from(OTHERS))
small_numbers = st.one_of(st.integers(-3, 40), st.floats(-3, 3, width=16))


def dumped(value: Any) -> bytes:
    """A value with :class:`Raw` parts as JSON, with lone surrogates as they are escaped."""
    raws = list[str]()

    def hidden(part: Any) -> Any:
        if isinstance(part, Raw):
            raws.append(part.text)
            return f"@@raw{len(raws) - 1}@@"
        if isinstance(part, dict):
            return {str(key): hidden(item) for key, item in part.items()}
        return [hidden(item) for item in part] if isinstance(part, list) else part

    try:
        text = json.dumps(hidden(value))
    except RecursionError:  # changes have put a part into itself, which no file can hold
        text = "[]"
    return re.sub(r'"@@raw(\d+)@@"', lambda match: raws[int(match[1])], text).encode()


def _places(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all parts of a document but the document itself."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [found for key, item in items for found in ((*place, key), *_places(item, (*place, key)))]


def _holder(document: Any, place: tuple[Any, ...]) -> Any:
    for key in place[:-1]:
        document = document[key]
    return document


@st.composite
def documents(draw: st.DrawFn, valid: Any, most: int = 3) -> Any:
    """Changes of a JSON document: values replaced, removed, repeated, moved, added. Rarely something else altogether."""
    if draw(st.integers(0, 30)) == 0:
        return draw(hostile)
    document, repeats = copy.deepcopy(valid), st.sampled_from([1, 2, 1000])
    for _ in range(draw(st.integers(1, most))):
        place = draw(st.sampled_from(_places(valid)))
        try:
            holder, key = _holder(document, place), place[-1]
            before = holder[key]
            kind = draw(st.integers(0, 9))
            if kind < 5:
                holder[key] = draw(hostile)
            elif kind == 5:
                holder[key] = draw(small_numbers)
            elif kind == 6:
                del holder[key]
            elif kind == 7 and isinstance(holder, list):
                holder.extend([before] * (1 if isinstance(before, Raw) else draw(repeats)))
                repeats = st.just(1)  # or the document would grow without bounds
            elif kind == 8:
                other = draw(st.sampled_from(_places(valid)))
                holder[key] = copy.deepcopy(_holder(valid, other)[other[-1]])
            elif isinstance(holder, dict):
                holder[draw(st.sampled_from(["extra", "", "__class__", "extensions", "\ud800", *map(str, holder)]))] = draw(hostile)
        except (LookupError, TypeError):  # an earlier change removed the place
            continue
    return document


@st.composite
def changed_bytes(draw: st.DrawFn, valid: bytes) -> bytes:
    """Changes of a file: bytes flipped, numbers replaced, parts removed, repeated or inserted, the end cut off."""
    data = bytearray(valid)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.one_of(st.integers(0, max(len(data) - 1, 0)), st.integers(0, min(len(data) - 1, 120) if data else 0)))
        kind = draw(st.integers(0, 6))
        if kind == 0:
            data[place : place + 1] = bytes([draw(st.integers(0, 255))])
        elif kind == 1:
            data[place : place + 4] = struct.pack("<I", draw(st.sampled_from([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 24])))
        elif kind == 2:
            number = draw(st.sampled_from([float("nan"), float("inf"), 1e20, -1e20, 3e38, 1e-40, 0.0]))
            data[place // 4 * 4 : place // 4 * 4 + 4] = struct.pack("<f", number)
        elif kind == 3:
            del data[place:]
        elif kind == 4:
            del data[place : place + draw(st.integers(1, 60))]
        elif kind == 5:
            data[place:place] = data[place : place + draw(st.integers(1, 200))] * draw(st.sampled_from([1, 2, 50]))
        else:
            data[place:place] = draw(st.binary(max_size=40))
    return bytes(data)


@st.composite
def changed_words(draw: st.DrawFn, valid: bytes) -> bytes:
    """Changes of a text file: words replaced by hostile ones, lines repeated or removed, or bytes changed."""
    if draw(st.integers(0, 4)) == 0:
        return draw(changed_bytes(valid))
    lines = [line.split(b" ") for line in valid.split(b"\n")]
    for _ in range(draw(st.integers(1, 4))):
        line = draw(st.integers(0, len(lines) - 1))
        kind = draw(st.integers(0, 3))
        if kind == 0:
            lines.insert(line, lines[line])
        elif kind == 1:
            lines[line] = lines[line] * 2
        else:
            value = draw(st.one_of(st.sampled_from(NUMBERS), st.sampled_from(TEXTS)))
            text = value.text if isinstance(value, Raw) else str(value)
            lines[line] = list(lines[line])
            lines[line][draw(st.integers(0, len(lines[line]) - 1))] = text.encode(errors="surrogatepass")
    return b"\n".join(b" ".join(words) for words in lines)
