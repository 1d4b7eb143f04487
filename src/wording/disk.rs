//! Disk space, in words.

use monitor::disk::DiskForecast;

/// A number of bytes in MB, or in GB from one on.
pub fn megabytes(bytes: u64) -> String {
    match bytes {
        0..1_000_000_000 => format!("{:.1} MB", bytes as f64 / 1e6),
        _ => format!("{:.1} GB", bytes as f64 / 1e9),
    }
}

/// The forecast for the end of a campaign.
pub fn forecast(forecast: &DiskForecast) -> String {
    let (all, declined) = (megabytes(forecast.bytes()), megabytes(forecast.declined));
    format!("{all} at the end of the campaign, and up to {declined} for features of declined candidates")
}
