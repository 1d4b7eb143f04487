//! The section of `[label]` of each kind of labels, and what only the user can give for it.

use std::collections::BTreeSet;
use std::path::Path;

use atoms::Species;
use dft::abinit::AbinitSettings;
use dft::ase::AseSettings;
use dft::cp2k::Cp2kSettings;
use dft::espresso::EspressoSettings;
use dft::gpaw::GpawSettings;
use dft::vasp::VaspSettings;

use super::label_kind::InitLabelKind;
use super::own_campaign::OwnCampaign;
use super::written_section::{WrittenKey, WrittenSection, list, path_value, quoted};
use crate::config::FILL_IN;
use crate::exit_status::CommandError;

/// Endings of files of potentials, and their names in a configuration.
const POTENTIALS: [(&str, &str); 4] =
    [(".npz", "grace"), (".eam.alloy", "eam_alloy"), (".eam.fs", "eam_fs"), (".sw", "stillinger_weber")];

const AS_TRAINED: &str = "as for the data that the model was trained on";

/// The section for the labels of a campaign from seed structures of these elements.
///
/// # Errors
/// A potential of unknown format, a path that is not UTF-8.
pub fn label_section(
    directory: &Path,
    campaign: &OwnCampaign,
    elements: &BTreeSet<Species>,
) -> Result<WrittenSection, CommandError> {
    let kind = campaign.label;
    let source = campaign.label_source.as_deref();
    let given = source.map(|path| path_value(directory, path)).transpose()?;
    let or_fill_in = || given.clone().unwrap_or_else(|| fill_in(kind.source()));
    let or_default = |default: &Path| match &given {
        None if default.is_dir() => quoted(&default.to_string_lossy()),
        _ => or_fill_in(),
    };
    let keys = match kind {
        InitLabelKind::Potential => {
            let method = potential_method(source, &or_fill_in())?;
            let comment = "kind: grace, eam_alloy, eam_fs, stillinger_weber".to_owned();
            return Ok(WrittenSection::new("[label]", vec![WrittenKey::new("method", method, comment)]));
        }
        InitLabelKind::Vasp => vasp_keys(or_fill_in(), elements),
        InitLabelKind::Abinit => {
            let defaults = AbinitSettings::default();
            let pseudopotentials = or_default(&defaults.pseudopotentials);
            program_keys(kind, &defaults.command, Some(pseudopotentials), defaults.cutoff, defaults.k_spacing)
        }
        InitLabelKind::Cp2k => {
            let defaults = Cp2kSettings::default();
            let pseudopotentials = or_default(&defaults.pseudopotentials);
            program_keys(kind, &defaults.command, Some(pseudopotentials), defaults.cutoff, defaults.k_spacing)
        }
        InitLabelKind::Espresso => {
            let defaults = EspressoSettings::default();
            let pseudopotentials = or_default(&defaults.pseudopotentials);
            program_keys(kind, &defaults.command, Some(pseudopotentials), defaults.cutoff, defaults.k_spacing)
        }
        InitLabelKind::Gpaw => {
            let defaults = GpawSettings::default();
            program_keys(kind, &defaults.command, given, defaults.cutoff, defaults.k_spacing)
        }
        InitLabelKind::Ase => vec![
            command_key(&AseSettings::default().command, "a Python with ASE"),
            WrittenKey::new("calculator", or_fill_in(), kind.source()),
        ],
        InitLabelKind::Command => command_keys(source, or_fill_in()),
    };
    Ok(WrittenSection::new(format!("[label.method.{}]", kind.name()), keys))
}

/// A value that the user must replace.
fn fill_in(expected: &str) -> String {
    quoted(&format!("{FILL_IN}{expected}"))
}

fn command_key(command: &[String], comment: &str) -> WrittenKey {
    WrittenKey::new("command", list(command.iter().map(|word| quoted(word))), comment)
}

