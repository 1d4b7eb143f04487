//! How labels were made.

use store::records::OTHER_MOMENTS;

/// With what a calculation ran because earlier ones had failed; `None` if it ran as the protocol says.
pub fn retry_adjustments(names: &[String]) -> Option<String> {
    let moments = match names.iter().any(|name| name == OTHER_MOMENTS) {
        true => " (initial magnetic moments changed)",
        false => "",
    };
    (!names.is_empty()).then(|| format!("computed with retry adjustments {}{moments}", names.join(", ")))
}
