//! The errors of versions, as refits have recorded them.

use atoms::units::GPA_PER_EV_A3;
use serde_json::{Value, json};
use store::VersionRecord;

use crate::output::{TextTable, decimals};

/// In place of errors or figures that there are not.
pub static UNKNOWN: Value = Value::Null;

/// A kind of errors.
struct ErrorQuantity {
    /// Key in the figures of a version.
    key: &'static str,
    /// Title with the unit that is shown.
    title: &'static str,
    /// That unit relative to the recorded one.
    factor: f64,
    decimals: usize,
}

const QUANTITIES: [ErrorQuantity; 6] = [
    quantity("energy_mae", "energy MAE (meV/atom)", 1000.0, 2),
    quantity("energy_rmse", "energy RMSE (meV/atom)", 1000.0, 2),
    quantity("force_mae", "force MAE (eV/Å)", 1.0, 4),
    quantity("force_rmse", "force RMSE (eV/Å)", 1.0, 4),
    quantity("stress_mae", "stress MAE (GPa)", GPA_PER_EV_A3, 4),
    quantity("stress_rmse", "stress RMSE (GPa)", GPA_PER_EV_A3, 4),
];

const fn quantity(key: &'static str, title: &'static str, factor: f64, decimals: usize) -> ErrorQuantity {
    ErrorQuantity { key, title, factor, decimals }
}

/// The key of the errors by which versions are compared.
const DECIDING: &str = "force_mae";

/// The errors of a version on a data set.
#[derive(Clone, Copy, Debug)]
pub struct RecordedErrors<'a> {
    /// Name of the data set.
    pub set: &'a str,
    /// `test`, `held_out`, `replay` or `since`.
    pub kind: &'a str,
    /// Number of its structures.
    pub structures: u64,
    /// The errors, see docs/versions.md.
    pub errors: &'a Value,
    /// Those of version 0 on the same structures; null if unknown.
    first: &'a Value,
}

impl<'a> RecordedErrors<'a> {
    /// `None` if the figures lack them.
    fn new(set: &'a Value, whose: &str) -> Option<Self> {
        let errors = Some(&set[whose]).filter(|errors| errors.is_object())?;
        Some(Self {
            set: set["name"].as_str()?,
            kind: set["kind"].as_str().unwrap_or_default(),
            structures: set["structures"].as_u64().unwrap_or(0),
            errors,
            first: &set["first"],
        })
    }

    /// Mean absolute error of the forces, eV/Å.
    pub fn force_mae(&self) -> Option<f64> {
        self.errors[DECIDING].as_f64()
    }
}

/// The errors of a version by data set. Those of version 0 are from the first attempt that was compared with it.
pub fn errors_of(versions: &[VersionRecord], number: u32) -> Vec<RecordedErrors<'_>> {
    if let Some(record) = versions.iter().find(|version| version.number == number) {
        return errors_in(record, "version");
    }
    if number > 0 {
        return Vec::new();
    }
    versions.iter().map(errors_of_first).find(|errors| !errors.is_empty()).unwrap_or_default()
}

/// The errors of version 0 in the figures of another.
fn errors_of_first(record: &VersionRecord) -> Vec<RecordedErrors<'_>> {
    let first = errors_in(record, "first");
    if first.is_empty() && record.parent == 0 { errors_in(record, "parent") } else { first }
}

fn errors_in<'a>(record: &'a VersionRecord, whose: &str) -> Vec<RecordedErrors<'a>> {
    let sets = record.figures["sets"].as_array().into_iter().flatten();
    sets.filter_map(|set| RecordedErrors::new(set, whose)).collect()
}

/// The figures of a version that has the model of version `number`, which is also its parent: their errors are the same.
pub fn figures_of_same_model(versions: &[VersionRecord], number: u32) -> Value {
    let sets = errors_of(versions, number).into_iter().map(|found| {
        let RecordedErrors { set, kind, structures, errors, first } = found;
        let first = if number == 0 { errors } else { first };
        json!({ "name": set, "kind": kind, "structures": structures, "first": first, "parent": errors, "version": errors })
    });
    json!({ "sets": sets.collect::<Vec<_>>() })
}

/// Errors of two versions on a data set.
#[derive(Clone, Copy, Debug)]
pub struct ErrorPair<'a> {
    /// Name of the data set.
    pub set: &'a str,
    /// Number of its structures when each of them was judged.
    pub structures: [u64; 2],
    /// The errors of each; null if unknown.
    pub errors: [&'a Value; 2],
}

