//! What to say of a name that is not known.

use serde::de::DeserializeOwned;

/// Names below this likeness are other names.
const LIKE: f64 = 0.7;

/// What other programs call a key, and what it is called here.
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

/// The keys of the tables of a file.
pub struct KnownKeys(Vec<(&'static str, Vec<String>)>);

impl KnownKeys {
    /// Of no table.
    pub fn new() -> Self {
        Self(Vec::new())
    }

    /// With the keys of a type that denies unknown ones, which says itself what they are.
    pub fn with<T: DeserializeOwned>(mut self, table: &'static str) -> Self {
        let keys = match toml::from_str::<T>("'?' = 0") {
            Err(error) => names(error.message()).skip(1).map(str::to_owned).collect(),
            Ok(_) => Vec::new(),
        };
        self.0.push((table, keys));
        self
    }

    /// The tables that have this key, but for one.
    fn tables_with(&self, key: &str, but: &str) -> Vec<String> {
        let with =
            self.0.iter().filter(|(table, keys)| *table != but && keys.iter().any(|known| known == key));
        with.map(|(table, _)| format!("[{table}]")).collect()
    }
}

/// A name that is not known, among those that are: the parts of "unknown key `x`, expected one of `a`, `b`".
pub struct Unknown<'a> {
    found: &'a str,
    known: Vec<&'a str>,
    is_key: bool,
}

/// What to do about it.
pub struct Hint {
    /// To be put behind the message; empty where nothing is near.
    pub words: String,
    /// The key that was meant.
    pub instead: Option<String>,
}

impl<'a> Unknown<'a> {
    /// Of a message of the parser's, if it is about such a name.
    pub fn of(message: &'a str) -> Option<Self> {
        let is_key = message.starts_with("unknown key");
        if !is_key && !message.starts_with("unknown value") {
            return None;
        }
        let mut names = names(message);
        Some(Self { found: names.next()?, known: names.collect(), is_key })
    }

    /// Whether it is the name of a key, and not a value.
    pub fn is_key(&self) -> bool {
        self.is_key
    }

    /// The table that it was found in, and what to say of it. `path` is where: the name itself, or what holds it.
    pub fn hint(&self, path: &[String], known: &KnownKeys) -> (Vec<String>, Hint) {
        let holder = match path.split_last() {
            Some((last, before)) if last == self.found && self.is_key => before,
            _ => path,
        };
        let tables = match self.is_key {
            true => known.tables_with(self.found, &holder.join(".")),
            false => Vec::new(),
        };
        let nearest = self.nearest();
        let words = match (tables.as_slice(), nearest) {
            ([], Some(name)) => format!("; did you mean `{name}`?"),
            ([], None) => String::new(),
            (tables, _) => format!("; it belongs in {}", tables.join(" or ")),
        };
        let instead = nearest.filter(|_| self.is_key && tables.is_empty()).map(str::to_owned);
        (holder.to_vec(), Hint { words, instead })
    }

    /// The name that was meant, if one is near.
    pub fn nearest(&self) -> Option<&'a str> {
        nearest(self.found, self.known.iter().copied())
    }
}

/// The nearest of some names, if one is near: by what other programs call it, or by its letters.
pub fn nearest<'a>(found: &str, names: impl Iterator<Item = &'a str> + Clone) -> Option<&'a str> {
    let lower = found.to_ascii_lowercase();
    let synonym = SYNONYMS.iter().find(|(other, _)| *other == lower);
    if let Some(name) = synonym.and_then(|(_, name)| names.clone().find(|known| known == name)) {
        return Some(name);
    }
    // Pairs of letters tell a part of a name from letters that are scattered over a longer one.
    let likeness = |name: &str| strsim::jaro_winkler(&lower, name) + strsim::sorensen_dice(&lower, name);
    let near = names.filter(|name| strsim::jaro_winkler(&lower, name) > LIKE);
    near.max_by(|a, b| likeness(a).total_cmp(&likeness(b)))
}

/// What stands between backticks.
fn names(message: &str) -> impl Iterator<Item = &str> {
    message.split('`').skip(1).step_by(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nearest_of(message: &str) -> Option<&str> {
        Unknown::of(message).and_then(|unknown| unknown.nearest())
    }

    #[test]
    fn an_unknown_key_gets_the_nearest_name() {
        let message = "unknown key `temprature`, expected one of `steps`, `temperature`, `tau`";
        assert_eq!(nearest_of(message), Some("temperature"));
        assert_eq!(nearest_of("unknown key `zzz`, expected `steps`"), None);
        assert_eq!(nearest_of("invalid type: string `steps`, expected u64"), None);
        let keys = "`cutoff`, `fine_cutoff`, `k_spacing`, `smearing`, `smearing_width`";
        for (found, expected) in [
            ("ecut", "cutoff"),
            ("ENCUT", "cutoff"),
            ("cut", "cutoff"),
            ("cutof", "cutoff"),
            ("finecutoff", "fine_cutoff"),
            ("kspacing", "k_spacing"),
            ("smearing_with", "smearing_width"),
        ] {
            let message = format!("unknown key `{found}`, expected one of {keys}");
            assert_eq!(nearest_of(&message), Some(expected), "{found}");
        }
    }

    #[test]
    fn types_say_what_their_keys_are() {
        #[derive(serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        #[allow(dead_code)]
        struct Two {
            one: u8,
            other: u8,
        }
        #[derive(serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        #[allow(dead_code)]
        struct One {
            single: u8,
        }
        let known = KnownKeys::new().with::<Two>("two").with::<One>("one");
        assert_eq!(known.tables_with("other", ""), ["[two]"]);
        assert_eq!(known.tables_with("single", "two"), ["[one]"]);
        assert!(known.tables_with("other", "two").is_empty());
    }
}
