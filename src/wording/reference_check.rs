//! The check of the reference in words.

use monitor::reference_check::{
    CheckFault, CheckState, CheckedQuantity, DifferenceBounds, FrameDifference, Overall, ReferenceCheck,
};

use crate::output::{TextTable, count, decimals};

/// A row for each frame, and one with the root mean square over the frames.
pub fn table(check: &ReferenceCheck) -> String {
    let mut table =
        TextTable::new(&["frame", "formula", ">energy (eV/atom)", ">force (eV/Å)", ">stress (eV/Å³)", ""]);
    for FrameDifference { frame, formula, energy, force, stress, failure, .. } in &check.frames {
        table.push(vec![
            frame.clone(),
            formula.clone(),
            decimals(*energy, 4),
            decimals(*force, 4),
            decimals(*stress, 5),
            failure.clone().unwrap_or_default(),
        ]);
    }
    let mut row = |name: &str, value: fn(Overall) -> f64| {
        let cell = |overall: Option<Overall>, digits| decimals(overall.map(value), digits);
        let cells = [cell(check.energy(), 4), cell(check.force(), 4), cell(check.stress(), 5)];
        table.push([name.to_owned(), String::new()].into_iter().chain(cells).collect());
    };
    row("root mean square", |overall| overall.rms);
    row("largest", |overall| overall.largest);
    let DifferenceBounds { energy, force, stress } = check.bounds;
    table.push(
        ["bound".to_owned(), String::new()]
            .into_iter()
            .chain([energy, force, stress].map(|x| x.to_string()))
            .collect(),
    );
    let mut text = Vec::new();
    // Writing to memory cannot fail.
    let _ = table.write(&mut text);
    String::from_utf8_lossy(&text).into_owned()
}

/// The state of a check, in one word.
pub fn state(check: &ReferenceCheck) -> &'static str {
    match check.state {
        CheckState::Running => "running",
        CheckState::Passed => "passed",
        CheckState::Failed => "failed",
        CheckState::Accepted => "accepted",
    }
}

/// The state of a check, with the largest differences.
pub fn summary(check: &ReferenceCheck) -> String {
    let part = |what: &str, overall: Option<Overall>, unit: &str| {
        overall.map(|overall| format!("{what} {:.4} {unit}", overall.largest))
    };
    let parts = [
        part("energy", check.energy(), "eV/atom"),
        part("force", check.force(), "eV/Å"),
        part("stress", check.stress(), "eV/Å³"),
    ];
    let parts: Vec<_> = parts.into_iter().flatten().collect();
    let differences = match parts.is_empty() {
        true => String::new(),
        false => format!("; largest differences: {}", parts.join(", ")),
    };
    let failed = check.frames.iter().filter(|frame| frame.failure.is_some()).count();
    let failed = if failed == 0 { String::new() } else { format!("; {failed} without label") };
    let unjudged = match check.unjudged_energies() {
        0 => String::new(),
        unjudged => format!("; energies of {unjudged} not judged: too few structures with these elements"),
    };
    let structures = count(check.structures, "structure");
    format!("{}, {structures}{differences}{failed}{unjudged}", state(check))
}

/// A sentence for each fault.
pub fn faults(check: &ReferenceCheck) -> impl Iterator<Item = String> {
    check.faults().map(sentence)
}

fn sentence(fault: CheckFault<'_>) -> String {
    match fault {
        CheckFault::NoLabel { frame, reason } => format!("{}: no label: {reason}", frame.frame),
        CheckFault::AboveBound { frame: FrameDifference { frame, formula, .. }, quantity, found, bound } => {
            let (what, key, unit) = match quantity {
                CheckedQuantity::Energy => ("the energy", "max_energy_difference", "eV/atom"),
                CheckedQuantity::Force => ("a force", "max_force_difference", "eV/Å"),
                CheckedQuantity::Stress => ("the stress", "max_stress_difference", "eV/Å³"),
            };
            format!(
                "{frame} ({formula}): {what} differs by {found:.4} {unit}, more than label.reference_check.{key} = {bound} {unit}"
            )
        }
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// A check with a fault, a failed label and an energy that is not judged.
    pub fn example() -> ReferenceCheck {
        let frame = |line: u32, energy, force: Option<f64>, failure: Option<&str>| FrameDifference {
            frame: format!("/a/long/name/of/a/directory/known.extxyz:{line}"),
            formula: "Al32".to_owned(),
            energy,
            force,
            force_rms: force.map(|force| force / 2.0),
            stress: energy,
            failure: failure.map(str::to_owned),
        };
        ReferenceCheck {
            state: CheckState::Failed,
            protocol: "pbe".to_owned(),
            identity: "0".repeat(64),
            bounds: DifferenceBounds { energy: 0.005, force: 0.05, stress: 0.005 },
            structures: 3,
            frames: vec![
                frame(1, Some(0.004), Some(0.2), None),
                frame(35, None, Some(0.01), None),
                frame(69, None, None, Some("crashed: exit code 1")),
            ],
        }
    }

    #[test]
    fn the_table_ends_with_the_bounds() {
        let text = table(&example());
        let lines: Vec<_> = text.lines().collect();
        assert_eq!(lines.len(), 7);
        let cells = |line: usize| lines[line].split_whitespace().collect::<Vec<_>>();
        assert_eq!(cells(1)[1..], ["Al32", "0.0040", "0.2000", "0.00400"]);
        assert_eq!(cells(3)[1..], ["Al32", "–", "–", "–", "crashed:", "exit", "code", "1"]);
        assert_eq!(cells(6), ["bound", "0.005", "0.05", "0.005"]);
    }

    #[test]
    fn each_fault_names_its_frame_and_the_key_of_its_bound() {
        let mut check = example();
        check.frames.iter_mut().for_each(|frame| frame.frame = "known.extxyz:1".to_owned());
        check.frames[1].energy = Some(-0.02);
        let expected = [
            "known.extxyz:1 (Al32): a force differs by 0.2000 eV/Å, more than label.reference_check.max_force_difference = 0.05 eV/Å",
            "known.extxyz:1 (Al32): the energy differs by -0.0200 eV/atom, more than label.reference_check.max_energy_difference = \
             0.005 eV/atom",
            "known.extxyz:1: no label: crashed: exit code 1",
        ];
        assert_eq!(faults(&check).collect::<Vec<_>>(), expected);
    }

    #[test]
    fn the_summary_has_the_largest_differences() {
        let mut check = example();
        let text = summary(&check);
        let expected = "failed, 3 structures; largest differences: energy 0.0040 eV/atom, force 0.2000 eV/Å, stress 0.0040 eV/Å³; \
                        1 without label; energies of 1 not judged: too few structures with these elements";
        assert_eq!(text, expected);
        check.state = CheckState::Accepted;
        assert!(summary(&check).starts_with("accepted, 3 structures; "));
    }
}
