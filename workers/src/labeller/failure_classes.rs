//! Classes of failures from their names in the store.

use dft::FailureClass;

/// The classes of failures with these names.
pub fn failure_classes(names: &[String]) -> Vec<FailureClass> {
    names.iter().filter_map(|name| FailureClass::from_name(name)).collect()
}
