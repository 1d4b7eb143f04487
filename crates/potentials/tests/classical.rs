//! Properties of EAM, Stillinger–Weber and ZBL that hold for any parameters.

use atoms::{Cell, Evaluation, NeighbourList, Potential, PotentialError, Species, Structure};
use potentials::{Eam, EamStyle, RadiiWindows, StillingerWeber, Zbl, ZblWindow, ZblWindows};
use proptest::prelude::Rng;
use proptest::test_runner::{RngAlgorithm, TestRng};

use crate::common;

const HERE: &str = env!("CARGO_MANIFEST_DIR");

fn species(symbols: &[&str]) -> Vec<Species> {
    symbols.iter().map(|symbol| symbol.parse().unwrap()).collect()
}

fn aluminium() -> Eam {
    Eam::load(format!("{HERE}/../../configs/data/Al_mm.eam.fs")).unwrap()
}

fn two_metals() -> Eam {
    Eam::load(format!("{HERE}/tests/data/two_elements.eam.fs")).unwrap()
}

fn silicon() -> StillingerWeber {
    StillingerWeber::load(format!("{HERE}/../../configs/data/Si.sw")).unwrap()
}

fn silicon_carbide() -> StillingerWeber {
    StillingerWeber::load(format!("{HERE}/tests/data/two_elements.sw")).unwrap()
}

/// Each pair of elements has another window.
fn repulsion() -> Zbl {
    let windows = RadiiWindows { inner: 0.5, outer: 1.2, ..RadiiWindows::default() };
    Zbl::new(&species(&["Al", "Si"]), &ZblWindows::PerPair(windows)).unwrap()
}

fn window(inner: f64, outer: f64) -> ZblWindows {
    ZblWindows::Uniform(ZblWindow { inner, outer })
}

/// A crystal of `corner` in skewed cubes of edge `a`, rattled by up to ±`width`, with alternating elements.
fn crystal(symbols: &[&str], corner: &[[f64; 3]], a: f64, width: f64, cells: [usize; 3]) -> Structure {
    let mut random = TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]);
    let mut shake = || width * (f64::from(random.next_u32()) / f64::from(u32::MAX) * 2.0 - 1.0);
    let lattice = Cell([[a, 0.0, 0.0], [0.04 * a, a, 0.0], [-0.03 * a, 0.05 * a, a]]);
    let mut positions = Vec::new();
    for x in 0..cells[0] {
        for y in 0..cells[1] {
            for z in 0..cells[2] {
                let origin = lattice.translation([x as i32, y as i32, z as i32]);
                for atom in corner {
                    let r = lattice.cartesian(*atom);
                    positions.push(std::array::from_fn(|k| origin[k] + r[k] + shake()));
                }
            }
        }
    }
    let elements = species(symbols);
    Structure {
        species: (0..positions.len()).map(|k| elements[k % elements.len()]).collect(),
        positions,
        cell: Cell(std::array::from_fn(|k| lattice.0[k].map(|x| cells[k] as f64 * x))),
        periodic: [true; 3],
    }
}

const FCC: [[f64; 3]; 4] = [[0.0; 3], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];

fn fcc(symbols: &[&str], a: f64, cells: [usize; 3]) -> Structure {
    crystal(symbols, &FCC, a, 0.1, cells)
}

fn diamond(symbols: &[&str], a: f64, cells: [usize; 3]) -> Structure {
    let second = FCC.map(|atom| atom.map(|x| x + 0.25));
    crystal(symbols, &[FCC, second].concat(), a, 0.15, cells)
}

/// `structure` without periodicity along the third lattice vector: two free surfaces.
fn slab(mut structure: Structure) -> Structure {
    structure.periodic[2] = false;
    structure
}

/// A potential with a structure, and the step for finite differences.
struct Subject {
    name: &'static str,
    potential: Box<dyn Potential>,
    structure: Structure,
    /// Å
    step: f64,
    tolerance: f64,
}

