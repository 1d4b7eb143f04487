//! The statistics as JSON.

use analysis::{CompletionBin, ErrorBin};
use serde_json::{Value, json};
use store::Protocol;

use super::{ErrorsByGrade, LARGE_FORCE_ERROR, LabelStatistics};

/// See [`LabelStatistics::to_json`].
pub(super) fn to_json(protocol: &Protocol, statistics: &LabelStatistics) -> Value {
    let mut json = json!({
        "protocol": protocol.name,
        "protocol_hash": protocol.hash.to_string(),
        "large": LARGE_FORCE_ERROR,
        "all": grades_as_json(&statistics.all),
        "biased": grades_as_json(&statistics.biased),
        "control": grades_as_json(&statistics.control),
        "energy": statistics.energies.summary(),
        "shared_structures": statistics.shared,
        "completion_by_gamma": completion_as_json(&statistics.by_gamma.bins()),
        "completion_by_relative_volume": completion_as_json(&statistics.by_expansion.bins()),
    });
    if let Some(version) = statistics.version {
        json["version"] = version.into();
        json["by_version"] = statistics.by_version.iter().map(version_as_json).collect();
    }
    json
}

fn version_as_json((version, grades): (&u32, &ErrorsByGrade)) -> Value {
    let one = |errors: &analysis::ForceErrors| {
        let (spearman, roc_auc) = (errors.spearman(), errors.roc_auc());
        json!({ "spearman": spearman, "roc_auc": roc_auc, "sampled_atoms": errors.sampled() })
    };
    json!({
        "version": version, "structures": grades.structures, "atoms": grades.gamma.atoms(),
        "mean_error": grades.gamma.mean(), "median_error": grades.gamma.median(), "gamma": one(&grades.gamma),
        "gamma_nbr": one(&grades.gamma_nbr),
    })
}

fn grades_as_json(grades: &ErrorsByGrade) -> Value {
    let one = |errors: &analysis::ForceErrors| {
        json!({
            "spearman": errors.spearman(), "roc_auc": errors.roc_auc(), "left_out": errors.left_out(),
            "sampled_atoms": errors.sampled(), "share_above_one": errors.fraction_above(1.0),
            "bins": errors.bins().iter().map(bin_as_json).collect::<Vec<_>>(),
        })
    };
    json!({
        "structures": grades.structures, "atoms": grades.gamma.atoms(), "mean_error": grades.gamma.mean(),
        "gamma": one(&grades.gamma), "gamma_nbr": one(&grades.gamma_nbr),
    })
}

fn bin_as_json(bin: &ErrorBin) -> Value {
    let ErrorBin { above, up_to, atoms, share, unlabelled, median, p90, p99, large, large_between } = bin;
    json!({
        "above": above, "up_to": up_to, "atoms": atoms, "share": share, "median": median, "p90": p90, "p99": p99,
        "share_large": large, "atoms_without_label": unlabelled, "share_large_between": large_between,
    })
}

fn completion_as_json(bins: &[CompletionBin<String>]) -> Value {
    let one = |bin: &CompletionBin<String>| {
        json!({
            "above": bin.above, "up_to": bin.up_to, "labelled": bin.labelled, "failed": bin.failed,
            "share": bin.share, "share_between": bin.interval,
        })
    };
    bins.iter().map(one).collect()
}
