"""MaxVol and LLPR with NumPy and SciPy on one thread, for benches/baselines.rs.

Reads DIRECTORY/features.npy [atoms, D], DIRECTORY/queries.npy [n, D]; --structure is the number of atoms of a structure.
Prints the median times, and writes the scores of the queries for comparison.
"""

import argparse
import json
import os
import time

os.environ.update({key: "1" for key in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")})
import numpy as np  # noqa: E402
import scipy.linalg  # noqa: E402
from scipy.linalg import blas  # noqa: E402


def maxvol(features, tolerance):
    """The dominant rows of a matrix that fits in memory: LU with row pivoting, then exchanges with rank-1 updates."""
    _, pivots = scipy.linalg.lu_factor(features)
    rows = np.arange(len(features))
    for k, pivot in enumerate(pivots):
        rows[[k, pivot]] = rows[[pivot, k]]
    active = rows[: features.shape[1]].copy()
    coefficients = scipy.linalg.solve(features[active].T, features.T).T
    coefficients = np.asfortranarray(coefficients)
    exchanges = 0
    while True:
        row, slot = divmod(int(np.abs(coefficients).T.argmax()), len(coefficients))[::-1]
        pivot = coefficients[row, slot]
        if abs(pivot) <= 1.0 + tolerance:
            return active, exchanges
        change = coefficients[row].copy()
        change[slot] -= 1.0
        coefficients = blas.dger(-1.0 / pivot, coefficients[:, slot].copy(), change, a=coefficients, overwrite_a=True)
        active[slot] = row
        exchanges += 1


def llpr(features, atoms, queries, regularisation):
    means = features.reshape(-1, atoms, features.shape[1]).mean(axis=1)
    gram = means.T @ means
    gram[np.diag_indices_from(gram)] += regularisation * np.trace(gram) / len(gram)
    factor = scipy.linalg.cholesky(gram, lower=True)
    return np.linalg.norm(scipy.linalg.solve_triangular(factor, queries.T, lower=True), axis=0)


def measured(work, rounds):
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        found = work()
        times.append(time.perf_counter() - start)
    return found, float(np.median(times))


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("directory")
    parser.add_argument("--structure", type=int, required=True)
    parser.add_argument("--tolerance", type=float, required=True)
    parser.add_argument("--regularisation", type=float, required=True)
    parser.add_argument("--rounds", type=int, required=True)
    given = parser.parse_args()
    features = np.load(f"{given.directory}/features.npy")
    queries = np.load(f"{given.directory}/queries.npy")
    (active, exchanges), build = measured(lambda: maxvol(features, given.tolerance), given.rounds)
    inverse = np.linalg.inv(features[active])
    _, score = measured(lambda: np.abs(queries @ inverse).max(axis=1), given.rounds)
    uncertainty, of_llpr = measured(
        lambda: llpr(features, given.structure, queries, given.regularisation), given.rounds
    )
    np.save(f"{given.directory}/llpr.npy", uncertainty)
    volume = float(np.linalg.slogdet(features[active])[1])
    print(json.dumps({"maxvol": build, "exchanges": exchanges, "score": score, "llpr": of_llpr, "log_volume": volume}))