/// Small cells contain their own images.
///
/// The second derivative of a table jumps at each point (every 6.5e-4 Å for Al), so steps must be short there;
/// analytic potentials allow the optimal step.
fn subjects() -> Vec<Subject> {
    let table = |name, potential: Eam, structure| Subject {
        name,
        potential: Box::new(potential),
        structure,
        step: 1e-5,
        tolerance: 5e-7,
    };
    let mut one_atom = fcc(&["Al"], 4.05, [1, 1, 1]);
    one_atom.species.truncate(1);
    one_atom.positions.truncate(1);
    one_atom.cell = Cell([[2.7, 0.0, 0.0], [1.1, 2.5, 0.0], [-0.9, 0.8, 2.4]]);
    let mut subjects = vec![
        table("Al bulk", aluminium(), fcc(&["Al"], 4.05, [2, 2, 1])),
        table("Al slab", aluminium(), slab(fcc(&["Al"], 4.05, [2, 1, 2]))),
        table("Al, one atom", aluminium(), one_atom),
        table("Al–Cu", two_metals(), fcc(&["Al", "Cu", "Cu"], 3.8, [2, 2, 1])),
        table("Al–Cu beyond the density table", two_metals(), fcc(&["Al", "Cu"], 2.63, [2, 1, 1])),
    ];
    let analytic: [(&str, Box<dyn Potential>, Structure); 5] = [
        ("Si bulk", Box::new(silicon()), diamond(&["Si"], 5.43, [1, 1, 2])),
        ("Si slab", Box::new(silicon()), slab(diamond(&["Si"], 5.3, [1, 1, 1]))),
        ("Si dense", Box::new(silicon()), diamond(&["Si"], 4.6, [1, 1, 1])),
        ("Si–C", Box::new(silicon_carbide()), diamond(&["Si", "C", "Si"], 4.7, [1, 1, 1])),
        ("ZBL", Box::new(repulsion()), fcc(&["Al", "Si"], 2.8, [1, 2, 1])),
    ];
    for (name, potential, structure) in analytic {
        subjects.push(Subject { name, potential, structure, step: 2e-4, tolerance: 1e-9 });
    }
    subjects
}

#[test]
fn forces_and_virial_are_derivatives_of_the_energy() {
    for Subject { name, mut potential, structure, step, tolerance } in subjects() {
        eprintln!("{name}");
        if structure.len() > 1 {
            common::check_forces(&mut *potential, &structure, step, tolerance);
        }
        common::check_virial(&mut *potential, &structure, step, tolerance);
    }
}

#[test]
fn momentum_is_conserved_and_the_virial_symmetric() {
    for Subject { name, mut potential, structure, .. } in subjects() {
        let found = common::evaluate(&mut *potential, &structure);
        let largest = found.forces.as_flattened().iter().fold(1.0_f64, |m, f| m.max(f.abs()));
        for k in 0..3 {
            let total: f64 = found.forces.iter().map(|f| f[k]).sum();
            assert!(total.abs() < 1e-12 * largest, "{name}: {total}");
            for l in 0..k {
                assert_eq!(found.virial[k][l].to_bits(), found.virial[l][k].to_bits(), "{name}");
            }
        }
    }
}

/// A list with another skin has other pairs beyond the cutoff, which must not affect the sums.
#[test]
fn the_skin_changes_no_bit() {
    for Subject { name, mut potential, structure, .. } in subjects() {
        let exact = common::evaluate(&mut *potential, &structure);
        let mut neighbours = NeighbourList::new(potential.cutoff(), 1.3);
        neighbours.update(&structure).unwrap();
        let mut found = Evaluation { atomic_energies: vec![1e9], ..Evaluation::default() };
        potential.evaluate(&structure, &neighbours, &mut found).unwrap();
        assert_eq!(found, exact, "{name}");
    }
}