/// The value of `method` for the potential in a file, whose name says its format.
fn potential_method(source: Option<&Path>, file: &str) -> Result<String, CommandError> {
    let name = source.map(|path| path.to_string_lossy().to_lowercase()).unwrap_or_default();
    let Some((_, kind)) = POTENTIALS.iter().find(|(ending, _)| name.ends_with(ending)) else {
        let endings = POTENTIALS.map(|(ending, _)| ending).join(", ");
        return Err(CommandError::Input(format!(
            "--label-source: {name} is no potential of a known format; expected a name ending in {endings}"
        )));
    };
    Ok(format!("{{ potential = {{ kind = \"{kind}\", file = {file} }} }}"))
}

fn vasp_keys(pseudopotentials: String, elements: &BTreeSet<Species>) -> Vec<WrittenKey> {
    let defaults = VaspSettings::default();
    let version = fill_in("the version of your VASP, such as 5.4.4");
    let elements = list(elements.iter().map(|species| quoted(species.symbol())));
    let mut keys = program_keys(
        InitLabelKind::Vasp,
        &defaults.command,
        Some(pseudopotentials),
        defaults.cutoff,
        defaults.k_spacing,
    );
    let more = [
        WrittenKey::new("version", version, "VASP does not report it before a calculation"),
        WrittenKey::new(
            "element_table",
            quoted("MPRelaxSet"),
            format!("POTCAR variants and initial moments; {AS_TRAINED}"),
        ),
        WrittenKey::new("elements", elements, "those that may occur"),
    ];
    keys.extend(more);
    keys
}

/// The keys of a DFT code.
fn program_keys(
    kind: InitLabelKind,
    command: &[String],
    pseudopotentials: Option<String>,
    cutoff: f64,
    k_spacing: f64,
) -> Vec<WrittenKey> {
    let key = |key: &str| format!("label.method.{}.{key}", kind.name());
    let mut keys = vec![command_key(command, "with its launcher: [\"mpirun\", \"-np\", \"16\", …]")];
    keys.extend(pseudopotentials.map(|path| WrittenKey::new("pseudopotentials", path, kind.source())));
    let comment =
        |unit: &str, name: &str| WrittenKey::with_range(&format!("{unit}; {AS_TRAINED}"), &key(name));
    keys.push(WrittenKey::new("cutoff", format!("{cutoff:?}"), comment("energy cutoff", "cutoff")));
    keys.push(WrittenKey::new("k_spacing", format!("{k_spacing:?}"), comment("2π included", "k_spacing")));
    keys
}

fn command_keys(source: Option<&Path>, file: String) -> Vec<WrittenKey> {
    let name = source.and_then(Path::file_name).map_or("label.py".into(), |name| name.to_string_lossy());
    let interpreter = if name.ends_with(".sh") { "sh" } else { "python3" };
    let command = [interpreter.to_owned(), name.into_owned()];
    let version = fill_in("what else identifies the labels, such as my-code 3.2");
    vec![
        command_key(&command, "reads structure.extxyz, writes label.extxyz (docs/dft-codes.md)"),
        WrittenKey::new("files", list([file]), "files that it needs, copied to each calculation"),
        WrittenKey::new("version", version, "part of the protocol, with the content of the files"),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_file_says_the_kind_of_potential() {
        let method = |name: &str| potential_method(Some(Path::new(name)), &quoted(name));
        for (name, kind) in [
            ("a/kokkos.npz", "grace"),
            ("Al.eam.fs", "eam_fs"),
            ("NiAlH.eam.alloy", "eam_alloy"),
            ("Si.SW", "stillinger_weber"),
        ] {
            let expected = format!("{{ potential = {{ kind = \"{kind}\", file = \"{name}\" }} }}");
            assert_eq!(method(name).unwrap(), expected);
        }
        let error = method("model.pt").unwrap_err().to_string();
        assert!(error.contains("model.pt") && error.contains(".eam.alloy"), "{error}");
    }
}
