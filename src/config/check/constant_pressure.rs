//! Rules of walks at constant pressure.

use calm::rules::Positive;

use super::{wrong, wrong_barostat};
use crate::config::error::InvalidValue;
use crate::config::{CellBiasSection, Config, WalkGroupSection, ranges};

/// Checks `walk.barostat`, `walk.cell_bias` and the volumes at which walks start, also those of groups.
pub(super) fn check_constant_pressure(config: &Config) -> Result<(), InvalidValue> {
    let Config { walk, walks, .. } = config;
    if let Some(barostat) = &walk.barostat {
        if walk.volume_ramp.is_some() {
            let expected = "either walk.barostat or walk.volume_ramp: a cell follows a pressure or a ramp";
            return wrong("walk.volume_ramp", "given together with walk.barostat", expected);
        }
        if let Some(invalid) = wrong_barostat(barostat, "walk") {
            return Err(invalid);
        }
        check_each("walk.barostat.stress", "walk.barostat.pressure", barostat.stress)?;
    }
    let bias = walk.cell_bias.unwrap_or_default();
    check_cell_bias(&bias)?;
    for (number, group) in walks.iter().enumerate() {
        check_group(config, number, group, &bias)?;
    }
    let of_walk = [("cell_bias", walk.cell_bias.is_some()), ("start_volume", walk.start_volume.get() != 1.0)];
    let unused = of_walk.into_iter().find(|(_, given)| *given);
    if let Some((name, _)) = unused
        && walk.barostat.is_none()
        && walks.iter().all(|group| group.pressures.is_empty())
    {
        return wrong(
            &format!("walk.{name}"),
            "given without a barostat",
            "walk.barostat, or pressures in a group of walks",
        );
    }
    if walk.cell_bias.is_some() && walks.is_empty() {
        check_start_volumes("walk.start_volume", &[walk.start_volume], &bias)?;
    }
    Ok(())
}

/// Checks each number of a list at `key` against the range of another key.
fn check_each<const N: usize>(key: &str, with_range: &str, numbers: [f64; N]) -> Result<(), InvalidValue> {
    let wrong_number = numbers.into_iter().find_map(|number| ranges::expected_instead(with_range, number));
    wrong_number.map_or(Ok(()), |(found, expected)| wrong(key, found, expected))
}

fn check_group(
    config: &Config,
    number: usize,
    group: &WalkGroupSection,
    bias: &CellBiasSection,
) -> Result<(), InvalidValue> {
    let walk = &config.walk;
    let key = |name: &str| format!("walks.{number}.{name}");
    if !group.pressures.is_empty() && !group.volume_ramps.is_empty() {
        let expected = "either pressures or volume_ramps: a cell follows a pressure or a ramp";
        return wrong(&key("volume_ramps"), "given together with pressures", expected);
    }
    let has_barostat =
        !group.pressures.is_empty() || walk.barostat.is_some() && group.volume_ramps.is_empty();
    if !has_barostat && (!group.start_volumes.is_empty() || group.cell_bias == Some(true)) {
        let name = if group.start_volumes.is_empty() { "cell_bias" } else { "start_volumes" };
        return wrong(&key(name), "given without a barostat", "pressures in the group, or walk.barostat");
    }
    if !has_barostat || !group.cell_bias.unwrap_or(walk.cell_bias.is_some()) {
        return Ok(());
    }
    if group.start_volumes.is_empty() {
        return check_start_volumes("walk.start_volume", &[walk.start_volume], bias);
    }
    check_start_volumes(&key("start_volumes"), &group.start_volumes, bias)
}

fn check_cell_bias(bias: &CellBiasSection) -> Result<(), InvalidValue> {
    let CellBiasSection { gain, gain_range, min_drift, max_drift, volume_range, .. } = bias;
    let shown = |[low, high]: [Positive; 2]| format!("[{}, {}]", low.get(), high.get());
    let [low, high] = *gain_range;
    if low > high || *gain < low || *gain > high {
        let found = format!("{} with gain = {}", shown(*gain_range), gain.get());
        return wrong(
            "walk.cell_bias.gain_range",
            found,
            "the smallest gain and the largest, and gain between them",
        );
    }
    check_each("walk.cell_bias.gain_range", "walk.cell_bias.gain", gain_range.map(Positive::get))?;
    if min_drift >= max_drift {
        return wrong(
            "walk.cell_bias.max_drift",
            max_drift.get(),
            format!("more than min_drift = {}", min_drift.get()),
        );
    }
    let [low, high] = volume_range.map(Positive::get);
    let possible = |volume: f64| ranges::expected_instead("walk.start_volume", volume).is_none();
    if !(low < 1.0 && high > 1.0 && high - low > 0.1 && possible(low) && possible(high)) {
        let expected = "two V/V₀ with 1 between them, more than 0.1 apart, such as [0.75, 1.3]";
        return wrong("walk.cell_bias.volume_range", shown(*volume_range), expected);
    }
    Ok(())
}

/// Walks with a biased cell start within its range of volumes.
fn check_start_volumes(key: &str, volumes: &[Positive], bias: &CellBiasSection) -> Result<(), InvalidValue> {
    let [low, high] = bias.volume_range;
    match volumes.iter().find(|volume| **volume < low || **volume > high) {
        Some(outside) => {
            let expected = format!("within walk.cell_bias.volume_range = [{}, {}]", low.get(), high.get());
            wrong(key, outside.get(), expected)
        }
        None => Ok(()),
    }
}