#[test]
fn atoms_without_neighbours_have_no_forces() {
    let lone = |symbol: &str| Structure {
        species: species(&[symbol, symbol]),
        positions: vec![[1.0, 2.0, 3.0], [30.0, 2.0, 3.0]],
        cell: Cell::orthorhombic(50.0, 50.0, 50.0),
        periodic: [false; 3],
    };
    let potentials: [(Box<dyn Potential>, &str); 3] =
        [(Box::new(aluminium()), "Al"), (Box::new(silicon()), "Si"), (Box::new(repulsion()), "Al")];
    for (mut potential, symbol) in potentials {
        let found = common::evaluate(&mut *potential, &lone(symbol));
        assert!(found.energy().abs() < 1e-12, "{symbol} {}", found.energy());
        assert_eq!(found.forces, [[0.0; 3]; 2]);
        assert_eq!(found.virial, [[0.0; 3]; 3]);
    }
}

#[test]
fn what_a_potential_cannot_evaluate_is_an_error() {
    let copper = fcc(&["Al", "Cu"], 4.0, [1, 1, 1]);
    let mut neighbours = NeighbourList::new(6.5, 0.0);
    neighbours.update(&copper).unwrap();
    let mut out = Evaluation::default();
    let error = aluminium().evaluate(&copper, &neighbours, &mut out).unwrap_err();
    let unknown = PotentialError::Species { atom: 1, species: species(&["Cu"])[0], known: "Al".into() };
    assert_eq!(error, unknown);
    assert!(repulsion().evaluate(&copper, &neighbours, &mut out).is_err());

    let crystal = fcc(&["Al"], 4.05, [1, 1, 1]);
    let mut short = NeighbourList::new(5.0, 1.5);
    short.update(&crystal).unwrap();
    let error = aluminium().evaluate(&crystal, &short, &mut out).unwrap_err();
    assert_eq!(error, PotentialError::Cutoff { list: 5.0, needed: 6.5 });
}

/// With one element there is one density, so both styles are the same file.
#[test]
fn the_style_matters_for_several_elements_only() {
    let path = format!("{HERE}/../../configs/data/Al_mm.eam.fs");
    let structure = fcc(&["Al"], 4.05, [1, 1, 1]);
    let alloy = common::evaluate(&mut Eam::load_as(path, EamStyle::Alloy).unwrap(), &structure);
    assert_eq!(alloy, common::evaluate(&mut aluminium(), &structure));
}

#[test]
fn the_repulsion_is_added_to_what_is_there() {
    let structure = fcc(&["Al"], 3.4, [1, 1, 1]);
    let mut neighbours = NeighbourList::new(6.5, 0.0);
    neighbours.update(&structure).unwrap();
    let alone = common::evaluate(&mut repulsion(), &structure);
    let mut sum = Evaluation::default();
    aluminium().evaluate(&structure, &neighbours, &mut sum).unwrap();
    let before = sum.clone();
    repulsion().add(&structure, &neighbours, &mut sum).unwrap();
    let difference = sum.energy() - before.energy();
    assert!((difference - alone.energy()).abs() < 1e-10 && difference > 0.1);
    for i in 0..structure.len() {
        for k in 0..3 {
            assert!((sum.forces[i][k] - before.forces[i][k] - alone.forces[i][k]).abs() < 1e-10);
        }
    }
    for (k, row) in alone.virial.iter().enumerate() {
        for (l, w) in row.iter().enumerate() {
            assert!((sum.virial[k][l] - before.virial[k][l] - w).abs() < 1e-10);
        }
    }
}

