"""Numbers between calmwalk and the server: sections of files in shared memory (docs/python-protocol.md)."""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Optional

import numpy as np

from .batch import Batch, Counts
from .errors import InputError
from .protocol import get

ALIGNMENT = 64
"""Offsets of sections are multiples of this, bytes."""

_FLOAT, _INT, _BYTE = np.dtype("<f8"), np.dtype("<i4"), np.dtype("u1")

# Shapes: S structures, A atoms, B bonds, D features.
_INPUTS: dict[str, tuple[np.dtype, tuple[Any, ...]]] = {
    "species": (_INT, ("A",)),
    "structure_of_atom": (_INT, ("A",)),
    "centres": (_INT, ("B",)),
    "neighbours": (_INT, ("B",)),
    "structure_of_bond": (_INT, ("B",)),
    "bonds": (_FLOAT, ("B", 3)),
    "positions": (_FLOAT, ("A", 3)),
    "cells": (_FLOAT, ("S", 3, 3)),
    "periodic": (_BYTE, ("S", 3)),
}
_OTHERS: dict[str, tuple[np.dtype, tuple[Any, ...]]] = {
    "energies": (_FLOAT, ("A",)),
    "features": (_FLOAT, ("A", "D")),
    "forces": (_FLOAT, ("A", 3)),
    "virials": (_FLOAT, ("S", 3, 3)),
    "feature_cotangents": (_FLOAT, ("A", "D")),
    "energy_cotangents": (_FLOAT, ("A",)),
    "gradients": (_FLOAT, ("A", 3)),
    "gradient_virials": (_FLOAT, ("S", 3, 3)),
}


@dataclass
class Arena:
    """A mapped file of shared memory, and what belongs to its last evaluation."""

    path: str
    bytes: int
    map: mmap.mmap
    layout: Any = None
    """Shape and offsets of `views`."""
    views: dict[str, np.ndarray] = field(default_factory=dict)
    shape: Optional[tuple[int, ...]] = None
    topology: Optional[int] = None
    fixed: dict[str, Any] = field(default_factory=dict)
    evaluated: Optional[int] = None
    """Id of the last evaluation that succeeded."""
    kept: Any = None
    """What that evaluation left in `Batch.kept`."""


@dataclass(frozen=True)
class Call:
    """One evaluate or pull_back: the batch, and the arrays of the call by section name."""

    id: int
    batch: Batch
    arena: Arena
    arrays: dict[str, np.ndarray]


class Arenas:
    """All arenas of a server."""

    def __init__(self) -> None:
        self._arenas: dict[int, Arena] = {}

    def read(self, message: Mapping[str, Any], dimension: int, sections: list[str]) -> Call:
        """The batch of a message, and the arrays of `sections` beside it; `dimension` is the number of features."""
        arena = self._arena(message)
        shape = _shape(message, dimension)
        offsets = get(message, "sections", dict)
        if arena.layout != (shape, offsets):
            arena.layout, arena.views = (shape, offsets), {}
        for name, spec in [*_INPUTS.items(), *((name, _OTHERS[name]) for name in sections)]:
            if name not in arena.views:
                arena.views[name] = _view(arena, name, offsets, shape, spec)
        arrays = {name: arena.views[name] for name in [*_INPUTS, *sections]}
        _keep_while_topology_stays(arena, get(message, "topology", int), tuple(shape.values()))
        inputs = {name: arrays.pop(name) for name in _INPUTS}
        batch = Batch(**inputs, real=_real(message, shape), fixed=arena.fixed)
        return Call(get(message, "id", int), batch, arena, arrays)

    def _arena(self, message: Mapping[str, Any]) -> Arena:
        number, path, size = get(message, "arena", int), get(message, "path", str), get(message, "bytes", int)
        arena = self._arenas.get(number)
        if arena is None or arena.path != path or arena.bytes != size:
            new = Arena(path, size, _map(path, size))
            if arena is not None:
                new.evaluated, new.kept = arena.evaluated, arena.kept
            self._arenas[number] = arena = new
        return arena


def _map(path: str, size: int) -> mmap.mmap:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as error:
        raise InputError(f"cannot open the arena {path}: {error.strerror}") from None
    try:
        found = os.fstat(descriptor).st_size
        if found < size or size <= 0:
            raise InputError(f"the arena {path} has {found} bytes, expected {size}")
        return mmap.mmap(descriptor, size, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE)
    finally:
        os.close(descriptor)


def _shape(message: Mapping[str, Any], dimension: int) -> dict[str, int]:
    shape = {letter: get(message, key, int) for letter, key in (("S", "structures"), ("A", "atoms"), ("B", "bonds"))}
    if min(shape.values()) < 0:
        raise InputError(f"structures, atoms and bonds are {list(shape.values())}, expected no negative number")
    return {**shape, "D": dimension}


def _real(message: Mapping[str, Any], shape: Mapping[str, int]) -> Counts:
    real = get(message, "real", dict)
    counts = Counts(*(get(real, key, int) for key in ("structures", "atoms", "bonds")))
    if counts.structures > shape["S"] or counts.atoms > shape["A"] or counts.bonds > shape["B"]:
        raise InputError(f"real is {real}, more than the shape {[shape[letter] for letter in 'SAB']}")
    return counts


def _view(
    arena: Arena,
    name: str,
    offsets: Mapping[str, Any],
    shape: Mapping[str, int],
    spec: tuple[np.dtype, tuple[Any, ...]],
) -> np.ndarray:
    dtype, letters = spec
    sizes = tuple(shape[size] if isinstance(size, str) else size for size in letters)
    offset = offsets.get(name)
    if not isinstance(offset, int) or offset < 0 or offset % ALIGNMENT != 0:
        raise InputError(f"the offset of section {name} is {offset!r}, expected a multiple of {ALIGNMENT}")
    end = offset + dtype.itemsize * int(np.prod(sizes))
    if end > arena.bytes:
        raise InputError(f"section {name} ends at byte {end}, but the arena has {arena.bytes}")
    if 0 in sizes:
        return np.empty(sizes, dtype)
    view: np.ndarray = np.ndarray(sizes, dtype, arena.map, offset)
    return view


def _keep_while_topology_stays(arena: Arena, topology: int, shape: tuple[int, ...]) -> None:
    if arena.topology != topology or arena.shape != shape:
        arena.topology, arena.shape, arena.fixed = topology, shape, {}
