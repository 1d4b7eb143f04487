//! Potentials and crystals of the benchmark.

use std::path::{Path, PathBuf};

use atoms::{Cell, Potential, Species, Structure};
use md::{State, Stream};
use potentials::{Eam, StillingerWeber};

/// Skin of both neighbour lists, Å.
pub const SKIN: f64 = 1.0;

/// Initial temperature, K; half of the kinetic energy goes into the positions.
const TEMPERATURE: f64 = 600.0;

const FCC: [[f64; 3]; 4] = [[0.0; 3], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]];

/// A system to simulate.
pub struct Case {
    pub name: &'static str,
    /// The corresponding pair styles of LAMMPS.
    pub styles: [&'static str; 2],
    pub file: PathBuf,
    pub start: State,
    /// Time step, fs.
    pub time_step: f64,
}

pub fn all() -> Vec<Case> {
    let diamond = [FCC, FCC.map(|site| site.map(|x| x + 0.25))].concat();
    let mut cases = Vec::new();
    for cells in [[3, 3, 3], [8, 8, 8]] {
        cases.push(Case {
            name: "EAM, Al_mm.eam.fs",
            styles: ["eam/fs", "eam/fs/opt"],
            file: data("Al_mm.eam.fs"),
            start: crystal("Al", &FCC, 4.05, cells),
            time_step: 2.0,
        });
    }
    for cells in [[2, 2, 3], [8, 8, 4]] {
        cases.push(Case {
            name: "Stillinger–Weber, Si.sw",
            styles: ["sw", "sw/omp"],
            file: data("Si.sw"),
            start: crystal("Si", &diamond, 5.431, cells),
            time_step: 1.0,
        });
    }
    cases
}

impl Case {
    pub fn atoms(&self) -> usize {
        self.start.structure.len()
    }

    pub fn potential(&self) -> Box<dyn Potential> {
        if self.styles[0] == "sw" {
            Box::new(StillingerWeber::load(&self.file).expect("a parameter file"))
        } else {
            Box::new(Eam::load(&self.file).expect("a setfl file"))
        }
    }
}

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/data").join(name)
}

/// `cells` cubic cells of edge `a`, Å, with thermal velocities.
fn crystal(symbol: &str, sites: &[[f64; 3]], a: f64, cells: [usize; 3]) -> State {
    let mut positions = Vec::new();
    for x in 0..cells[0] {
        for y in 0..cells[1] {
            for z in 0..cells[2] {
                let corner = [x, y, z].map(|n| n as f64);
                positions.extend(sites.iter().map(|site| std::array::from_fn(|k| a * (corner[k] + site[k]))));
            }
        }
    }
    let species: Species = symbol.parse().expect("an element");
    let [lx, ly, lz] = cells.map(|n| a * n as f64);
    let structure = Structure {
        species: vec![species; positions.len()],
        positions,
        cell: Cell::orthorhombic(lx, ly, lz),
        periodic: [true; 3],
    };
    State::thermal(structure, TEMPERATURE, &Stream::new(1, 0, 0))
}
