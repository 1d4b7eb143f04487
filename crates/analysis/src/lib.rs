//! What is learned from the numbers of a campaign: how grades foretell force errors, what labels cost, by how much zeros of
//! energy differ, how what was collected is distributed. Plain numbers in and out; where they come from, and how they are shown, is not known here.

mod bands;
mod bins;
mod completion;
mod contour;
mod cost;
mod density;
mod errors;
mod histogram;
mod offsets;
mod principal;
mod quantiles;
mod ranks;
mod share;
mod thinned;

pub use bands::{Band, bands};
pub use bins::Bins;
pub use completion::{Completion, CompletionBin};
pub use contour::contours;
pub use cost::{CostModel, Guess, Measured, Predicted, Size};
pub use density::{PlaneDensity, density};
pub use errors::{ErrorBin, ForceErrors};
pub use histogram::{Histogram, even_edges, logarithmic_edges};
pub use offsets::{ElementOffset, EnergyOffsets, LabelledEnergy, TooFewLabels};
pub use principal::PrincipalAxes;
pub use quantiles::quantile;
pub use ranks::{roc_auc, spearman};
pub use share::wilson;
pub use thinned::Thinned;
