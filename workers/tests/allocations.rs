//! A biased step allocates no memory: work arrays are reused.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use atoms::{Structure, read_extxyz};
use calm::Artifact;
use md::{CellMotion, Dynamics, DynamicsSettings, Langevin, State, Stream, Thermostat};
use potentials::grace::{Grace, GraceModel, Precision, RadialPath};
use potentials::{Zbl, ZblWindow, ZblWindows};
use workers::bias::BiasedPotential;

thread_local! {
    /// Counts this thread only: the test runner may allocate on others.
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // Fails while a thread ends.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + 1));
}

/// The system allocator with a counter.
struct Counting;

#[allow(unsafe_code)] // The only way to count allocations; every call is forwarded to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

fn data(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../configs/data").join(path)
}

fn seed_structure() -> Structure {
    read_extxyz(&data("aluminium_seeds.extxyz")).unwrap().swap_remove(0).structure
}

#[test]
fn a_biased_step_allocates_nothing() {
    check(Precision::Double);
    check(Precision::Mixed);
}

fn check(precision: Precision) {
    let structure = seed_structure();
    let file = data("al_eam_1l/kokkos.npz");
    let model = Arc::new(GraceModel::load_in(&file, precision, RadialPath::default()).unwrap());
    let mixture = Arc::new(Artifact::load(data("al_eam_1l/gmm_artifacts.npz")).unwrap().mixture);
    let zbl =
        Zbl::new(&structure.species, &ZblWindows::Uniform(ZblWindow { inner: 1.6, outer: 2.4 })).unwrap();
    let mut potential =
        BiasedPotential::new(Box::new(Grace::new(model)), mixture, Some(zbl), 2, &structure.species).unwrap();
    let stream = Stream::new(3, 0, 0);
    let state = State::thermal(structure, 50.0, &stream);
    let settings = DynamicsSettings {
        time_step: 1.0,
        thermostat: Thermostat::Langevin(Langevin { temperature: 50.0, friction: 0.01 }),
        cell_motion: CellMotion::Fixed,
        stream,
        // At 50 K no atom moves by half the skin in a few steps, so the list is not rebuilt.
        skin: 1.0,
    };
    for tau in [0.0, 0.15] {
        potential.tau = tau;
        let mut dynamics = Dynamics::new(state.clone(), settings.clone(), &mut potential).unwrap();
        (0..3).for_each(|_| dynamics.step(&mut potential).unwrap());
        let before = ALLOCATIONS.get();
        (0..3).for_each(|_| dynamics.step(&mut potential).unwrap());
        assert_eq!(ALLOCATIONS.get() - before, 0, "{precision}, τ = {tau}");
        let grades = potential.grades(dynamics.structure(), dynamics.neighbours()).unwrap();
        assert_eq!(grades.gamma.len(), dynamics.structure().len());
    }
}
