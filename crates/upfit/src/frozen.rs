//! Weights that are not trained.

use potentials::grace::WeightGroup;

use crate::error::UpfitError;

/// Whether each weight is frozen: those of the groups whose names begin with one of these patterns.
///
/// # Errors
/// A pattern that no group matches; patterns that match all groups.
pub fn frozen_weights(groups: &[WeightGroup], patterns: &[String]) -> Result<Vec<bool>, UpfitError> {
    let matches = |group: &WeightGroup, pattern: &String| group.name.starts_with(pattern.as_str());
    if let Some(pattern) = patterns.iter().find(|pattern| !groups.iter().any(|group| matches(group, pattern)))
    {
        let known: Vec<_> = groups.iter().map(|group| group.name.as_str()).collect();
        return Err(UpfitError::UnknownGroup { pattern: pattern.clone(), known: known.join(", ") });
    }
    let length = groups.iter().map(|group| group.range.end).max().unwrap_or_default();
    let mut frozen = vec![false; length];
    for group in groups.iter().filter(|group| patterns.iter().any(|pattern| matches(group, pattern))) {
        frozen[group.range.clone()].fill(true);
    }
    if frozen.iter().all(|frozen| *frozen) {
        return Err(UpfitError::AllFrozen);
    }
    Ok(frozen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_are_beginnings_of_names() {
        let group = |name: &str, range| WeightGroup { name: name.into(), shape: vec![], range };
        let groups = [group("radial_0", 0..2), group("radial_1", 2..3), group("shift_values", 3..5)];
        let frozen = |patterns: &[&str]| {
            let patterns: Vec<String> = patterns.iter().map(|pattern| (*pattern).to_owned()).collect();
            frozen_weights(&groups, &patterns)
        };
        assert_eq!(frozen(&[]).unwrap(), [false; 5]);
        assert_eq!(frozen(&["radial_1"]).unwrap(), [false, false, true, false, false]);
        assert_eq!(frozen(&["radial", "radial_0"]).unwrap(), [true, true, true, false, false]);
        let unknown = frozen(&["radial", "readout"]).unwrap_err().to_string();
        assert!(
            unknown.contains("'readout'") && unknown.contains("radial_0, radial_1, shift_values"),
            "{unknown}"
        );
        assert!(matches!(frozen(&["radial", "shift"]), Err(UpfitError::AllFrozen)));
    }
}
