"""Statistics of scores and errors by scipy and scikit-learn, for the tests of the package `analysis`.

    python labelled_errors.py

writes `labelled_errors.json` beside itself. Needs numpy, scipy and scikit-learn. Scores and errors have ties; the
multiplicities are those of one resampling of the units.
"""

import json
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr
from sklearn.metrics import mean_absolute_error, precision_recall_fscore_support, roc_auc_score

random = np.random.default_rng(20251125)
ATOMS, UNITS = 240, 20
THRESHOLDS = [0.05, 0.2, 0.5, 1.0, 2.0]
LIMIT = 1.0

units = np.sort(random.integers(0, UNITS, ATOMS))
scores = np.round(np.exp(random.normal(-0.2, 0.6, ATOMS)), 1)
errors = np.round(0.4 * scores * np.exp(random.normal(0.0, 0.9, ATOMS)), 2)
elements = random.integers(0, 3, ATOMS)
multiplicities = np.bincount(random.integers(0, UNITS, UNITS), minlength=UNITS)
weights = multiplicities[units]
repeated = np.repeat(np.arange(ATOMS), weights)


def worst_decile(element):
    """The atoms of an element with errors above their 90 % quantile, told by the score."""
    of = elements == element
    threshold = np.quantile(errors[of], 0.9)
    return {"threshold": threshold, "auc": roc_auc_score(errors[of] > threshold, scores[of])}


# Filtering: energies above the hull, stable at most 0.
grades = np.round(np.exp(random.normal(-0.4, 0.5, 300)), 2)
true = np.round(random.normal(0.05, 0.1, 300), 2)
predicted = np.round(true + 0.05 * grades * random.normal(0.0, 1.0, 300), 2)


def filtered(threshold):
    kept = grades <= threshold
    precision, recall, f1, _ = precision_recall_fscore_support(
        true[kept] <= 0, predicted[kept] <= 0, average="binary")
    return {"threshold": threshold, "kept": int(kept.sum()), "mean_error": mean_absolute_error(true[kept], predicted[kept]),
            "precision": precision, "recall": recall, "f1": f1}


kept = scores <= LIMIT
golden = {
    "units": units.tolist(), "scores": scores.tolist(), "errors": errors.tolist(), "elements": elements.tolist(),
    "multiplicities": multiplicities.tolist(), "thresholds": THRESHOLDS,
    "spearman": spearmanr(scores, errors).statistic,
    "auc": [roc_auc_score(errors > t, scores) for t in THRESHOLDS],
    "resampled_spearman": spearmanr(scores[repeated], errors[repeated]).statistic,
    "resampled_auc": [roc_auc_score(errors > t, scores, sample_weight=weights) for t in THRESHOLDS],
    "worst_decile": [worst_decile(element) for element in range(3)],
    "limit": LIMIT, "retention": np.mean(kept),
    "contamination": [np.mean(errors[kept] > t) for t in THRESHOLDS],
    "interval_90": np.percentile(errors, [5, 95]).tolist(),
    "grades": grades.tolist(), "true": true.tolist(), "predicted": predicted.tolist(),
    "filtered": [filtered(t) for t in (0.4, 0.7, 1.0, 10.0)],
}
path = Path(__file__).with_suffix(".json")
path.write_text(json.dumps(golden) + "\n")
