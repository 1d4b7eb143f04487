"""Bytes of the store as numpy arrays: numbers, structures, candidate blocks, components. All are little-endian."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .store_errors import DamagedError, MissingPackage

Floats = NDArray[np.float64]

# The header of a candidate block (crates/wire/src/block/layout.rs).
_HEADER = struct.Struct("<8sIIQQQ16s32sIIQQI4Bddd9d9d")
_BLOCK_MAGIC, _BLOCK_VERSION = b"CALMCAND", 1
# The checksum covers everything after this offset.
_CHECKED_FROM = 16
_ORIGINS = ("biased", "control")

# Set in the first word of arrays that are not compressed (store/src/numbers.rs).
_PLAIN = 1 << 63

# Periodicity and lattice vectors, and what each atom takes (store/src/encoding.rs).
_STRUCTURE_FIXED, _STRUCTURE_PER_ATOM = 3 + 72, 1 + 24

# Header of a component of the mixture (crates/calm/src/bytes.rs).
_COMPONENT = struct.Struct("<8sIIQ")
_COMPONENT_MAGIC, _COMPONENT_FORMAT = b"CALMCOMP", 1


@dataclass(frozen=True)
class Structure:
    """Atoms in a cell."""

    numbers: NDArray[np.int64]
    """Atomic numbers, [n]."""
    positions: Floats
    """[n, 3], Å."""
    cell: Floats
    """Lattice vectors by rows, [3, 3], Å."""
    pbc: tuple[bool, bool, bool]
    """Periodic directions."""


@dataclass(frozen=True)
class Block:
    """A candidate block: a structure with everything that its walker computed for it."""

    id: str
    campaign: bytes
    content: bytes
    walk: int
    segment: int
    step: int
    mixture_version: int
    """Of the mixture that the walker used."""
    origin: str
    temperature: float
    """Kinetic temperature, K."""
    relative_volume: float
    """V / V₀."""
    energy: float
    """Of the potential, without bias and ZBL, eV."""
    virial: Floats
    """−∂E/∂ε of the potential, [3, 3], eV."""
    structure: Structure
    forces: Floats
    """−∂E/∂r of the potential, [n, 3], eV/Å."""
    gamma: Floats
    """γ under the walker's mixture, [n]."""
    gamma_nbr: Floats
    """γ_nbr under the walker's mixture, [n]."""
    features: Floats
    """[n, D]; the store keeps them apart, and D is 0 here."""


@dataclass(frozen=True)
class Component:
    """One Gaussian of the mixture."""

    element: int
    """Index of its element in the model."""
    slot: int
    threshold: float
    """θ."""
    centroid: Floats
    """μ, [D]."""
    inverse: Floats
    """Inverse covariance S, [D, D]."""
    count: float | None
    """Number of environments; None without statistics."""
    effective_count: float | None
    """Sum of their weights."""
    scatter: Floats | None
    """Σ w δδᵀ about the centroid, [D, D]."""

    @property
    def covariance(self) -> Floats | None:
        """C = scatter / effective count, [D, D]; zero for an empty component."""
        if self.scatter is None or self.effective_count is None:
            return None
        return (
            self.scatter / self.effective_count if self.effective_count > 0 else np.zeros_like(self.scatter)
        )


def decode_block(data: bytes) -> Block:
    """Decode a candidate block and verify its length, its checksum and its fields.

    Raises :class:`DamagedError` for bytes that are not a valid block.
    """
    if len(data) < _HEADER.size:
        raise DamagedError(
            f"candidate block too short: {len(data)} bytes, the header alone has {_HEADER.size}"
        )
    header = _HEADER.unpack_from(data)
    (
        magic,
        version,
        expected,
        length,
        n,
        dimension,
        campaign,
        content,
        walk,
        segment,
        step,
        mixture,
        origin,
    ) = header[:13]
    if magic != _BLOCK_MAGIC:
        raise DamagedError(f"not a candidate block: it begins with {magic!r}, expected {_BLOCK_MAGIC!r}")
    if version != _BLOCK_VERSION:
        raise DamagedError(f"candidate block of version {version}, expected version {_BLOCK_VERSION}")
    if not (n > 0 and length == len(data) == _HEADER.size + 8 * n * (9 + dimension)):
        raise DamagedError(
            f"candidate block of {len(data)} bytes, its header says {length} for {n} atoms and {dimension} features"
        )
    found = zlib.crc32(memoryview(data)[_CHECKED_FROM:])
    if found != expected:
        raise DamagedError(f"damaged candidate block: checksum {found:08x}, expected {expected:08x}")
    periodic, (temperature, volume, energy) = header[13:17], header[17:20]
    numbers = np.frombuffer(data, "<u8", n, _HEADER.size).astype(np.int64)
    _check_fields(origin, periodic, numbers)
    arrays = np.frombuffer(data, "<f8", offset=_HEADER.size + 8 * n)
    positions, forces, gamma, gamma_nbr, features = np.split(arrays, np.cumsum([3 * n, 3 * n, n, n]))
    cell, virial = np.array(header[20:29]).reshape(3, 3), np.array(header[29:38]).reshape(3, 3)
    return Block(
        id=f"{campaign[:4].hex()}-{walk}.{segment}.{step}-{content[:8].hex()}",
        campaign=campaign,
        content=content,
        walk=walk,
        segment=segment,
        step=step,
        mixture_version=mixture,
        origin=_ORIGINS[origin],
        temperature=temperature,
        relative_volume=volume,
        energy=energy,
        virial=virial,
        structure=Structure(numbers, positions.reshape(n, 3), cell, _booleans(periodic)),
        forces=forces.reshape(n, 3),
        gamma=gamma,
        gamma_nbr=gamma_nbr,
        features=features.reshape(n, dimension),
    )