impl ErrorPair<'_> {
    /// Whether both were judged by as many structures.
    pub fn is_comparable(&self) -> bool {
        self.structures[0] == self.structures[1]
    }

    /// The errors of a kind: those of the second, relative to those of the first.
    fn ratio(&self, key: &str) -> Option<f64> {
        let [first, second] = self.errors.map(|errors| errors[key].as_f64());
        let (first, second) = (first?, second?);
        (self.is_comparable() && first > 0.0).then(|| second / first)
    }

    /// The same of the mean absolute errors of forces.
    pub fn force_ratio(&self) -> Option<f64> {
        self.ratio(DECIDING)
    }
}

/// The errors of a version beside those of its parent; of version 0 alone.
pub fn with_parent(versions: &[VersionRecord], number: u32) -> Vec<ErrorPair<'_>> {
    let parents =
        versions.iter().find(|version| version.number == number).map(|record| errors_in(record, "parent"));
    let parents = parents.unwrap_or_default();
    let pairs = errors_of(versions, number).into_iter().map(|own| {
        let parent = parents.iter().find(|parent| parent.set == own.set);
        let errors = [parent.map_or(&UNKNOWN, |parent| parent.errors), own.errors];
        ErrorPair { set: own.set, structures: [own.structures; 2], errors }
    });
    pairs.collect()
}

/// The errors of two versions on the data sets that both were judged by. If one is the parent of the other, or version 0, both
/// were evaluated on the same structures.
pub fn of_both(versions: &[VersionRecord], [one, other]: [u32; 2]) -> Vec<ErrorPair<'_>> {
    if let Some(pairs) = beside(versions, other, one) {
        return pairs;
    }
    if let Some(pairs) = beside(versions, one, other) {
        let swapped =
            pairs.into_iter().map(|pair| ErrorPair { errors: [pair.errors[1], pair.errors[0]], ..pair });
        return swapped.collect();
    }
    let others = errors_of(versions, other);
    let pairs = errors_of(versions, one).into_iter().filter_map(|first| {
        let second = others.iter().find(|second| second.set == first.set)?;
        let structures = [first.structures, second.structures];
        Some(ErrorPair { set: first.set, structures, errors: [first.errors, second.errors] })
    });
    pairs.collect()
}

/// The errors of version `of` behind those that its figures have of another. `None` if they have none.
fn beside(versions: &[VersionRecord], of: u32, other: u32) -> Option<Vec<ErrorPair<'_>>> {
    let record = versions.iter().find(|version| version.number == of)?;
    let others = match other {
        0 => errors_of_first(record),
        other if record.parent == other => errors_in(record, "parent"),
        _ => Vec::new(),
    };
    let own = errors_in(record, "version");
    let pairs = others.into_iter().filter_map(|first| {
        let second = own.iter().find(|second| second.set == first.set)?;
        let structures = [first.structures, second.structures];
        Some(ErrorPair { set: first.set, structures, errors: [first.errors, second.errors] })
    });
    Some(pairs.collect()).filter(|pairs: &Vec<_>| !pairs.is_empty())
}

