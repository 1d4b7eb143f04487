"""Writes radial-al.json, radial-alcu.json and the cheap radial-al-short.json in data: radial models fitted to the
potentials of Cleri and Rosato (Phys. Rev. B 48, 22 (1993), table II) for Al and Cu, with geometric means between the
elements. Lattice constants come out as 4.07 Å (Al), 3.57 Å (Cu) and 3.96 Å (Al, short).

Needs scipy. Run it in this folder: python make_radial.py
"""

from __future__ import annotations

import json
from itertools import product

import numpy as np
from scipy.optimize import nnls

# A (eV), ξ (eV), p, q, r0 (Å)
GUPTA = {"Al": (0.1221, 1.316, 8.612, 2.516, 2.8637), "Cu": (0.0855, 1.224, 10.960, 2.278, 2.5562)}
Blocks = list[list[dict[str, float]]]
LONG: Blocks = [
    [{"centre": centre, "width": 0.6} for centre in (1.2, 1.8, 2.4, 3.0)],
    [{"centre": centre, "width": 1.2} for centre in (2.0, 3.2, 4.4)],
]
SHORT: Blocks = [[{"centre": centre, "width": 0.7} for centre in (1.4, 2.2, 3.0)]]
# Name, elements, cutoff (Å), blocks
MODELS = [("al", ["Al"], 5.5, LONG), ("alcu", ["Al", "Cu"], 5.5, LONG), ("al-short", ["Al"], 4.0, SHORT)]


def pair(one: str, other: str) -> tuple[float, ...]:
    """Parameters between two elements."""
    mean = [float(np.sqrt(a * b)) for a, b in zip(GUPTA[one], GUPTA[other])]
    mean[4] = (GUPTA[one][4] + GUPTA[other][4]) / 2
    return tuple(mean)


def fit(one: str, other: str, cutoff: float, blocks: Blocks) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of all functions, block by block: of the repulsion (eV) and of ρ (eV²)."""
    a, xi, p, q, r0 = pair(one, other)
    r = np.linspace(1.7, cutoff, 400)
    window = (1 - (r / cutoff) ** 2) ** 3
    functions = [function for block in blocks for function in block]
    basis = np.array([np.exp(-(((r - f["centre"]) / f["width"]) ** 2)) * window for f in functions]).T
    weight = np.where(r > 2.2, 1.0, 0.1)[:, None]
    repulsion = a * np.exp(-p * (r / r0 - 1)) * (r < 4.5)
    density = xi**2 * np.exp(-2 * q * (r / r0 - 1)) * np.minimum(1, np.maximum(0, cutoff - r))
    return (
        nnls(weight * basis, weight[:, 0] * repulsion)[0],
        nnls(weight * basis, weight[:, 0] * density)[0],
    )


def row(element: str, elements: list[str], cutoff: float, blocks: Blocks, which: int) -> list[float]:
    """Coefficients of all columns, sorted by block, element, function."""
    fits = {other: fit(element, other, cutoff, blocks)[which] for other in elements}
    columns, start = [], 0
    for block in blocks:
        for other, k in product(elements, range(len(block))):
            columns.append(round(float(fits[other][start + k]), 6))
        start += len(block)
    return columns


def main() -> None:
    for name, elements, cutoff, blocks in MODELS:
        model = {
            "elements": elements,
            "cutoff": cutoff,
            "blocks": blocks,
            "shift": {e: 0.0 for e in elements},
            "linear": {e: row(e, elements, cutoff, blocks, 0) for e in elements},
            "embedding": {e: row(e, elements, cutoff, blocks, 1) for e in elements},
            "floor": {e: 0.01 for e in elements},
        }
        with open(f"data/radial-{name}.json", "w") as file:
            json.dump(model, file, indent=1)
            file.write("\n")


if __name__ == "__main__":
    main()