def _check_fields(origin: int, periodic: tuple[int, ...], numbers: NDArray[np.int64]) -> None:
    if origin >= len(_ORIGINS):
        raise DamagedError(f"candidate block with invalid origin: {origin}")
    if max(periodic) > 1 or periodic[3] != 0:
        raise DamagedError(f"candidate block with invalid periodic: {list(periodic)}")
    if not ((1 <= numbers) & (numbers <= 118)).all():
        raise DamagedError("candidate block with an invalid atomic number")


def _booleans(periodic: tuple[int, ...]) -> tuple[bool, bool, bool]:
    x, y, z = (bool(value) for value in periodic[:3])
    return x, y, z


def decode_structure(data: bytes) -> Structure:
    """Decode a structure: periodicity, lattice vectors, atomic numbers, positions."""
    n, rest = divmod(len(data) - _STRUCTURE_FIXED, _STRUCTURE_PER_ATOM)
    if n < 0 or rest or max(data[:3]) > 1:
        raise DamagedError(f"{len(data)} bytes are not a structure")
    cell = np.frombuffer(data, "<f8", 9, 3).reshape(3, 3)
    numbers = np.frombuffer(data, "u1", n, _STRUCTURE_FIXED).astype(np.int64)
    positions = decode_vectors(data[_STRUCTURE_FIXED + n :])
    return Structure(numbers, positions, cell, _booleans(tuple(data[:3])))


def decode_vectors(data: bytes) -> Floats:
    """Vectors, [n, 3]."""
    if len(data) % 24:
        raise DamagedError(f"{len(data)} bytes are not vectors of three numbers")
    return np.frombuffer(data, "<f8").reshape(-1, 3)


def decode_matrix(data: bytes) -> Floats:
    """Three vectors by rows, [3, 3]."""
    matrix = decode_vectors(data)
    if len(matrix) != 3:
        raise DamagedError(f"{len(data)} bytes are not a matrix of nine numbers")
    return matrix


def decode_numbers(data: bytes) -> Floats:
    """Numbers with their count before them, [count]. Compressed ones of early versions need Python 3.14 or a zstd package."""
    if len(data) < 8:
        raise DamagedError(f"{len(data)} bytes, too few for an array")
    (first,) = struct.unpack_from("<Q", data)
    count, plain = first & ~_PLAIN, bool(first & _PLAIN)
    body = data[8:] if plain else _decompressed(data[8:], 8 * count)
    if len(body) != 8 * count:
        raise DamagedError(f"{len(body)} bytes, expected {count} numbers")
    if plain:
        return np.frombuffer(body, "<f8")
    # All first bytes, then all second bytes …
    planes = np.frombuffer(body, "u1").reshape(8, count)
    return np.ascontiguousarray(planes.T).view("<f8").reshape(count)


def _decompressed(frame: bytes, limit: int) -> bytes:
    try:
        from compression import zstd  # Python 3.14

        # One byte more than expected is enough to detect excess data.
        return bytes(zstd.ZstdDecompressor().decompress(frame, limit + 1))
    except ImportError:
        pass
    try:
        import zstandard

        return bytes(zstandard.ZstdDecompressor().decompress(frame, max_output_size=limit + 1))
    except ImportError:
        raise MissingPackage(
            "this row was written by an early version of calmwalk and is compressed: pip install zstandard to read it"
        ) from None


def decode_component(element: int, slot: int, data: bytes) -> Component:
    """Decode a component of the mixture."""
    if len(data) < _COMPONENT.size:
        raise DamagedError(f"{len(data)} bytes are too few for a mixture component")
    magic, version, dimension, flags = _COMPONENT.unpack_from(data)
    if magic != _COMPONENT_MAGIC or version != _COMPONENT_FORMAT or flags > 1:
        raise DamagedError(
            f"component {slot} of element {element}: magic {magic!r}, format {version}, flags {flags}; "
            f"expected {_COMPONENT_MAGIC!r}, {_COMPONENT_FORMAT}, 0 or 1"
        )
    packed = dimension * (dimension + 1) // 2
    expected = _COMPONENT.size + 8 * (1 + dimension + packed + flags * (2 + packed))
    if len(data) != expected:
        raise DamagedError(f"a component of {dimension} features has {len(data)} bytes, expected {expected}")
    numbers = np.frombuffer(data, "<f8", offset=_COMPONENT.size)
    threshold, centroid, inverse, rest = np.split(numbers, np.cumsum([1, dimension, packed]))
    return Component(
        element=element,
        slot=slot,
        threshold=float(threshold[0]),
        centroid=centroid,
        inverse=_unpacked(inverse, dimension),
        count=float(rest[0]) if flags else None,
        effective_count=float(rest[1]) if flags else None,
        scatter=_unpacked(rest[2:], dimension) if flags else None,
    )


def _unpacked(packed: Floats, dimension: int) -> Floats:
    """The symmetric matrix of which the lower triangle is given by rows."""
    out = np.empty((dimension, dimension))
    rows, columns = np.tril_indices(dimension)
    out[rows, columns] = packed
    out[columns, rows] = packed
    return out
