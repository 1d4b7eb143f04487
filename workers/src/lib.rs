//! The actors that do the work: walker, labeller.
