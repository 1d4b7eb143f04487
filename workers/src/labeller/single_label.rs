//! A single label, without a campaign.

use std::sync::Arc;
use std::time::Instant;

use atoms::Structure;
use dft::{Calculated, Failure};
use store::StoreError;

use super::method::{Method, evaluate};
use super::validate::{LabelBounds, validate};

/// What came of a single calculation.
#[derive(Clone, Debug)]
pub struct SingleLabel {
    /// Its numbers, judged as those of a campaign are.
    pub result: Result<Calculated, Failure>,
    /// The end of what the program said; empty for a potential.
    pub log: String,
    /// Cores times the time that it took, s.
    pub core_seconds: f64,
}

/// Labels one structure in a directory below `Running::scratch`, which is removed afterwards.
///
/// Dropped before it is ready, the calculation goes on until it ends by itself or by its time limit: who stops waiting has
/// to call [`Method::stop`].
///
/// # Errors
/// Where no calculation can be started here at all.
pub async fn label_structure(
    method: &Method,
    structure: &Structure,
    bounds: &LabelBounds,
) -> Result<SingleLabel, StoreError> {
    let begun = Instant::now();
    let mut label = match method {
        Method::Reference(method) => {
            let result = evaluate(Arc::clone(method), structure.clone()).await;
            SingleLabel { result, log: String::new(), core_seconds: begun.elapsed().as_secs_f64() }
        }
        Method::Code(method) => method.single_label(structure).await?,
    };
    label.result = label.result.and_then(|made| validate(made, structure, bounds, None));
    Ok(label)
}
