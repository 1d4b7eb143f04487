"""Times pass 1 as gracemaker's builder does it, with scikit-learn: python kmeans.py features.f64 D BATCH K K …

The file has the features of one element, `[atoms × D]` float64. For every line of its input, one MiniBatchKMeans for each number
of clusters K takes all atoms in batches by `partial_fit` (batch_size max(10 K, 1024), as in gracemaker), and a line "seconds S"
of processor time is printed. One thread.
"""

import os
import sys
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np
from sklearn.cluster import MiniBatchKMeans


def main():
    dimension, batch, *candidates = map(int, sys.argv[2:])
    features = np.fromfile(sys.argv[1]).reshape(-1, dimension)
    for _ in sys.stdin:
        start = time.process_time()
        for clusters in candidates:
            model = MiniBatchKMeans(clusters, random_state=42, batch_size=max(10 * clusters, 1024))
            inertia = 0.0
            for first in range(0, len(features), batch):
                model.partial_fit(features[first : first + batch])
                inertia += model.inertia_
        print("seconds", time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
