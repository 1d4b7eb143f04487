//! Writes `INCAR` and `KPOINTS`.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::VaspSettings;
use crate::{RetryAdjustment, SetupError, Smearing};

/// Tags that are written here or would override those; users cannot set them.
const RESERVED_TAGS: [&str; 37] = [
    "ALGO",
    "AMIX",
    "AMIX_MAG",
    "BMIX",
    "BMIX_MAG",
    "EDIFF",
    "EDIFFG",
    "ENCUT",
    "IALGO",
    "IBRION",
    "ICHARG",
    "IMIX",
    "ISIF",
    "ISMEAR",
    "ISPIN",
    "ISTART",
    "KGAMMA",
    "KPAR",
    "KSPACING",
    "LCHARG",
    "LNONCOLLINEAR",
    "LORBIT",
    "LSORBIT",
    "LWAVE",
    "MAGMOM",
    "NCORE",
    "NELM",
    "NELMDL",
    "NELMIN",
    "NPAR",
    "NSW",
    "NWRITE",
    "PREC",
    "SIGMA",
    "SYSTEM",
    "LABORT",
    "LSTOP",
];

/// Checks the further tags in the settings.
pub(super) fn check(settings: &VaspSettings) -> Result<(), SetupError> {
    for (tag, value) in &settings.tags {
        let found = format!("{tag} = {value:?}");
        let wrong =
            |expected: &str| Err(SetupError::Setting { key: "tags", found, expected: expected.to_owned() });
        if tag.is_empty() || !tag.chars().all(|c| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_') {
            return wrong("a tag of INCAR in capital letters");
        }
        if RESERVED_TAGS.contains(&tag.as_str()) {
            return wrong("another tag: this one is written from the other settings");
        }
        if value.is_empty()
            || value.contains(|c: char| c.is_control() || matches!(c, ';' | '!' | '#' | '\\' | '"'))
        {
            return wrong("a value in one line, without remarks");
        }
    }
    Ok(())
}

/// `INCAR` for these initial moments, in the order of POSCAR.
pub(super) fn incar(
    settings: &VaspSettings,
    moments: &[f64],
    adjustments: &BTreeSet<RetryAdjustment>,
) -> String {
    let has = |adjustment| adjustments.contains(&adjustment);
    let mut lines = vec![
        ("PREC", "Accurate".to_owned()),
        ("ENCUT", format!("{:?}", settings.cutoff)),
        ("EDIFF", format!("{:?}", settings.energy_tolerance)),
        ("ISMEAR", ismear(settings.smearing).to_string()),
        ("SIGMA", format!("{:?}", settings.smearing_width)),
        ("ISTART", "0".to_owned()),
        ("ICHARG", "2".to_owned()),
        ("IBRION", "-1".to_owned()),
        ("NSW", "0".to_owned()),
        ("ISIF", "2".to_owned()),
        ("LWAVE", ".FALSE.".to_owned()),
        ("LCHARG", ".FALSE.".to_owned()),
        (
            "NELM",
            (settings.max_scf_steps.saturating_mul(if has(RetryAdjustment::MoreSteps) { 3 } else { 1 }))
                .to_string(),
        ),
        ("ALGO", if has(RetryAdjustment::OtherAlgorithm) { "All" } else { "Normal" }.to_owned()),
        ("ISPIN", if settings.spin_polarized { "2" } else { "1" }.to_owned()),
    ];
    if settings.spin_polarized {
        lines.push(("MAGMOM", runs(moments)));
        lines.push(("LORBIT", "10".to_owned()));
    }
    if has(RetryAdjustment::SlowerMixing) {
        lines.extend([("AMIX", "0.1".to_owned()), ("BMIX", "0.0001".to_owned())]);
        if settings.spin_polarized {
            lines.extend([("AMIX_MAG", "0.4".to_owned()), ("BMIX_MAG", "0.0001".to_owned())]);
        }
    }
    // Each group of processes with its own k-points holds a copy of all data not distributed by k-points.
    let kpar = if has(RetryAdjustment::MoreMemory) { 1 } else { settings.kpar };
    lines.extend([("KPAR", kpar.to_string()), ("NCORE", settings.ncore.to_string())]);
    let further = settings.tags.iter().map(|(tag, value)| (tag.as_str(), value.clone()));
    lines.into_iter().chain(further).fold(String::new(), |mut text, (tag, value)| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{tag} = {value}");
        text
    })
}

