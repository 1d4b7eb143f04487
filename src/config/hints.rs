//! Suggestions for unknown names.

use serde::de::DeserializeOwned;

use crate::nearest_name::nearest;

/// The keys of the tables of a file.
pub struct KnownKeys(Vec<(&'static str, Vec<String>)>);

impl KnownKeys {
    /// Without tables.
    pub fn new() -> Self {
        Self(Vec::new())
    }

    /// Adds the keys of `T`, which must deny unknown keys: its error message lists them.
    pub fn with<T: DeserializeOwned>(mut self, table: &'static str) -> Self {
        let keys = match toml::from_str::<T>("'?' = 0") {
            Err(error) => names(error.message()).skip(1).map(str::to_owned).collect(),
            Ok(_) => Vec::new(),
        };
        self.0.push((table, keys));
        self
    }

    /// The tables other than `but` that have this key.
    fn tables_with(&self, key: &str, but: &str) -> Vec<String> {
        let with =
            self.0.iter().filter(|(table, keys)| *table != but && keys.iter().any(|known| known == key));
        with.map(|(table, _)| format!("[{table}]")).collect()
    }
}

/// An unknown name and the known ones: the parts of "unknown key `x`, expected one of `a`, `b`".
pub struct Unknown<'a> {
    found: &'a str,
    known: Vec<&'a str>,
    is_key: bool,
}

/// A suggestion for the user.
pub struct Hint {
    /// Text to append to the message; empty without a suggestion.
    pub text: String,
    /// The key that was probably meant.
    pub replacement: Option<String>,
}

impl<'a> Unknown<'a> {
    /// Parses a message of the parser; `None` if it is not about an unknown name.
    pub fn from_message(message: &'a str) -> Option<Self> {
        let is_key = message.starts_with("unknown key");
        if !is_key && !message.starts_with("unknown value") {
            return None;
        }
        let mut names = names(message);
        Some(Self { found: names.next()?, known: names.collect(), is_key })
    }

    /// Whether the name is that of a key, not a value.
    pub fn is_key(&self) -> bool {
        self.is_key
    }

    /// The table in which the name was found, and a suggestion. `path` ends with the name itself or with its table.
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
        let text = match (tables.as_slice(), nearest) {
            ([], Some(name)) => format!("; did you mean `{name}`?"),
            ([], None) => String::new(),
            (tables, _) => format!("; it belongs in {}", tables.join(" or ")),
        };
        let replacement = nearest.filter(|_| self.is_key && tables.is_empty()).map(str::to_owned);
        (holder.to_vec(), Hint { text, replacement })
    }

    /// The known name that was probably meant.
    pub fn nearest(&self) -> Option<&'a str> {
        nearest(self.found, self.known.iter().copied())
    }
}

/// The texts between backticks.
fn names(message: &str) -> impl Iterator<Item = &str> {
    message.split('`').skip(1).step_by(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nearest_of(message: &str) -> Option<&str> {
        Unknown::from_message(message).and_then(|unknown| unknown.nearest())
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
    fn the_keys_of_a_type_are_found() {
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
