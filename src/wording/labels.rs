//! How labels were made, and what those that wait are worth.

use monitor::label_value::{OVERDUE, ValueFactors};
use serde_json::Value;
use store::records::OTHER_MOMENTS;

/// With what a calculation ran because earlier ones had failed; `None` if it ran as the protocol says.
pub fn retry_adjustments(names: &[String]) -> Option<String> {
    let moments = match names.iter().any(|name| name == OTHER_MOMENTS) {
        true => " (initial magnetic moments changed)",
        false => "",
    };
    (!names.is_empty()).then(|| format!("computed with retry adjustments {}{moments}", names.join(", ")))
}

/// The value of a queued label for a table.
pub fn value(value: Option<f64>) -> String {
    match value {
        None => "–".to_owned(),
        Some(value) if value >= OVERDUE => "next".to_owned(),
        Some(value) => significant(value),
    }
}

/// The value of a queued label with its factors. `None` without a value.
pub fn value_with_factors(found: Option<f64>, factors: Option<&Value>) -> Option<String> {
    found?;
    let factors: Option<ValueFactors> = factors.and_then(|json| serde_json::from_value(json.clone()).ok());
    let shown = value(found);
    let Some(ValueFactors { expected_error, completion, core_hours, diversity, age, overtaken }) = factors
    else {
        return Some(shown);
    };
    let Some(age) = age else {
        return Some(format!("next for its age: {overtaken} later structures are finished"));
    };
    let [error, completion, cost, diversity, age] =
        [expected_error, completion, core_hours, diversity, age].map(significant);
    Some(format!(
        "{shown} = expected error {error} × completion {completion} ÷ cost {cost} × diversity {diversity} × age {age}"
    ))
}

/// Three significant digits.
fn significant(x: f64) -> String {
    match x.abs() {
        0.0 => "0".to_owned(),
        size if (1e-3..1e4).contains(&size) => {
            let before = size.log10().floor() as i32;
            format!("{x:.*}", usize::try_from(2 - before).unwrap_or(0))
        }
        _ => format!("{x:.2e}"),
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn values_are_short_and_name_their_factors() {
        let shown = [0.0, 1.0, 0.012345, 123.4, 1234.6, 1.5e-5, 2.5e7, OVERDUE].map(|x| value(Some(x)));
        assert_eq!(shown, ["0", "1.00", "0.0123", "123", "1235", "1.50e-5", "2.50e7", "next"]);
        assert_eq!((value(None).as_str(), value_with_factors(None, None)), ("–", None));
        let mut factors = json!({
            "expected_error": 0.5, "completion": 0.8, "core_hours": 0.25, "diversity": 0.5, "age": 1.25, "overtaken": 2,
        });
        assert_eq!(
            value_with_factors(Some(1.0), Some(&factors)).unwrap(),
            "1.00 = expected error 0.500 × completion 0.800 ÷ cost 0.250 × diversity 0.500 × age 1.25"
        );
        factors["age"] = json!(null);
        let next = value_with_factors(Some(OVERDUE), Some(&factors)).unwrap();
        assert_eq!(next, "next for its age: 2 later structures are finished");
    }
}
