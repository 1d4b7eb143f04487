//! A single label, without a campaign.

use std::sync::Arc;
use std::time::Instant;

use atoms::Structure;
use store::StoreError;

use super::label_attempt::SingleLabel;
use super::method::{Method, evaluate};
use super::validate::{LabelBounds, validate};

/// Labels one structure in a directory below [`super::ExecutionSettings::scratch`], which is removed afterwards.
///
/// If this is dropped early, the calculation continues until its own end or its time limit; call [`Method::stop`]
/// to end it.
///
/// # Errors
/// No calculation can be started on this host.
pub async fn label_structure(
    method: &Method,
    structure: &Structure,
    bounds: &LabelBounds,
) -> Result<SingleLabel, StoreError> {
    let started = Instant::now();
    let mut label = match method {
        Method::Reference(method) => {
            let result = evaluate(Arc::clone(method), structure.clone()).await;
            SingleLabel { result, log: String::new(), core_seconds: started.elapsed().as_secs_f64() }
        }
        Method::Code(method) => method.single_label(structure).await?,
    };
    label.result = label.result.and_then(|results| validate(results, structure, bounds, None));
    Ok(label)
}
