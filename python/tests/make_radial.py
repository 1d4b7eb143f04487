"""Writes data/radial-al.json and data/radial-alcu.json: radial models fitted to the potentials of Cleri and Rosato
(Phys. Rev. B 48, 22 (1993), table II) for Al and Cu, with geometric means between the elements.

Needs scipy. Run it in this folder: python make_radial.py
"""

from __future__ import annotations

import json
from itertools import product

import numpy as np
from scipy.optimize import nnls

CUTOFF = 5.5
# A (eV), ξ (eV), p, q, r0 (Å)
GUPTA = {"Al": (0.1221, 1.316, 8.612, 2.516, 2.8637), "Cu": (0.0855, 1.224, 10.960, 2.278, 2.5562)}
BLOCKS = [
    [{"centre": centre, "width": 0.6} for centre in (1.2, 1.8, 2.4, 3.0)],
    [{"centre": centre, "width": 1.2} for centre in (2.0, 3.2, 4.4)],
]


def pair(one: str, other: str) -> tuple[float, ...]:
    """Parameters between two elements."""
    mean = [float(np.sqrt(a * b)) for a, b in zip(GUPTA[one], GUPTA[other])]
    mean[4] = (GUPTA[one][4] + GUPTA[other][4]) / 2
    return tuple(mean)


def fit(one: str, other: str) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of all functions, block by block: of the repulsion (eV) and of ρ (eV²)."""
    a, xi, p, q, r0 = pair(one, other)
    r = np.linspace(1.7, CUTOFF, 400)
    window = (1 - (r / CUTOFF) ** 2) ** 3
    functions = [f for block in BLOCKS for f in block]
    basis = np.array([np.exp(-(((r - f["centre"]) / f["width"]) ** 2)) * window for f in functions]).T
    weight = np.where(r > 2.2, 1.0, 0.1)[:, None]
    repulsion = a * np.exp(-p * (r / r0 - 1)) * (r < 4.5)
    density = xi**2 * np.exp(-2 * q * (r / r0 - 1)) * np.minimum(1, np.maximum(0, CUTOFF - r))
    return (
        nnls(weight * basis, weight[:, 0] * repulsion)[0],
        nnls(weight * basis, weight[:, 0] * density)[0],
    )


def row(element: str, elements: list[str], which: int) -> list[float]:
    """Coefficients of all columns, sorted by block, element, function."""
    fits = {other: fit(element, other)[which] for other in elements}
    columns, start = [], 0
    for block in BLOCKS:
        for other, k in product(elements, range(len(block))):
            columns.append(round(float(fits[other][start + k]), 6))
        start += len(block)
    return columns


def main() -> None:
    for elements in (["Al"], ["Al", "Cu"]):
        model = {
            "elements": elements,
            "cutoff": CUTOFF,
            "blocks": BLOCKS,
            "shift": {e: 0.0 for e in elements},
            "linear": {e: row(e, elements, 0) for e in elements},
            "embedding": {e: row(e, elements, 1) for e in elements},
            "floor": {e: 0.01 for e in elements},
        }
        with open(f"data/radial-{''.join(elements).lower()}.json", "w") as file:
            json.dump(model, file, indent=1)
            file.write("\n")


if __name__ == "__main__":
    main()
