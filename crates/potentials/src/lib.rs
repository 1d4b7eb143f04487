//! Interatomic potentials: GRACE, EAM, Stillinger–Weber, ZBL.

mod eam;
mod eam_pairs;
mod eam_spline;
mod features;
pub mod grace;
mod near_pairs;
mod pairs;
mod potential_file;
mod setfl;
mod stillinger_weber;
mod stillinger_weber_file;
mod wall;
mod zbl;
mod zbl_windows;

pub use eam::Eam;
pub use features::{ModelWithFeatures, PotentialWithFeatures};
pub use potential_file::PotentialFileError;
pub use setfl::EamStyle;
pub use stillinger_weber::StillingerWeber;
pub use wall::{Wall, WallSettings};
pub use zbl::{Zbl, ZblRangeError};
pub use zbl_windows::{RadiiWindows, ZblWindow, ZblWindows};
