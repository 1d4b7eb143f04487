//! Statistics of a campaign or of a labelled data set: force errors by grade, label costs, energy offsets between
//! potential and labels, and distributions of what was collected. Functions take and return plain numbers; reading
//! data and drawing results happens elsewhere.

mod binned_errors;
mod binned_quantiles;
mod bins;
mod bootstrap;
mod completion;
mod contour;
mod cost;
mod density;
mod ensemble;
mod errors;
mod exceedance;
mod filtering;
mod histogram;
mod logistic;
mod offsets;
mod principal;
mod quantiles;
mod random;
mod rank_statistics;
mod ranked_errors;
mod reliability;
mod systematic_sample;
mod wilson;

pub use binned_errors::{BinStatistics, BinnedErrors};
pub use binned_quantiles::{QuantileBin, binned_quantiles};
pub use bins::Bins;
pub use bootstrap::Bootstrap;
pub use completion::{Completion, CompletionBin};
pub use contour::contours;
pub use cost::{CostModel, CostPredictors, Guess, MeasuredCost, Predicted};
pub use density::{Density2d, kernel_density};
pub use ensemble::{EnsembleError, force_deviation, standard_deviation};
pub use errors::{ErrorBin, ForceErrors};
pub use exceedance::Exceedance;
pub use filtering::{FilterStep, GradedRow, Quality, filter_sweep};
pub use histogram::{Histogram, decade_edges, linear_edges, logarithmic_edges};
pub use logistic::LogisticModel;
pub use offsets::{ElementOffset, EnergyOffsets, LabelledEnergy, TooFewLabels};
pub use principal::PrincipalAxes;
pub use quantiles::quantile;
pub use rank_statistics::{roc_auc, spearman};
pub use ranked_errors::{RankStatistics, RankedErrors};
pub use reliability::{ReliabilityBin, ReliabilityDiagram};
pub use systematic_sample::SystematicSample;
pub use wilson::wilson_interval;
