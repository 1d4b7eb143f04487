//! Several elements, one of which has no data.

use super::*;

#[test]
fn an_element_without_atoms_has_no_components() {
    let directory = tempfile::tempdir().unwrap();
    let here = directory.path();
    let all = read_extxyz(&config("data/ni_al_h_eam_1l/seed_frames.extxyz")).unwrap();
    let hydrogen: Vec<bool> =
        all.iter().map(|frame| frame.structure.species.iter().any(|s| s.symbol() == "H")).collect();
    let of = |wanted: bool| -> Vec<Frame> {
        let found = all.iter().zip(&hydrogen).filter(|(_, has)| **has == wanted);
        found.map(|(frame, _)| frame.clone()).take(60).collect()
    };
    write_frames(&here.join("metals.extxyz"), &of(false));
    write_frames(&here.join("data.extxyz"), &of(true)[..5]);
    let model = config("data/ni_al_h_eam_1l/kokkos.npz").display().to_string();
    let first =
        ["calm", "build", "--model", &model, "metals.extxyz", "--shard-size", "7", "--embed", "model.npz"];
    let printed = succeed(here, first.iter().chain(&["--output", "out.npz"]));
    let row = |symbol: &str| -> Vec<&str> {
        let mut rows = printed.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
        rows.find(|row| row.first() == Some(&symbol)).unwrap()
    };
    assert_eq!(row("H"), ["H", "0", "–", "–", "–", "–", "–", "–"]);
    assert!(row("Ni")[1].parse::<usize>().unwrap() > 100, "{printed}");

    let artifact = Artifact::load(here.join("out.npz")).unwrap();
    let element = |symbol: &str| artifact.symbols.iter().position(|other| other == symbol).unwrap();
    let components = |symbol: &str| artifact.mixture.components(element(symbol)).unwrap();
    let unknown = calm::Component::unknown_element(artifact.mixture.dimension());
    assert_eq!(components("H").iter().map(|one| (**one).clone()).collect::<Vec<_>>(), [unknown]);
    assert!(["Ni", "Al"].iter().all(|symbol| components(symbol)[0].statistics().unwrap().count > 0.0));

    // Every hydrogen atom is new, both to the artifact and to the export.
    let gamma = grades(here, &model, &["--artifact", "out.npz"]);
    assert_eq!(grades(here, "model.npz", &[]), gamma);
    let species = of(true)[..5].iter().flat_map(|frame| frame.structure.species.clone()).collect::<Vec<_>>();
    let of_hydrogen = species.iter().zip(&gamma).filter(|(species, _)| species.symbol() == "H");
    assert!(of_hydrogen.map(|(_, gamma)| *gamma).fold(f64::INFINITY, f64::min) > 100.0);
}
