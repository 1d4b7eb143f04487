//! Text with `_{subscript}` and `^{superscript}`, as in V_{0} and eV Å^{−1}.

use crate::font::advance;

/// Which part of a text is at its position.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// The start.
    Start,
    /// The middle.
    Middle,
    /// The end.
    End,
}

/// A part of a text with one style.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TextRun<'a> {
    /// The characters.
    pub text: &'a str,
    /// Vertical style.
    pub script: Script,
}

/// Vertical style of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Script {
    /// On the baseline.
    Normal,
    /// Subscript.
    Sub,
    /// Superscript.
    Super,
}

impl Script {
    /// Downward shift from the baseline, in font sizes.
    pub fn baseline_shift(self) -> f64 {
        match self {
            Self::Normal => 0.0,
            Self::Sub => 0.2,
            Self::Super => -0.36,
        }
    }

    /// Font size relative to the line.
    pub fn scale(self) -> f64 {
        if self == Self::Normal { 1.0 } else { 0.72 }
    }
}

/// Splits a text into runs. Unclosed braces end with the text.
pub fn runs(markup: &str) -> Vec<TextRun<'_>> {
    let (mut runs, mut rest) = (Vec::new(), markup);
    let mut push = |text, script| {
        if !str::is_empty(text) {
            runs.push(TextRun { text, script });
        }
    };
    loop {
        let mark = ["_{", "^{"].into_iter().filter_map(|mark| Some((rest.find(mark)?, mark))).min();
        let Some((place, mark)) = mark else { break };
        push(&rest[..place], Script::Normal);
        let inside = &rest[place + mark.len()..];
        let end = inside.find('}').unwrap_or(inside.len());
        push(&inside[..end], if mark == "_{" { Script::Sub } else { Script::Super });
        rest = inside[end..].strip_prefix('}').unwrap_or("");
    }
    push(rest, Script::Normal);
    runs
}

/// Width of a text at font size 1.
pub fn width(markup: &str, bold: bool) -> f64 {
    let of = |run: TextRun<'_>| run.script.scale() * run.text.chars().map(|c| advance(c, bold)).sum::<f64>();
    runs(markup).into_iter().map(of).sum()
}

/// The text without braces, for data files.
pub fn plain(markup: &str) -> String {
    let of = |run: &TextRun<'_>| match run.script {
        Script::Normal => run.text.to_owned(),
        Script::Sub => format!("_{}", run.text),
        Script::Super => format!("^{}", run.text),
    };
    runs(markup).iter().map(of).collect()
}

/// The text as HTML.
pub fn to_html(markup: &str) -> String {
    let of = |run: &TextRun<'_>| {
        let text = escape(run.text);
        match run.script {
            Script::Normal => text,
            Script::Sub => format!("<sub>{text}</sub>"),
            Script::Super => format!("<sup>{text}</sup>"),
        }
    };
    runs(markup).iter().map(of).collect()
}

/// Escapes XML and HTML special characters. Drops characters that XML does not allow.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            '\t' | '\n' => escaped.push(character),
            '\u{fffe}' | '\u{ffff}' => {}
            other if other.is_control() => {}
            other => escaped.push(other),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_are_understood() {
        let parts: Vec<_> = runs("eV Å^{−1} of γ_{nbr}!").iter().map(|run| (run.text, run.script)).collect();
        let expected = [
            ("eV Å", Script::Normal),
            ("−1", Script::Super),
            (" of γ", Script::Normal),
            ("nbr", Script::Sub),
            ("!", Script::Normal),
        ];
        assert_eq!(parts, expected);
        assert_eq!(plain("V_{0} Å^{3}"), "V_0 Å^3");
        assert_eq!(to_html("a<b V_{0}"), "a&lt;b V<sub>0</sub>");
        assert_eq!((runs("").len(), runs("a_{b")[1].text, runs("_x")[0].text), (0, "b", "_x"));
        assert_eq!(escape("\u{1}\"&'\u{ffff}"), "&quot;&amp;&#39;");
    }

    #[test]
    fn what_stands_lower_is_narrower() {
        let (line, below) = (width("00", false), width("0_{0}", false));
        assert!((line - 1.112).abs() < 1e-3 && (below - 0.556 * 1.72).abs() < 1e-3, "{line} {below}");
    }
}
