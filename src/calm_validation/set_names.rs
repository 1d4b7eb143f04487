//! Names of the parts of a page about several sets of labelled structures.

/// The name of a figure or a table of a set of labelled structures, from 0.
pub fn of_set(name: &str, number: usize) -> String {
    if number == 0 { name.to_owned() } else { format!("{name}-{}", number + 1) }
}
