//! Differences that retry adjustments make in the input of a calculation.

use std::collections::BTreeSet;
use std::fmt::Write;

use dft::CalculationInput;

/// Maximum number of lines.
const MAX_LINES: usize = 40;
/// Maximum number of characters per line.
const MAX_CHARACTERS: usize = 200;

/// Lines only in `plain`, with `-`, and lines only in `changed`, with `+`, file by file.
pub(super) fn input_diff(plain: &CalculationInput, changed: &CalculationInput) -> String {
    let mut lines = Vec::new();
    let [before, after] = [plain, changed].map(|input| input.command.join(" "));
    compare("command", &before, &after, &mut lines);
    let [before, after] = [plain, changed].map(|input| {
        let variables = input.environment.iter();
        variables.map(|(name, value)| format!("{name}={value}\n")).collect::<String>()
    });
    compare("environment", &before, &after, &mut lines);
    let names: BTreeSet<_> = plain.files.keys().chain(changed.files.keys()).collect();
    for name in names {
        let [before, after] = [plain, changed].map(|input| input.files.get(name));
        if before != after {
            let text = |file: Option<&Vec<u8>>| {
                String::from_utf8_lossy(file.map_or(&[], Vec::as_slice)).into_owned()
            };
            compare(name, &text(before), &text(after), &mut lines);
        }
    }
    let left_out = lines.len().saturating_sub(MAX_LINES);
    lines.truncate(MAX_LINES);
    let mut text = lines.join("\n");
    if left_out > 0 {
        let _ = write!(text, "\n… and {left_out} more lines");
    }
    text
}

fn compare(name: &str, before: &str, after: &str, lines: &mut Vec<String>) {
    let [old, new] = [before, after].map(|text| text.lines().collect::<BTreeSet<_>>());
    let line = |sign: char, text: &str| {
        format!("{name}: {sign} {}", text.chars().take(MAX_CHARACTERS).collect::<String>())
    };
    lines.extend(before.lines().filter(|text| !new.contains(text)).map(|text| line('-', text)));
    lines.extend(after.lines().filter(|text| !old.contains(text)).map(|text| line('+', text)));
}
