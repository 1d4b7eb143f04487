//! Aliases of arrays in GRACE-2L files.
//!
//! An export calls the invariants of the first layer `rho` and those of the second `I2`, with the norms
//! `I_nl_LN` and `I_0_LN`, and also holds the same arrays under the names that the author of the model chose.

use npz::NpzFile;

use super::error::{GraceError, unsupported};

/// The author's names of the invariants of the first and second layer.
pub(super) struct BlockAliases([String; 2]);

/// The exporter's names.
const EXPORTED: [&str; 2] = ["rho", "I2"];

/// The exporter's names of their norms.
const NORMS: [&str; 2] = ["I_nl_LN", "I_0_LN"];

impl BlockAliases {
    /// Reads the list of reductions and matches the two names.
    pub fn read(archive: &NpzFile) -> Result<Self, GraceError> {
        let names = archive.strings("reduce_names")?;
        let sources = |name: &str| archive.strings(&format!("{name}_instruction_names"));
        let mut found: [Option<String>; 2] = [None, None];
        for name in names.iter().filter(|name| !["I1", "I", "B"].contains(&name.as_str())) {
            for (found, exported) in found.iter_mut().zip(EXPORTED) {
                if sources(name)? == sources(exported)? {
                    *found = Some(name.clone());
                }
            }
        }
        match (names.len(), found) {
            (5, [Some(first), Some(second)]) => Ok(Self([first, second])),
            _ => Err(unsupported(
                archive,
                format!(
                    "'reduce_names' lists {}, expected I1, I, B and the invariants of each layer",
                    names.join(", ")
                ),
            )),
        }
    }

    /// The layers in the alphabetical order of their invariants' names, which is the order of the basis.
    pub fn order(&self) -> Vec<usize> {
        let mut order = vec![0, 1];
        order.sort_by_key(|layer| &self.0[*layer]);
        order
    }
}

/// Ignores arrays that duplicate one that was read; rejects the file if they differ. Returns the name of each with that of
/// the other.
pub(super) fn ignore_aliases(
    archive: &NpzFile,
    names: &BlockAliases,
) -> Result<Vec<(String, String)>, GraceError> {
    let mut aliases = Vec::new();
    let left_over: Vec<String> = archive.unread().into_iter().map(str::to_owned).collect();
    for key in left_over {
        let of_norm = ["_scale", "_lin_scale", "_type", "_n_out"]
            .iter()
            .filter(|suffix| key.ends_with(&format!("_LN{suffix}")))
            .flat_map(|suffix| NORMS.map(|norm| format!("{norm}{suffix}")));
        let of_reduction = names.0.iter().zip(EXPORTED).filter_map(|(name, exported)| {
            key.strip_prefix(name.as_str()).map(|rest| format!("{exported}{rest}"))
        });
        let originals: Vec<String> =
            of_norm.chain(of_reduction).filter(|original| archive.contains(original)).collect();
        match originals.iter().find(|original| same(archive, &key, original)) {
            Some(original) => aliases.push((key, original.clone())),
            None if originals.is_empty() => {}
            None => {
                let reason = format!("array '{key}' differs from {}", originals.join(" or "));
                return Err(unsupported(archive, reason));
            }
        }
    }
    Ok(aliases)
}

/// Whether both arrays are equal.
fn same(archive: &NpzFile, one: &str, other: &str) -> bool {
    let numbers = |key: &str| archive.numbers(key).map(|array| (array.shape, array.data));
    match (numbers(one), numbers(other)) {
        (Ok(one), Ok(other)) => one == other,
        _ => matches!((archive.strings(one), archive.strings(other)), (Ok(one), Ok(other)) if one == other),
    }
}
