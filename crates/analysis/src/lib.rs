//! What is learned from the numbers of a campaign: how grades foretell force errors, what labels cost. Plain numbers in
//! and out; where they come from, and how they are shown, is not known here.

mod bins;
mod completion;
mod cost;
mod errors;
mod quantiles;
mod ranks;
mod share;
mod thinned;

pub use bins::Bins;
pub use completion::{Completion, CompletionBin};
pub use cost::{CostModel, Guess, Measured, Predicted, Size};
pub use errors::{ErrorBin, ForceErrors};
pub use quantiles::quantile;
pub use ranks::{roc_auc, spearman};
pub use share::wilson;
pub use thinned::Thinned;
