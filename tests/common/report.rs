//! Checks the report of a fully labelled campaign.

use std::fs;
use std::path::Path;

use serde_json::Value;

use super::succeed;

/// Writes the report of the campaign in `campaign` twice, and compares it with the output of other commands.
pub fn check(here: &Path, campaign: &str, status: &Value, errors: &Value) {
    let said = succeed(here, ["report", campaign, "-o", "one/report"]);
    assert!(said.starts_with("wrote one/report/report.html and "), "{said}");
    succeed(here, ["store", "backup", campaign, "copy-for-report"]);
    succeed(here, ["report", "copy-for-report", "-o", "two"]);
    let read = |path: &str| fs::read(here.join("one/report").join(path)).expect("a file of the report");
    let text = |path: &str| String::from_utf8(read(path)).expect("text");
    let mut files = 0;
    for folder in ["", "figures", "tables"] {
        for entry in fs::read_dir(here.join("one/report").join(folder)).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_file() {
                files += 1;
                let name = path.strip_prefix(here.join("one/report")).expect("inside");
                let again = fs::read(here.join("two").join(name)).expect("the same file");
                assert!(fs::read(&path).expect("a file") == again, "{} differs", name.display());
            }
        }
    }
    assert!(files > 25, "{files} files");

    let page = text("report.html");
    for name in [
        "collection",
        "distributions",
        "errors",
        "space",
        "features",
        "parity",
        "grades",
        "completion",
        "cost",
    ] {
        assert!(page.contains(&format!("<figure id=\"figure-{name}\">")), "no figure {name}");
        assert!(read(&format!("figures/{name}.png")).starts_with(b"\x89PNG"));
    }
    assert!(!page.contains("https://") && !page.contains("<script") && !page.contains("<link"));

    // Compare with `errors`.
    let compared = &errors["biased_against_control"];
    if compared["pairs"]["counts"]["pairs"].as_u64() > Some(0) {
        let medians = text("tables/pairs.csv");
        let row = medians.lines().nth(1).expect("a row").split(',').collect::<Vec<_>>();
        assert_eq!(
            row[3].parse().ok(),
            compared["pairs"]["force_mae"]["biased"]["value"].as_f64(),
            "{medians}"
        );
        assert!(page.contains("<figure id=\"figure-pairs\">"));
    }
    let groups = text("tables/comparison.csv");
    let pooled = groups.lines().find(|line| line.starts_with("pooled all,")).expect("a row");
    assert_eq!(
        pooled.split(',').nth(1).and_then(|n| n.parse().ok()),
        compared["pooled"]["all"]["structures"].as_u64()
    );
    let quantiles = text("tables/quantiles-gamma.csv");
    let bins = errors["all"]["gamma"]["bins"].as_array().expect("bins");
    assert_eq!(quantiles.lines().count(), bins.len() + 1);
    for (row, bin) in quantiles.lines().skip(1).zip(bins) {
        let cells: Vec<_> = row.split(',').collect();
        assert_eq!(cells[1].parse().ok(), bin["atoms"].as_u64(), "{row}");
        assert_eq!(cells[3].parse().ok(), bin["median"].as_f64(), "{row}");
        assert_eq!(cells[7].parse().ok(), bin["atoms_without_label"].as_u64(), "{row}");
    }
    let correlations = text("tables/correlations.csv");
    let all: Vec<_> = correlations.lines().nth(1).expect("a row").split(',').collect();
    assert_eq!(all[2].parse().ok(), errors["all"]["atoms"].as_u64());
    assert_eq!(all[7].parse().ok(), errors["all"]["gamma_nbr"]["spearman"].as_f64());
    assert_eq!(all[8].parse().ok(), errors["all"]["gamma"]["roc_auc"].as_f64());

    // Compare with `status`.
    let collection = text("figures/collection.csv");
    for fate in ["covered", "duplicate", "too_close", "budget", "backlog"] {
        let number = &status["candidates"]["declined"][fate];
        assert!(
            collection.contains(&format!("a,{},{number},", fate.replace('_', " "))),
            "{fate}: {collection}"
        );
    }
    let (seen, accepted) = (&status["candidates"]["seen"], &status["candidates"]["accepted"]);
    assert!(collection.contains(&format!("a,accepted,{accepted},")));
    assert!(collection.trim_end().ends_with(&format!("b,,{seen},{accepted}")), "{collection}");
    let unlabelled = text("tables/unlabelled.csv");
    let parts = status["unlabelled"].as_array().expect("parts");
    assert_eq!(unlabelled.lines().count(), parts.len() + 1, "{unlabelled}");
    assert_eq!(page.contains("without a label because all attempts failed"), !parts.is_empty());
    for (row, part) in unlabelled.lines().skip(1).zip(parts) {
        let cells: Vec<_> = row.split(',').collect();
        assert_eq!(
            (cells[2].parse().ok(), cells[3].parse().ok()),
            (part["failed"].as_u64(), part["labelled"].as_u64())
        );
        assert_eq!(cells[5].parse().ok(), part["gamma"]["high"].as_f64(), "{row}");
    }
}
