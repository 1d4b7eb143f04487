//! The demonstration of aluminium, for tests of other refits than its own.

/// `configs/aluminium.toml` without its section `[refit]`.
pub fn demo_without_refit() -> String {
    let text = include_str!("../../configs/aluminium.toml");
    let begin = text.find("\n[refit]").expect("the section of the demonstration");
    let end = text[begin..].find("\n[budget]").expect("the next section");
    format!("{}{}", &text[..begin], &text[begin + end..])
}
