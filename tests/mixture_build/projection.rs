//! Models as exported after training, without a projection of their features.

use serde_json::Value;

use super::*;
use crate::common::campaign::{Small, outcome};

/// Name, type and rank of each array, by name.
fn kinds(path: &Path) -> Vec<(String, String, usize)> {
    let kind = |(name, bytes): (String, Vec<u8>)| {
        let array = npyz::NpyFile::new(&bytes[..]).unwrap();
        (name, array.dtype().descr(), array.shape().len())
    };
    arrays(path).into_iter().map(kind).collect()
}

#[test]
fn a_model_without_a_projection_is_built_graded_and_embedded() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_plain_model(here, MODEL);
    write_frames(&here.join("data.extxyz"), &frames()[..20]);
    let arguments = |output: &str, more: &[&str]| -> Vec<String> {
        let first = ["calm", "build", "--model", "plain.npz", "data.extxyz", "--shard-size", "3"];
        first.iter().chain(&["--output", output]).chain(more).map(|text| (*text).to_owned()).collect()
    };
    let printed = succeed(here, arguments("out.npz", &["--embed", "model.npz"]));
    let whole = fs::read(here.join("out.npz")).unwrap();
    let gamma = grades(here, "plain.npz", &["--artifact", "out.npz"]);
    let above = gamma.iter().filter(|gamma| **gamma > 1.0).count() as f64 / gamma.len() as f64;
    let row: Vec<&str> = printed.lines().nth(1).unwrap().split_whitespace().collect();
    let shown: f64 = row[row.len() - 2].parse().unwrap();
    assert!(shown < 20.0 && (shown / 100.0 - above).abs() < 5e-4, "{shown} % {above}");

    // The embedded model has the keys of gracemaker's export, with their types and ranks, so it can grade and build.
    assert_eq!(kinds(&here.join("model.npz")), kinds(&config(MODEL)));
    assert_eq!(grades(here, "model.npz", &[]), gamma);
    let again = [
        "calm",
        "build",
        "--model",
        "model.npz",
        "data.extxyz",
        "--shard-size",
        "3",
        "--output",
        "again.npz",
    ];
    succeed(here, again);
    assert!(fs::read(here.join("again.npz")).unwrap() == whole);

    // A build in parts has the same projection.
    for pass in ["1", "2", "3"] {
        for part in ["1/2", "2/2"] {
            succeed(here, arguments("parts.npz", &["--pass", pass, "--part", part]));
        }
        succeed(here, ["calm", "merge", "--model", "plain.npz", "--output", "parts.npz"]);
    }
    assert!(fs::read(here.join("parts.npz")).unwrap() == whole);

    let other =
        [&["--projection-dimension", "16", "--candidates", "1,2,4"][..], &["--rng-seed", "3"]].concat();
    succeed(here, arguments("small.npz", &other));
    let info: Value = serde_json::from_str(&succeed(here, ["calm", "info", "--json", "small.npz"])).unwrap();
    assert_eq!((&info["projected_dimension"], &info["feature_dimension"]), (&16.into(), &18.into()));
    succeed(here, ["calm", "compare", "--model", "plain.npz", "out.npz", "out.npz", "data.extxyz"]);
    let message =
        refuse(here, ["calm", "compare", "--model", "plain.npz", "out.npz", "small.npz", "data.extxyz"]);
    assert!(message.contains("small.npz") && message.contains("its feature dimension is 18"), "{message}");

    let message = refuse(here, ["calm", "score", "--model", "plain.npz", "data.extxyz", "--output", "x.xyz"]);
    assert!(
        message.contains(
            "plain.npz: the model has no projection of its features (uq_rp_matrix): give its artifact"
        ),
        "{message}"
    );
    let silicon = config("data/si_sw_1l/gmm_artifacts.npz").display().to_string();
    let wrong =
        ["calm", "score", "--model", "plain.npz", "--artifact", &silicon, "data.extxyz", "--output", "x.xyz"];
    let message = refuse(here, wrong);
    assert!(message.contains("its list of elements is Si, the model's is Al"), "{message}");
    let own = config(MODEL).display().to_string();
    let message = refuse(
        here,
        ["calm", "build", "--model", &own, "data.extxyz", "--output", "x.npz", "--projection-dimension", "9"],
    );
    assert!(
        message.contains("has a projection with 128 features; expected a model without one"),
        "{message}"
    );
}

#[test]
fn a_campaign_takes_the_projection_of_its_artifact() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_plain_model(here, MODEL);
    let (model, artifact) = (config(MODEL), config("data/al_eam_1l/gmm_artifacts.npz"));
    let outcomes = [model.as_path(), Path::new("../plain.npz")].map(|path| {
        let campaign = here.join(if path == model { "own" } else { "artifact" });
        fs::create_dir(&campaign).unwrap();
        let text = fs::read_to_string(Small::default().write(&campaign)).unwrap();
        let text = text.replace(model.to_str().unwrap(), path.to_str().unwrap());
        fs::write(campaign.join("campaign.toml"), &text).unwrap();
        succeed(&campaign, ["run", "campaign.toml"]);
        if path != model {
            let without =
                text.replace(&format!("artifact = \"{}\"\n", artifact.display()), "update = \"never\"\n");
            fs::write(campaign.join("without.toml"), without).unwrap();
            let message = refuse(&campaign, ["validate", "without.toml"]);
            assert!(
                message.contains("no feature projection (uq_* arrays)")
                    && message.contains("set calm.artifact"),
                "{message}"
            );
        }
        outcome(&campaign.join("campaign"))
    });
    assert_eq!(outcomes[0].components, outcomes[1].components);
    assert_eq!(outcomes[0].walks, outcomes[1].walks);
}
