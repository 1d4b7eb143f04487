//! Parses numbers in Fortran's fixed-width columns.

use atoms::Vec3;

/// The numbers of a text; where columns run together, each number ends after `decimals` decimals. An overflowed
/// column (`*****`) makes all of them NaN. `None` for other text.
pub(super) fn numbers(text: &str, decimals: usize) -> Option<Vec<f64>> {
    let mut numbers = Vec::new();
    for word in text.split_whitespace() {
        if word.contains('*') {
            numbers.push(f64::NAN);
        } else if let Ok(number) = word.parse() {
            numbers.push(number);
        } else {
            run_together(word, decimals, &mut numbers)?;
        }
    }
    match numbers.iter().any(|x| x.is_nan()) {
        true => Some(vec![f64::NAN; numbers.len()]),
        false => Some(numbers),
    }
}

/// Splits such a word after the decimals of each number.
fn run_together(word: &str, decimals: usize, numbers: &mut Vec<f64>) -> Option<()> {
    let mut rest = word;
    while !rest.is_empty() {
        let end = rest.find('.')? + 1 + decimals;
        numbers.push(rest.get(..end)?.parse().ok()?);
        rest = &rest[end..];
    }
    Some(())
}

/// Three numbers; all NaN if a column overflowed.
pub(super) fn vector(text: &str, decimals: usize) -> Option<Vec3> {
    if text.contains('*') {
        return Some([f64::NAN; 3]);
    }
    numbers(text, decimals)?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_run_together_are_told_apart() {
        let text = " -12353.08821-12353.08821 62213.3630712345.00001     0.00000";
        let expected = [-12353.08821, -12353.08821, 62213.36307, 12345.00001, 0.0];
        assert_eq!(numbers(text, 5), Some(expected.to_vec()));
        assert_eq!(vector("1.5 -2e-3 +3", 8), Some([1.5, -2e-3, 3.0]));
    }

    #[test]
    fn what_is_no_number_is_not_guessed() {
        for text in ["1.5 -", "1.23-4.5", "12.a", "1.5 x", "1.50000 2..00000"] {
            assert_eq!(numbers(text, 5), None, "{text}");
        }
        assert!(vector("******** 1.0", 5).unwrap().iter().all(|x| x.is_nan()));
        assert!(vector("1.0 NaN 2.0", 5).unwrap().iter().all(|x| x.is_nan()));
        assert_eq!(vector("1.0 2.0", 5), None);
    }
}
