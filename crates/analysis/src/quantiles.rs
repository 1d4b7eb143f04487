//! Quantiles.

/// The quantile `q` (0 to 1) of ascending values, interpolated linearly at index q (n − 1), counted from 0
/// (type 7 of Hyndman and Fan, the default of NumPy). `None` without values.
pub fn quantile(ascending: &[f64], q: f64) -> Option<f64> {
    quantile_by_index(ascending.len(), q, |index| ascending[index])
}

/// The same of `number` values in ascending order, which `value` has by their index.
pub(crate) fn quantile_by_index(number: usize, q: f64, value: impl Fn(usize) -> f64) -> Option<f64> {
    let last = number.checked_sub(1)?;
    let place = q.clamp(0.0, 1.0) * last as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(last);
    let (low, high) = (value(below), value(above));
    Some(low + (place - below as f64) * (high - low))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn quantiles_are_those_of_numpy() {
        // numpy.quantile([1, 2, 4, 8], [0, 0.5, 0.9, 0.99, 1]) = [1, 3, 6.8, 7.88, 8]
        let values = [1.0, 2.0, 4.0, 8.0];
        for (q, expected) in [(0.0, 1.0), (0.5, 3.0), (0.9, 6.8), (0.99, 7.88), (1.0, 8.0)] {
            let found = quantile(&values, q).unwrap();
            assert!((found - expected).abs() < 1e-12, "{q}: {found}");
        }
        assert_eq!((quantile(&[], 0.5), quantile(&[7.0], 0.99)), (None, Some(7.0)));
    }

    proptest! {
        #[test]
        fn about_that_share_is_below(mut values in prop::collection::vec(0.0..1e3, 1..200), q in 0.0..1.0) {
            values.sort_by(f64::total_cmp);
            let found = quantile(&values, q).unwrap();
            let strictly_below = values.iter().filter(|x| **x < found).count() as f64;
            let not_above = values.iter().filter(|x| **x <= found).count() as f64;
            let place = q * (values.len() - 1) as f64;
            prop_assert!(strictly_below <= place + 1.0 && place <= not_above);
        }
    }
}
