//! Labels of real programs, checked for consistency: forces and stress are derivatives of the energy, a magnet
//! has its moment, and a limit on electronic steps that is too low is detected and overcome.
//!
//! Needs Debian's packages gpaw, gpaw-data, abinit, abinit-data, cp2k, cp2k-data, quantum-espresso and
//! quantum-espresso-data, and fails without them:
//! `CALMWALK_PYTHON=/usr/bin/python3 cargo test -p dft --test codes`.

mod abinit;
mod ase;
mod checks;
mod copies;
mod cp2k;
mod espresso;
mod gpaw;
mod run;
mod structures;
