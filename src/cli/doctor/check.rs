//! One thing that a machine has or lacks, and the table of all of them.

use std::io::{self, Write};

use serde::Serialize;

use crate::output::wrapped;

/// Widths of the columns: state, check, found, needed for.
const WIDTHS: [usize; 4] = [7, 20, 40, 44];

/// One thing that a machine has or lacks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MachineCheck {
    check: String,
    found: String,
    /// Whether it is there, and enough of it.
    present: bool,
    /// Whether the campaign needs it.
    required: bool,
    needed_for: &'static str,
    /// What to do if it is not there.
    #[serde(skip_serializing_if = "Option::is_none")]
    advice: Option<String>,
}

impl MachineCheck {
    /// Something that is there.
    pub fn present(check: impl Into<String>, found: impl Into<String>, needed_for: &'static str) -> Self {
        let (check, found) = (check.into(), found.into());
        Self { check, found, present: true, required: false, needed_for, advice: None }
    }

    /// Something that is not there, or not enough of it.
    pub fn absent(
        check: impl Into<String>,
        found: impl Into<String>,
        needed_for: &'static str,
        advice: impl Into<String>,
    ) -> Self {
        Self { present: false, advice: Some(advice.into()), ..Self::present(check, found, needed_for) }
    }

    /// The same; the campaign needs it if `required`.
    pub fn required_if(self, required: bool) -> Self {
        Self { required: self.required || required, ..self }
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.check
    }

    /// Whether the campaign needs it and it is not there.
    pub fn is_missing(&self) -> bool {
        self.required && !self.present
    }

    fn state(&self) -> &'static str {
        match (self.present, self.required) {
            (true, _) => "ok",
            (false, true) => "MISSING",
            (false, false) => "–",
        }
    }
}

/// Writes the checks as a table, and what to do under each of those that are not there.
pub fn write_table(out: &mut dyn Write, checks: &[MachineCheck]) -> io::Result<()> {
    write_row(out, ["", "check", "found", "needed for"])?;
    for check in checks {
        write_row(out, [check.state(), &check.check, &check.found, check.needed_for])?;
        if let Some(advice) = &check.advice {
            let indent = " ".repeat(WIDTHS[0] + 2);
            let (first, width) = (format!("{indent}→ "), WIDTHS.iter().sum::<usize>() + 6);
            let options = wrapped(width).initial_indent(&first).subsequent_indent(&indent);
            textwrap::wrap(advice, options).iter().try_for_each(|line| writeln!(out, "{line}"))?;
        }
    }
    Ok(())
}

/// Writes a row whose cells may take several lines.
fn write_row(out: &mut dyn Write, cells: [&str; 4]) -> io::Result<()> {
    let cells: Vec<_> =
        cells.iter().zip(WIDTHS).map(|(cell, width)| textwrap::wrap(cell, wrapped(width))).collect();
    let height = cells.iter().map(Vec::len).max().unwrap_or_default();
    for line in 0..height {
        let parts = cells.iter().zip(WIDTHS).map(|(cell, width)| {
            let text = cell.get(line).map_or("", |text| text.as_ref());
            format!("{text:<width$}")
        });
        writeln!(out, "{}", parts.collect::<Vec<_>>().join("  ").trim_end())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(checks: &[MachineCheck]) -> String {
        let mut text = Vec::new();
        write_table(&mut text, checks).unwrap();
        String::from_utf8(text).unwrap()
    }

    #[test]
    fn a_table_tells_what_is_there_what_is_missing_and_what_to_do() {
        let there = MachineCheck::present("processor", "8 cores", "walks");
        let absent =
            MachineCheck::absent("bsub", "not on the path", "campaigns under LSF", "load its module");
        let missing = absent.clone().required_if(true);
        assert!(!there.is_missing() && !absent.is_missing() && missing.is_missing());
        let text = table(&[there.required_if(true), absent, missing]);
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(
            lines[1].split_whitespace().collect::<Vec<_>>(),
            ["ok", "processor", "8", "cores", "walks"]
        );
        assert!(lines[2].starts_with("–        bsub"), "{text}");
        assert_eq!(lines[3], "         → load its module");
        assert!(lines[4].starts_with("MISSING  bsub"), "{text}");
    }

    #[test]
    fn long_cells_stay_in_their_columns() {
        let long = "word ".repeat(20);
        let text = table(&[MachineCheck::absent("check", &long, "short", &long)]);
        assert!(text.lines().all(|line| line.chars().count() <= WIDTHS.iter().sum::<usize>() + 6), "{text}");
        assert_eq!(text.matches("word").count(), 40);
    }
}
