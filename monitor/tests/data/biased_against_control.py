"""A recorded campaign, and its comparison of biased walks with their controls by numpy, scipy and scikit-learn.

    python biased_against_control.py CAMPAIGN

writes `biased_against_control.json` beside itself, for the test of `monitor::label_statistics::comparison`. CAMPAIGN is one in
aluminium, labelled by an EAM potential; without it, the numbers of the last recording are compared again. Needs calmwalk (this
repository's python/), numpy, scipy and scikit-learn.
"""

import json
import sys
from pathlib import Path

import numpy as np
from scipy.stats import binomtest, spearmanr, wilcoxon
from sklearn.metrics import roc_auc_score

HERE = Path(__file__).parent
FILE = HERE / "biased_against_control.json"
THRESHOLDS = [0.03, 0.1, 0.3]


def recorded(location):
    """What the comparison needs of each labelled structure. Numbers have six decimals."""
    sys.path.insert(0, str(HERE.parents[2] / "python"))
    import calmwalk

    def decimals(values):
        return [round(float(value), 6) for value in values]

    with calmwalk.open(location) as campaign:
        partners = {walk.walk: walk.partner for walk in campaign.walks()}
        contents = {}
        frames = []
        for candidate in campaign.candidates(labelled=True):
            partner = partners[candidate.walk]
            difference = candidate.forces - candidate.label.forces
            key = candidate.structure.positions.tobytes() + candidate.structure.cell.tobytes()
            stress = -candidate.virial / abs(np.linalg.det(candidate.structure.cell)) - candidate.label.stress
            components = 0.5 * (stress + stress.T)[np.tril_indices(3)]
            stress = (
                round(float(np.sqrt((components**2).mean())), 9) if all(candidate.structure.pbc) else None
            )
            frames.append(
                {
                    "content": contents.setdefault(key, len(contents)),
                    "origin": candidate.origin,
                    "seed_structure": candidate.seed_structure,
                    "walk": candidate.walk if partner is None else partner,
                    "step": candidate.step,
                    "force_mae": round(float(np.abs(difference).mean()), 6),
                    "stress": stress,
                    "gamma": decimals(candidate.original_gamma),
                    "gamma_nbr": decimals(candidate.original_gamma_nbr),
                    "errors": decimals(np.linalg.norm(difference, axis=1)),
                }
            )
    return frames


def known_median(frames, key):
    return np.median([frame[key] for frame in frames if frame[key] is not None])


def tests(values):
    """Two-sided tests of differences."""
    method = "exact" if len(set(abs(values))) == len(values) else "asymptotic"
    return {
        "biased_larger": int((values > 0).sum()),
        "wilcoxon_p": wilcoxon(values, method=method).pvalue,
        "sign_p": binomtest(int((values > 0).sum()), int((values != 0).sum())).pvalue,
    }


def group(frames):
    def joined(key):
        return np.concatenate([frame[key] for frame in frames])

    def ranking(grades):
        areas = [roc_auc_score(errors > threshold, grades) for threshold in THRESHOLDS]
        return {"spearman": spearmanr(grades, errors).statistic, "roc_auc": areas}

    errors = joined("errors")
    return {
        "structures": len(frames),
        "median_force_mae": known_median(frames, "force_mae"),
        "median_stress": known_median(frames, "stress"),
        "median_error": np.median(errors),
        "gamma": ranking(joined("gamma")),
        "gamma_nbr": ranking(joined("gamma_nbr")),
    }


def paired(pairs, key):
    """Medians and two-sided tests of differences, of all pairs and of the median of each seed structure."""
    pairs = [pair for pair in pairs if all(side[key] is not None for side in pair)]
    biased, control = np.array([[side[key] for side in pair] for pair in pairs]).T
    units = np.array([side["seed_structure"] for side, _ in pairs])
    difference = biased - control
    of_units = np.array([np.median(difference[units == unit]) for unit in np.unique(units)])
    return {
        "biased": np.median(biased),
        "control": np.median(control),
        "pairs": len(pairs),
        "median_difference": np.median(difference),
        "tests": tests(difference),
        "tests_by_unit": tests(of_units),
    }


frames = recorded(sys.argv[1]) if len(sys.argv) > 1 else json.loads(FILE.read_text())["frames"]
of_origin = {
    origin: [frame for frame in frames if frame["origin"] == origin] for origin in ("biased", "control")
}
control = {(frame["walk"], frame["step"]): frame for frame in of_origin["control"]}
matched = [(frame, control.get((frame["walk"], frame["step"]))) for frame in of_origin["biased"]]
pairs = [(biased, other) for biased, other in matched if other and biased["content"] != other["content"]]
contents = {origin: {frame["content"] for frame in of_origin[origin]} for origin in of_origin}
once = of_origin["biased"] + [of for of in of_origin["control"] if of["content"] not in contents["biased"]]
expected = {
    "pairs": len(pairs),
    "seed_structures": len({biased["seed_structure"] for biased, _ in pairs}),
    "force_mae": paired(pairs, "force_mae"),
    "stress": paired(pairs, "stress"),
    "matched": {"biased": group([of for of, _ in pairs]), "control": group([of for _, of in pairs])},
    "pooled": {"all": group(once)},
}
text = json.dumps({"thresholds": THRESHOLDS, "expected": expected, "frames": frames})
text = text.replace('}, {"content"', '},\n{"content"').replace('"frames": [', '"frames": [\n')
FILE.write_text(text + "\n")