/// A table with a row for each data set and kind of errors. `names` are those of the versions.
pub fn table(names: [&str; 2], pairs: &[ErrorPair<'_>]) -> TextTable {
    let [one, other] = names.map(|name| format!(">{name}"));
    let mut table = TextTable::new(&["set", ">structures", "error", &one, &other, ">ratio", "better"]);
    for pair in pairs {
        let structures = match pair.is_comparable() {
            true => pair.structures[0].to_string(),
            false => pair.structures.map(|number| number.to_string()).join(" / "),
        };
        for ErrorQuantity { key, title, factor, decimals: digits } in &QUANTITIES {
            let errors = pair.errors.map(|errors| errors[*key].as_f64());
            if errors == [None; 2] {
                continue;
            }
            let ratio = pair.ratio(key);
            let [first, second] = errors.map(|error| decimals(error.map(|error| factor * error), *digits));
            table.push(vec![
                pair.set.to_owned(),
                structures.clone(),
                (*title).to_owned(),
                first,
                second,
                decimals(ratio, 2),
                better(names, ratio).to_owned(),
            ]);
        }
    }
    table
}

/// The name of the version with the smaller errors.
fn better(names: [&str; 2], ratio: Option<f64>) -> &str {
    match ratio {
        Some(ratio) if ratio < 1.0 => names[1],
        Some(ratio) if ratio > 1.0 => names[0],
        Some(_) => "equal",
        None => "",
    }
}

#[cfg(test)]
mod tests {
    use store::VersionState;

    use super::*;

    fn set(name: &str, structures: u64, errors: [f64; 3]) -> Value {
        let [first, parent, version] = errors.map(|error| json!({ "force_mae": error, "energy_mae": 0.01 }));
        json!({ "name": name, "kind": "test", "structures": structures, "first": first, "parent": parent,
                "version": version })
    }

    fn record(number: u32, parent: u32, sets: &[Value]) -> VersionRecord {
        VersionRecord {
            number,
            parent,
            state: VersionState::Registered,
            reason: String::new(),
            method: "native".into(),
            structures: 1,
            last_decision: 1,
            labels: 1,
            model_hash: String::new(),
            mixture_hash: String::new(),
            figures: json!({ "sets": sets }),
            seconds: 1.0,
            core_hours: 0.0,
            time: 0,
        }
    }

    fn versions() -> Vec<VersionRecord> {
        vec![
            record(1, 0, &[set("a", 5, [0.4, 0.4, 0.2]), set("b", 3, [0.8, 0.8, 0.8])]),
            record(2, 1, &[set("a", 5, [0.4, 0.2, 0.1]), set("b", 6, [0.9, 0.7, 0.6])]),
            record(3, 1, &[set("b", 9, [1.0, 0.9, 0.3])]),
        ]
    }

    fn found(pairs: &[ErrorPair<'_>]) -> Vec<(String, [u64; 2], [f64; 2])> {
        let errors = |pair: &ErrorPair<'_>| pair.errors.map(|errors| errors[DECIDING].as_f64().unwrap());
        pairs.iter().map(|pair| (pair.set.to_owned(), pair.structures, errors(pair))).collect()
    }

    #[test]
    fn relatives_are_compared_on_the_same_structures() {
        let versions = versions();
        let both = |numbers| found(&of_both(&versions, numbers));
        let (a, b) = ("a".to_owned(), "b".to_owned());
        assert_eq!(both([1, 2]), [(a.clone(), [5; 2], [0.2, 0.1]), (b.clone(), [6; 2], [0.7, 0.6])]);
        assert_eq!(both([2, 1]), [(a.clone(), [5; 2], [0.1, 0.2]), (b.clone(), [6; 2], [0.6, 0.7])]);
        assert_eq!(both([0, 2]), [(a, [5; 2], [0.4, 0.1]), (b.clone(), [6; 2], [0.9, 0.6])]);
        // Siblings: each by its own structures.
        assert_eq!(both([2, 3]), [(b, [6, 9], [0.6, 0.3])]);
        assert_eq!(of_both(&versions, [2, 3])[0].force_ratio(), None);
    }

    #[test]
    fn version_0_has_the_errors_of_the_first_attempt() {
        let versions = versions();
        let first: Vec<_> = errors_of(&versions, 0).iter().map(|found| found.force_mae().unwrap()).collect();
        assert_eq!(first, [0.4, 0.8]);
        assert!(errors_of(&versions, 9).is_empty() && errors_of(&[], 0).is_empty());
        let mut early = versions.clone();
        // A parent that is version 0 has its errors.
        early[0].figures["sets"][0]["first"] = Value::Null;
        early[0].figures["sets"][1]["first"] = Value::Null;
        assert_eq!(errors_of(&early, 0).len(), 2);
        early[0].figures = Value::Null;
        assert_eq!(errors_of(&early, 0)[1].structures, 6, "the next attempt");
    }

    #[test]
    fn the_same_model_has_the_same_errors_as_its_parent() {
        let mut versions = versions();
        let figures = figures_of_same_model(&versions, 2);
        versions.push(VersionRecord { figures, ..record(4, 2, &[]) });
        let with_parent = found(&with_parent(&versions, 4));
        assert_eq!(with_parent[0], ("a".to_owned(), [5; 2], [0.1, 0.1]));
        assert_eq!(found(&of_both(&versions, [0, 4]))[1], ("b".to_owned(), [6; 2], [0.9, 0.6]));
        assert_eq!(figures_of_same_model(&versions, 0)["sets"][0]["version"]["force_mae"], 0.4);
    }

    #[test]
    fn rows_name_the_better_version() {
        let versions = versions();
        let mut text = Vec::new();
        table(["1", "2"], &of_both(&versions, [1, 2])).write(&mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
        let rows: Vec<Vec<_>> = text.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(rows[1], ["a", "5", "energy", "MAE", "(meV/atom)", "10.00", "10.00", "1.00", "equal"]);
        assert_eq!(rows[2], ["a", "5", "force", "MAE", "(eV/Å)", "0.2000", "0.1000", "0.50", "2"]);
    }
}
