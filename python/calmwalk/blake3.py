"""The hash BLAKE3 on numpy, for files in the store (https://github.com/BLAKE3-team/BLAKE3-specs, sections 2.1 to 2.6).

All chunks are compressed side by side, so that files of tens of megabytes take a second.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint32]
Integers = NDArray[np.int64]

_IV = np.array(
    [0x6A09E667, 0xBB67AE85, 0x3C6EF372, 0xA54FF53A, 0x510E527F, 0x9B05688C, 0x1F83D9AB, 0x5BE0CD19],
    np.uint32,
)
_PERMUTATION = [2, 6, 3, 10, 7, 0, 4, 13, 1, 11, 12, 5, 9, 14, 15, 8]
_ROUNDS = 7
_BLOCK, _CHUNK = 64, 1024
_CHUNK_START, _CHUNK_END, _PARENT, _ROOT = 1, 2, 4, 8
# Columns, then diagonals of the state.
_MIXED = [(0, 4, 8, 12), (1, 5, 9, 13), (2, 6, 10, 14), (3, 7, 11, 15)]
_MIXED += [(0, 5, 10, 15), (1, 6, 11, 12), (2, 7, 8, 13), (3, 4, 9, 14)]


def blake3(data: bytes) -> str:
    """The hash as 64 hexadecimal digits."""
    chunks = max(1, -(-len(data) // _CHUNK))
    values = _chunk_values(data, chunks)
    while len(values) > 1:
        values = _parents(values)
    return bytes(values[0].astype("<u4")).hex()


def _chunk_values(data: bytes, chunks: int) -> Words:
    """Chaining values of the chunks, [chunks, 8]; that of a single chunk is the root."""
    padded = np.zeros(chunks * _CHUNK, np.uint8)
    padded[: len(data)] = np.frombuffer(data, np.uint8)
    blocks = padded.view("<u4").astype(np.uint32).reshape(chunks, _CHUNK // _BLOCK, 16)
    sizes = np.full(chunks, _CHUNK)
    sizes[-1] = len(data) - (chunks - 1) * _CHUNK
    # An empty input has one empty block.
    last = np.maximum(1, -(-sizes // _BLOCK)) - 1
    values = np.repeat(_IV[None], chunks, axis=0)
    for number in range(_CHUNK // _BLOCK):
        live = np.flatnonzero(last >= number)
        if not len(live):
            break
        ends = last[live] == number
        flags = np.where(ends, _CHUNK_END, 0) | (_CHUNK_START if number == 0 else 0)
        if chunks == 1:
            flags = flags | np.where(ends, _ROOT, 0)
        lengths = np.minimum(_BLOCK, sizes[live] - number * _BLOCK)
        values[live] = _compress(values[live], blocks[live, number], live, lengths, flags)
    return values


def _parents(values: Words) -> Words:
    """One level of the tree: pairs from the left; a last one without partner moves up."""
    pairs = len(values) // 2
    messages = values[: 2 * pairs].reshape(pairs, 16)
    flags = _PARENT | (_ROOT if len(values) == 2 else 0)
    chaining = np.repeat(_IV[None], pairs, axis=0)
    joined = _compress(
        chaining, messages, np.zeros(pairs, np.int64), np.full(pairs, _BLOCK), np.full(pairs, flags)
    )
    return np.concatenate([joined, values[2 * pairs :]])


def _compress(chaining: Words, message: Words, counter: Integers, length: Integers, flags: Integers) -> Words:
    """The first eight words of the compression function, [k, 8]."""
    low = counter.astype(np.uint64)
    v = [*chaining.T.copy(), *(np.full(len(chaining), word) for word in _IV[:4])]
    v += [(low & 0xFFFFFFFF).astype(np.uint32), (low >> np.uint64(32)).astype(np.uint32)]
    v += [length.astype(np.uint32), flags.astype(np.uint32)]
    m = list(message.T.copy())
    for _ in range(_ROUNDS):
        for k, (a, b, c, d) in enumerate(_MIXED):
            _mix(v, a, b, c, d, m[2 * k], m[2 * k + 1])
        m = [m[k] for k in _PERMUTATION]
    return np.stack([v[k] ^ v[k + 8] for k in range(8)], axis=1)


def _mix(v: list[Words], a: int, b: int, c: int, d: int, x: Words, y: Words) -> None:
    v[a] = v[a] + v[b] + x
    v[d] = _rotated(v[d] ^ v[a], 16)
    v[c] = v[c] + v[d]
    v[b] = _rotated(v[b] ^ v[c], 12)
    v[a] = v[a] + v[b] + y
    v[d] = _rotated(v[d] ^ v[a], 8)
    v[c] = v[c] + v[d]
    v[b] = _rotated(v[b] ^ v[c], 7)


def _rotated(words: Words, by: int) -> Words:
    """Rotated to the right."""
    return (words >> np.uint32(by)) | (words << np.uint32(32 - by))
