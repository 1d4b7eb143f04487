"""Traces of walks: their physical state, grade and bias at an interval of steps (docs/walk-diagnostics.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .blocks import decode_numbers
from .store_errors import DamagedError

# Quantities of a point in the order of the store (store/src/walk_trace.rs), called as in the CSV of `calmwalk walks trace`.
WHOLE = ("number", "segment", "step")
QUANTITIES = (
    *WHOLE,
    "time",
    "temperature",
    "pressure",
    "relative_volume",
    "a",
    "b",
    "c",
    "alpha",
    "beta",
    "gamma",
    "conserved_energy",
    "gamma_max",
    "bias_scale",
    "cell_gain",
    "bias_share",
    "bias_work",
    "gamma_max_original",
)
# Traces of the first version end before this one, and have NaN for it.
FIRST_QUANTITIES = QUANTITIES.index("gamma_max_original")

Trace = dict[str, NDArray[np.float64] | NDArray[np.int64]]


def empty_trace() -> Trace:
    """The trace of a walk without points."""
    return _columns(np.empty((len(QUANTITIES), 0)))


def decode_trace(walk: int, points: int, data: bytes) -> Trace:
    """The columns of a trace with so many points. Later versions of calmwalk add quantities at the end."""
    numbers = decode_numbers(data)
    if points < 1 or len(numbers) < points * FIRST_QUANTITIES or len(numbers) % points:
        raise DamagedError(
            f"damaged database: the trace of walk {walk}: {len(numbers)} numbers for {points} points"
        )
    rows = numbers.reshape(-1, points)
    missing = np.full((max(len(QUANTITIES) - len(rows), 0), points), np.nan)
    return _columns(np.concatenate([rows, missing]))


def _columns(rows: NDArray[np.float64]) -> Trace:
    return {
        name: row.astype(np.int64) if name in WHOLE else row
        for name, row in zip(QUANTITIES, rows, strict=False)
    }
