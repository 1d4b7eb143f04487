//! Devices with a model in plain numpy. Needs a Python with numpy: `CALMWALK_PYTHON`.

mod common;
mod faults;
mod results;
