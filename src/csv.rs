//! Comma-separated values (RFC 4180) with full precision.

/// A header and rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Csv(String);

impl Csv {
    /// Starts with the header.
    pub fn new(titles: &[&str]) -> Self {
        let mut csv = Self(String::new());
        csv.push(titles);
        csv
    }

    /// Adds a row.
    pub fn push<T: AsRef<str>>(&mut self, row: &[T]) {
        let cells: Vec<_> = row.iter().map(|cell| quoted(cell.as_ref())).collect();
        self.0.push_str(&cells.join(","));
        self.0.push('\n');
    }

    /// The content of the file.
    pub fn into_bytes(self) -> Vec<u8> {
        self.0.into_bytes()
    }
}

/// A number with as many digits as needed to read the same value back. Empty if it is missing or not finite.
pub fn number(x: impl Into<Option<f64>>) -> String {
    x.into().filter(|x| x.is_finite()).map_or(String::new(), |x| x.to_string())
}

fn quoted(cell: &str) -> String {
    match cell.contains([',', '"', '\n', '\r']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_quoted_where_they_must_be() {
        let mut csv = Csv::new(&["name", "γ"]);
        csv.push(&["a, \"b\"".to_owned(), number(0.1)]);
        csv.push(&[number(None), number(f64::NAN)]);
        assert_eq!(csv.0, "name,γ\n\"a, \"\"b\"\"\",0.1\n,\n");
    }
}
