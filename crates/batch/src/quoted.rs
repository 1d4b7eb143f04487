//! Words for the shell.

/// Quotes a word for the shell.
pub fn quoted(word: &str) -> String {
    if is_plain(word) { word.to_owned() } else { format!("'{}'", word.replace('\'', "'\\''")) }
}

/// Whether a word has no character that a shell or a batch system treats specially.
pub(crate) fn is_plain(word: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_=./:,@%+".contains(c);
    !word.is_empty() && word.chars().all(plain)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use super::*;

    #[test]
    fn quoted_words_reach_a_command_unchanged() {
        for word in ["", "a b", "it's", "$HOME", "`x`", "a\\b", "x\ny", "postgres://u@h/d?schema=s&x=1"] {
            let text = format!("printf %s {}", quoted(word));
            let output = Command::new("bash").args(["-c", &text]).output().unwrap();
            assert_eq!(String::from_utf8(output.stdout).unwrap(), word);
        }
        assert_eq!(quoted("/a/b-c.toml"), "/a/b-c.toml");
    }
}
