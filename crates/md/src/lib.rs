//! Integrators, thermostats, counter-based random numbers.
