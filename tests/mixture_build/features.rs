//! Features that are kept on disk between passes.

use super::*;

/// Names of the files with features in the state of a build.
fn files(state: &Path) -> Vec<String> {
    let entries = fs::read_dir(state).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned());
    let mut names: Vec<_> = names.filter(|name| name.contains("features-")).collect();
    names.sort();
    names
}

#[test]
fn stored_features_change_no_byte_also_if_they_are_damaged() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    write_frames(&here.join("data.extxyz"), &frames()[..12]);
    let (expected, _) = build(here, "none.npz", &["data.extxyz"], &["--max-feature-cache", "0"]);
    // All four shards of three structures, or two of them: each has 324 atoms with 130 numbers.
    for gigabytes in ["1", "0.0007"] {
        let more = ["--max-feature-cache", gigabytes, "--threads", "2"];
        assert!(build(here, "some.npz", &["data.extxyz"], &more).0 == expected, "{gigabytes} GB");
    }

    let part = |pass: &str, gigabytes: &str| {
        let more = ["--pass", pass, "--part", "1/1", "--max-feature-cache", gigabytes];
        succeed(here, arguments("parts.npz", &["data.extxyz"], &more))
    };
    let model = config(MODEL).display().to_string();
    let merge = || succeed(here, ["calm", "merge", "--model", &model, "--output", "parts.npz"]);
    let state = here.join("parts.npz.build");
    part("1", "0.0007");
    assert_eq!(files(&state), ["features-0", "features-1"]);
    merge();
    // Another number, and one that is none; then a file that is too short, and one of another shard.
    let damage = |name: &str, change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = fs::read(state.join(name)).unwrap();
        change(&mut bytes);
        fs::write(state.join(name), bytes).unwrap();
    };
    damage("features-0", &|bytes| bytes[1000] ^= 1);
    damage("features-1", &|bytes| bytes[2000..2008].copy_from_slice(&f64::NAN.to_le_bytes()));
    part("2", "1");
    assert_eq!(files(&state).len(), 4);
    merge();
    damage("features-2", &|bytes| bytes.truncate(5000));
    fs::copy(state.join("features-0"), state.join("features-3")).unwrap();
    part("3", "1");
    merge();
    assert!(fs::read(here.join("parts.npz")).unwrap() == expected);
    assert!(!state.exists());

    let refused = refuse(here, arguments("x.npz", &["data.extxyz"], &["--max-feature-cache", "lots"]));
    assert!(refused.contains("expected 0 to 1e6 GB"), "{refused}");
}

#[test]
fn each_part_has_a_limit_of_its_own() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    // Four shards, two of each part, of which each has 337 kB of features.
    write_frames(&here.join("data.extxyz"), &frames()[..12]);
    let state = here.join("out.npz.build");
    let part = |pass: &str, part: &str, gigabytes: &str| {
        let more = ["--pass", pass, "--part", part, "--max-feature-cache", gigabytes];
        succeed(here, arguments("out.npz", &["data.extxyz"], &more));
        files(&state)
    };
    let model = config(MODEL).display().to_string();
    let merge = || succeed(here, ["calm", "merge", "--model", &model, "--output", "out.npz"]);
    let all = ["features-0", "features-1", "features-2", "features-3"];
    assert_eq!(part("1", "1/2", "0.0007"), ["features-0", "features-2"]);
    // What another part has stored does not count.
    assert_eq!(part("1", "2/2", "0.0007"), all);
    merge();
    // As processes leave them that are killed while they write.
    for shard in [0, 1] {
        fs::write(state.join(format!(".features-{shard}.part")), [0; 1000]).unwrap();
    }
    // Each part removes its own.
    assert_eq!(part("2", "1/2", "0.0007"), [&[".features-1.part"], &all[..]].concat());
    assert_eq!(part("2", "2/2", "0.0007"), all);
    merge();
    let left = part("3", "1/2", "0.0004");
    assert!(
        left.len() == 3 && left.contains(&all[1].to_owned()) && left.contains(&all[3].to_owned()),
        "{left:?}"
    );
}
