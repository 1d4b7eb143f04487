//! Interatomic potentials: GRACE, EAM, Stillinger–Weber, ZBL.
