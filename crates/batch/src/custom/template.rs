//! Commands and scripts with placeholders.
//!
//! `{name}` is replaced by a value. `{if name}…{end}`, within a line, is left out if the job has no such value, and the line with
//! it if nothing else is in it. `${name}` belongs to the shell.

use crate::quoted::{is_plain, quoted};

/// Placeholders with their values; `None` for a value that this job does not have.
pub(super) type PlaceholderValues<'a> = [(&'a str, Option<String>)];

/// How a value is inserted: line, name and value give the text, or what is wrong.
pub(super) type Insert<'a> = &'a dyn Fn(&str, &str, &str) -> Result<String, String>;

/// Why a template cannot be filled.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TemplateFault {
    /// Line, from 1; 0 if it is not one line's fault.
    pub line: usize,
    /// What was found and expected.
    pub message: String,
}

/// A part of a line.
#[derive(Debug, PartialEq)]
enum LinePart<'a> {
    Text(&'a str),
    Value(&'a str),
    If(&'a str),
    End,
}

impl TemplateFault {
    /// The place in the template, in words.
    pub(super) fn place(&self, template: &str) -> String {
        match template.lines().nth(self.line.saturating_sub(1)).filter(|_| self.line > 0) {
            Some(line) if template.lines().count() > 1 => format!("in line {} ({line:?})", self.line),
            _ => format!("{template:?}"),
        }
    }

    /// What is wrong, as the end of an error about a key.
    pub(super) fn expected(&self) -> String {
        self.message.clone()
    }
}

/// Replaces the placeholders of a template.
///
/// # Errors
/// Unknown placeholders, placeholders of values that the job does not have, conditions without end, and values that cannot stand
/// where they are.
pub(super) fn fill(
    template: &str,
    values: &PlaceholderValues<'_>,
    insert: Insert<'_>,
) -> Result<String, TemplateFault> {
    let mut text = String::with_capacity(template.len());
    for (number, line) in template.split_inclusive('\n').enumerate() {
        let filled = fill_line(line, values, insert);
        let filled = filled.map_err(|message| TemplateFault { line: number + 1, message })?;
        text.extend(filled);
    }
    Ok(text)
}

/// A filled line, or nothing if it is left out.
fn fill_line(
    line: &str,
    values: &PlaceholderValues<'_>,
    insert: Insert<'_>,
) -> Result<Option<String>, String> {
    let find = |name: &str| {
        let known = values.iter().find(|(known, _)| *known == name).map(|(_, value)| value.as_deref());
        known.ok_or_else(|| {
            let known: Vec<_> = values.iter().map(|(name, _)| format!("{{{name}}}")).collect();
            format!("one of {} in place of {{{name}}}", known.join(", "))
        })
    };
    let (mut text, mut condition, mut is_shorter) = (String::new(), None, false);
    for piece in pieces(line) {
        let is_shown = condition != Some(false);
        match piece {
            LinePart::Text(part) if is_shown => text += part,
            LinePart::Text(_) => {}
            LinePart::Value(name) => match find(name)? {
                Some(value) if is_shown => text += &insert(line, name, value)?,
                None if is_shown => {
                    return Err(format!(
                        "a value of {{{name}}}, which this job does not have: give it, or write {{if {name}}}…{{end}} around what needs it"
                    ));
                }
                _ => {}
            },
            LinePart::If(_) if condition.is_some() => return Err("{end} before the next {if …}".to_owned()),
            LinePart::If(name) => {
                condition = Some(find(name)?.is_some());
                is_shorter |= condition == Some(false);
            }
            LinePart::End if condition.is_none() => {
                return Err("{if …} before {end}, in the same line".to_owned());
            }
            LinePart::End => condition = None,
        }
    }
    if condition.is_some() {
        return Err("{end} after {if …}, in the same line".to_owned());
    }
    Ok((!is_shorter || !text.trim().is_empty()).then_some(text))
}

/// The parts of a line.
fn pieces(line: &str) -> Vec<LinePart<'_>> {
    let (mut pieces, mut begin, mut at) = (Vec::new(), 0, 0);
    while let Some(found) = line[at..].find('{') {
        let brace = at + found;
        at = brace + 1;
        let is_of_shell = line[..brace].ends_with('$');
        let Some((piece, length)) = placeholder(&line[brace..]).filter(|_| !is_of_shell) else { continue };
        pieces.extend([LinePart::Text(&line[begin..brace]), piece]);
        begin = brace + length;
        at = begin;
    }
    pieces.push(LinePart::Text(&line[begin..]));
    pieces
}

/// The placeholder with which the text begins, and its length.
fn placeholder(text: &str) -> Option<(LinePart<'_>, usize)> {
    let (inside, _) = text.strip_prefix('{')?.split_once('}')?;
    let is_name = |name: &str| !name.is_empty() && name.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    let piece = match inside.strip_prefix("if ").map(str::trim) {
        Some(name) if is_name(name) => LinePart::If(name),
        None if inside == "end" => LinePart::End,
        None if is_name(inside) => LinePart::Value(inside),
        _ => return None,
    };
    Some((piece, inside.len() + 2))
}

/// Inserts a value into a command: quoted, but for a part of the command.
pub(super) fn in_command(_: &str, name: &str, value: &str) -> Result<String, String> {
    Ok(if name == "start_after" { value.to_owned() } else { quoted(value) })
}

/// Inserts a value into a script: quoted, but for a command, and in lines for the batch system, which begin with `#`.
pub(super) fn in_script(line: &str, name: &str, value: &str) -> Result<String, String> {
    match line.starts_with('#') {
        _ if name == "command" => Ok(value.to_owned()),
        false => Ok(quoted(value)),
        true if is_plain(value) => Ok(value.to_owned()),
        true => Err(format!(
            "a {{{name}}} of letters, digits and the characters - _ = . / : , @ % + where it stands in a line for the batch system; \
             it is {value:?}"
        )),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn filled(template: &str) -> Result<String, TemplateFault> {
        let values = [("name", Some("a b".to_owned())), ("cores", Some("4".to_owned())), ("gpus", None)];
        fill(template, &values, &in_script)
    }

    #[test]
    fn conditions_leave_out_what_a_job_does_not_have() {
        for (template, expected) in [
            ("x {cores}\n", "x 4\n"),
            ("#P n={cores}{if gpus}:g={gpus}{end}{if cores}:c={cores}{end}\n", "#P n=4:c=4\n"),
            ("a\n{if gpus}#P g={gpus}{end}\nb\n", "a\nb\n"),
            ("a\n\nb", "a\n\nb"),
            ("cd {name}", "cd 'a b'"),
            ("${cores} {a,b} { x; } {} {Cores} {if } {x", "${cores} {a,b} { x; } {} {Cores} {if } {x"),
            ("", ""),
        ] {
            assert_eq!(filled(template).as_deref(), Ok(expected), "{template}");
        }
    }

    #[test]
    fn faults_name_line_and_placeholder() {
        for (template, line, message) in [
            ("a\n{core}", 2, "one of {name}, {cores}, {gpus} in place of {core}"),
            ("{if core}x{end}", 1, "in place of {core}"),
            ("\n\n{gpus}", 3, "a value of {gpus}, which this job does not have"),
            ("{if cores}x", 1, "{end} after {if …}"),
            ("{if cores}x\n{end}", 1, "{end} after {if …}"),
            ("x{end}", 1, "{if …} before {end}"),
            ("{if cores}{if gpus}{end}{end}", 1, "{end} before the next {if …}"),
            ("#P -N {name}", 1, "it is \"a b\""),
        ] {
            let fault = filled(template).unwrap_err();
            assert!(fault.line == line && fault.message.contains(message), "{template}: {fault:?}");
        }
    }

    proptest! {
        /// Whatever the template, it is filled without a placeholder that is left, or refused.
        #[test]
        fn no_placeholder_is_left(parts in proptest::collection::vec(
            prop_oneof![
                Just("{cores}"), Just("{if cores}"), Just("{if gpus}"), Just("{gpus}"), Just("{end}"), Just("{"), Just("}"),
                Just("$"), Just("\n"), Just("text "), Just("{unknown}"), Just("é")
            ],
            0..20,
        )) {
            let template = parts.concat();
            if let Ok(text) = filled(&template) {
                for line in text.lines() {
                    let left = pieces(line).into_iter().filter(|piece| !matches!(piece, LinePart::Text(_))).count();
                    prop_assert_eq!(left, 0, "{:?} became {:?}", template, text);
                }
            }
        }
    }
}
