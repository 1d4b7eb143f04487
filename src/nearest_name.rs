//! The known name that a misspelt one stands for.

/// Least similarity (Jaro–Winkler) of a name that is suggested.
const MIN_SIMILARITY: f64 = 0.7;

/// Names of keys in other programs, and our names for them.
const SYNONYMS: [(&str, &str); 22] = [
    ("ecut", "cutoff"),
    ("encut", "cutoff"),
    ("ecutwfc", "cutoff"),
    ("e_cut", "cutoff"),
    ("cut_off_energy", "cutoff"),
    ("ecutrho", "fine_cutoff"),
    ("pawecutdg", "fine_cutoff"),
    ("rel_cutoff", "relative_cutoff"),
    ("kspacing", "k_spacing"),
    ("kpts", "k_spacing"),
    ("kpoints", "k_spacing"),
    ("k_points", "k_spacing"),
    ("sigma", "smearing_width"),
    ("degauss", "smearing_width"),
    ("dt", "time_step"),
    ("timestep", "time_step"),
    ("temp", "temperature"),
    ("nsteps", "biased_steps"),
    ("seed", "rng_seed"),
    ("gamma", "friction"),
    ("nelm", "max_scf_steps"),
    ("ncores", "cores"),
];

/// The most similar of `names`: the one that other programs call `found`, or one spelt similarly; `None` if none is similar.
pub fn nearest<'a>(found: &str, names: impl Iterator<Item = &'a str> + Clone) -> Option<&'a str> {
    let lower = found.to_ascii_lowercase();
    let synonym = SYNONYMS.iter().find(|(other, _)| *other == lower);
    if let Some(name) = synonym.and_then(|(_, name)| names.clone().find(|known| known == name)) {
        return Some(name);
    }
    // The second measure counts common pairs of letters: it prefers names that contain `found` as a whole.
    let similarity = |name: &str| strsim::jaro_winkler(&lower, name) + strsim::sorensen_dice(&lower, name);
    let near = names.filter(|name| strsim::jaro_winkler(&lower, name) > MIN_SIMILARITY);
    near.max_by(|a, b| similarity(a).total_cmp(&similarity(b)))
}