/// Energy and first two derivatives match those of the plain repulsion and of zero.
#[test]
fn the_switch_of_the_repulsion_is_smooth() {
    let (inner, outer) = (1.2, 2.4);
    let elements = species(&["Al"]);
    let mut switched = Zbl::new(&elements, &window(inner, outer)).unwrap();
    let mut plain = Zbl::new(&elements, &window(19.0, 20.0)).unwrap();
    let dimer = |r: f64| Structure {
        species: species(&["Al", "Al"]),
        positions: vec![[0.0; 3], [r, 0.0, 0.0]],
        cell: Cell::orthorhombic(50.0, 50.0, 50.0),
        periodic: [false; 3],
    };
    let force = |potential: &mut Zbl, r: f64| common::evaluate(potential, &dimer(r)).forces[1][0];
    let h = 1e-4;
    let stiffness =
        |difference: &mut dyn FnMut(f64) -> f64, r| (difference(r + h) - difference(r - h)) / (2.0 * h);
    let mut to_plain = |r| force(&mut switched, r) - force(&mut plain, r);
    assert_eq!(to_plain(1.1), 0.0);
    assert!(to_plain(inner + h).abs() < 1e-3);
    assert!(stiffness(&mut to_plain, inner).abs() < 0.05);
    let mut to_nothing = |r| force(&mut switched, r);
    assert!(to_nothing(1.8) > 1.0);
    assert!(to_nothing(outer - h).abs() < 1e-6 && to_nothing(outer) == 0.0 && to_nothing(2.5) == 0.0);
    assert!(stiffness(&mut to_nothing, outer).abs() < 1e-2);
}

#[test]
fn a_switch_must_have_a_width() {
    let elements = species(&["Al"]);
    for (inner, outer) in [(2.0, 2.0), (2.4, 2.0), (-0.1, 2.0), (f64::NAN, 2.0), (1.0, f64::INFINITY)] {
        assert!(Zbl::new(&elements, &window(inner, outer)).is_err());
    }
}

/// A pair has no repulsion beyond its own window, whatever those of others.
#[test]
fn every_pair_of_elements_has_its_window() {
    let windows: RadiiWindows =
        serde_json::from_str(r#"{ "pairs": { "H-O": { "inner": 0.3, "outer": 0.5 } } }"#).unwrap();
    let elements = species(&["H", "O", "Al"]);
    let mut repulsion = Zbl::new(&elements, &ZblWindows::PerPair(windows)).unwrap();
    assert!((repulsion.cutoff() - 0.75 * 2.42).abs() < 1e-12);
    for (a, b, outer) in
        [("H", "H", 0.75 * 0.62), ("H", "O", 0.5), ("O", "Al", 0.75 * 1.87), ("Al", "Al", 0.75 * 2.42)]
    {
        let mut energy = |r: f64| {
            let structure = Structure {
                species: species(&[a, b]),
                positions: vec![[0.0; 3], [r, 0.0, 0.0]],
                cell: Cell::orthorhombic(50.0, 50.0, 50.0),
                periodic: [false; 3],
            };
            common::evaluate(&mut repulsion, &structure).atomic_energies.iter().sum::<f64>()
        };
        assert!(energy(outer - 0.02) > 0.0 && energy(outer) == 0.0 && energy(outer + 0.02) == 0.0, "{a}-{b}");
    }
}

/// The published lattice constant and cohesive energy of each potential.
#[test]
fn the_perfect_crystals_have_their_published_energies() {
    let energy = |potential: &mut dyn Potential, corner: &[[f64; 3]], symbol: &str, a: f64| {
        let structure = Structure {
            species: vec![species(&[symbol])[0]; corner.len()],
            positions: corner.iter().map(|x| x.map(|x| a * x)).collect(),
            cell: Cell::orthorhombic(a, a, a),
            periodic: [true; 3],
        };
        common::evaluate(potential, &structure).energy() / corner.len() as f64
    };
    let diamond = [FCC, FCC.map(|atom| atom.map(|x| x + 0.25))].concat();
    // Stillinger and Weber chose epsilon to give −2 ε per atom at r = 2^(1/6) σ.
    let a = 4.0 / 3.0_f64.sqrt() * 2.0_f64.powf(1.0 / 6.0) * 2.0951;
    assert!((energy(&mut silicon(), &diamond, "Si", a) + 2.0 * 2.1683).abs() < 1e-6);
    // Mendelev et al., Philos. Mag. 88, 1723 (2008): 4.045 Å at 0 K.
    let mut al = aluminium();
    let lowest = energy(&mut al, &FCC, "Al", 4.0453);
    assert!(lowest < energy(&mut al, &FCC, "Al", 4.02) && lowest < energy(&mut al, &FCC, "Al", 4.07));
}
