//! What the device of a model in Python has done.

use wire::DeviceStatistics;

use crate::output::count;

/// For instance `mace on cuda: busy for 93 % of the time, 31.2 structures a batch, …`.
pub fn describe(device: &DeviceStatistics) -> String {
    let mut parts = vec![
        format!("busy for {:.0} % of the time", 100.0 * device.busy_share()),
        format!("{:.1} structures a batch (largest {})", device.mean_batch(), device.largest_batch),
        format!("{:.2e} bonds/s", device.bonds_per_second()),
        format!("calls wait {:.1} ms", 1e3 * device.mean_wait()),
    ];
    if device.compiled > 0.0 {
        parts.push(format!("{:.0} s for batches of new sizes", device.compiled));
    }
    if let Some(bonds) = device.max_bonds {
        parts.push(format!("its memory takes {bonds} bonds"));
    }
    if device.restarts > 0 {
        parts.push(count(device.restarts as usize, "restart"));
    }
    let failure = device.last_failure.as_deref().and_then(|text| text.lines().next());
    let failure = failure.map_or(String::new(), |text| format!("; the last failure: {text}"));
    format!("{} on {}: {}{failure}", device.adapter, device.device, parts.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_is_described_in_one_sentence() {
        let statistics = DeviceStatistics {
            adapter: "mace".into(),
            device: "cuda".into(),
            batches: 4,
            structures: 50,
            bonds: 90_000,
            busy: 0.9,
            elapsed: 1.0,
            waited: 0.1,
            largest_batch: 16,
            restarts: 1,
            last_failure: Some("killed\nby somebody".into()),
            ..DeviceStatistics::default()
        };
        assert_eq!(
            describe(&statistics),
            "mace on cuda: busy for 90 % of the time, 12.5 structures a batch (largest 16), 1.00e5 bonds/s, calls wait 2.0 ms, 1 restart; \
             the last failure: killed"
        );
    }
}