fn ismear(smearing: Smearing) -> i32 {
    match smearing {
        Smearing::Gaussian => 0,
        Smearing::MethfesselPaxton => 1,
        Smearing::FermiDirac => -1,
    }
}

/// Run-length encoding, because lines of INCAR are short: `8*1.0 4*5.0`.
fn runs(moments: &[f64]) -> String {
    let run = |run: &[f64]| format!("{}*{:?}", run.len(), run[0]);
    moments.chunk_by(|a, b| a == b).map(run).collect::<Vec<_>>().join(" ")
}

/// `KPOINTS`: the Γ-centred mesh.
pub(super) fn kpoints([a, b, c]: [u32; 3], spacing: f64) -> String {
    format!("at most {spacing} 1/A apart, with 2 pi\n0\nGamma\n{a} {b} {c}\n0 0 0\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(moments: &[f64], adjustments: &[RetryAdjustment]) -> BTreeSet<String> {
        let settings = VaspSettings { kpar: 4, ..VaspSettings::default() };
        incar(&settings, moments, &adjustments.iter().copied().collect()).lines().map(str::to_owned).collect()
    }

    #[test]
    fn the_papers_protocol_is_the_default() {
        let lines = lines(&[1.0, 1.0, 5.0], &[]);
        for line in [
            "PREC = Accurate",
            "ENCUT = 500.0",
            "EDIFF = 1e-6",
            "ISMEAR = 0",
            "SIGMA = 0.1",
            "ISPIN = 2",
            "MAGMOM = 2*1.0 1*5.0",
            "NSW = 0",
            "IBRION = -1",
            "LWAVE = .FALSE.",
            "LCHARG = .FALSE.",
            "NELM = 100",
            "ALGO = Normal",
            "KPAR = 4",
        ] {
            assert!(lines.contains(line), "{line} is not in {lines:?}");
        }
        assert!(!lines.iter().any(|line| line.starts_with("LDAU") || line.starts_with("AMIX")));
    }

    #[test]
    fn no_adjustment_touches_accuracy() {
        let (plain, adjusted) = (lines(&[1.0], &[]), lines(&[1.0], &RetryAdjustment::ALL));
        let changed: BTreeSet<&str> =
            plain.symmetric_difference(&adjusted).map(|line| line.split(" = ").next().unwrap()).collect();
        let free = ["NELM", "ALGO", "AMIX", "BMIX", "AMIX_MAG", "BMIX_MAG", "KPAR"];
        assert_eq!(changed, BTreeSet::from(free));
        assert!(
            adjusted.is_superset(
                &["NELM = 300", "ALGO = All", "AMIX = 0.1", "KPAR = 1"].map(str::to_owned).into()
            )
        );
    }

    #[test]
    fn further_tags_cannot_undo_the_protocol() {
        let fault = |tag: &str, value: &str| {
            let tags = [(tag.to_owned(), value.to_owned())].into();
            check(&VaspSettings { tags, ..VaspSettings::default() })
        };
        assert_eq!(fault("LASPH", ".TRUE."), Ok(()));
        for (tag, value) in [
            ("ENCUT", "200"),
            ("encut", "200"),
            ("", "1"),
            ("IVDW", "12\nENCUT = 200"),
            ("IVDW", "12; ENCUT = 9"),
        ] {
            assert!(fault(tag, value).is_err(), "{tag} = {value}");
        }
    }
}
